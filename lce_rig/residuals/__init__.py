"""Plane and ring-end residuals, their derivatives, and quadratic costs per capture."""
