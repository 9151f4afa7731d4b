"""Lets the tests of this folder import the devices they share."""

import sys
from pathlib import Path

import pytest

from lce_rig.rig import Rig, load_rig

sys.path.insert(0, str(Path(__file__).parent))


@pytest.fixture
def rig() -> Rig:
    return load_rig("rlfs")
