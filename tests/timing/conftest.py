"""The small rig of the collection's tests."""

from tests.collect.conftest import rig

__all__ = ["rig"]
