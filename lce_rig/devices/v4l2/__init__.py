"""Cameras of the kernel's video interface."""
