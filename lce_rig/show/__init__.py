"""Views for people: overlays, reports, the live screen, the phone page."""
