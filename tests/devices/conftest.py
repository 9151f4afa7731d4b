"""The rig whose sensors are read."""

import pytest

from lce_rig.rig import load_rig


@pytest.fixture
def rig():
    return load_rig("rlfs")
