"""Whether a computer and its sensors are fit to collect: a function a check, each line with its remedy."""

from lce_rig.collect.health.check import Check, Severity, worst

__all__ = ["Check", "Severity", "worst"]
