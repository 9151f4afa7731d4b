"""Intrinsics of a camera from images of the board."""
