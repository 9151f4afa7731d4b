"""The rig whose sensors are read."""

import pytest

from lce_rig.rig import Rig, load_rig


@pytest.fixture
def rig() -> Rig:
    return load_rig("rlfs")
