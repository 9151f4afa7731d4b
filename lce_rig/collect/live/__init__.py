"""Guided collection from attached sensors."""
