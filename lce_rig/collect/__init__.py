"""Collect captures into a session, from recordings or attached sensors."""
