"""The clocks of a rig: fitted, tied to one another, and what they say about which samples belong together."""
