"""The pictures of the documentation, made with lce-rig itself."""
