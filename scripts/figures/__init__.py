"""The images of the documentation, made with lce-rig itself."""
