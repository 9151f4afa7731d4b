"""Recorded packets of Ousters."""
