"""A rig of one camera and one LiDAR."""

import pytest

from lce_rig.rig import load_rig


@pytest.fixture(scope="session")
def rig():
    return load_rig("rlfs")
