"""Captures from recordings, unattended."""
