"""The clocks of a rig: their models, and the matching of samples by time and by number."""
