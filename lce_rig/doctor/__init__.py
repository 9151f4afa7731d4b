"""Whether a computer and its sensors are fit to collect: a function a check, each line with its findings."""

from lce_rig.doctor.line import Check

__all__ = ["Check"]
