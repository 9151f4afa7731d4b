"""From recordings to a session of captures, unattended."""

from lce_rig.collect.offline import CollectOptions, CollectReport, collect

__all__ = ["CollectOptions", "CollectReport", "collect"]
