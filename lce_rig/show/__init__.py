"""What people see: overlays, reports, the live screen, the phone page."""
