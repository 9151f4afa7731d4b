"""A rig of one camera and one LiDAR."""

import pytest

from lce_rig.rig import Rig, load_rig


@pytest.fixture(scope="session")
def rig() -> Rig:
    return load_rig("rlfs")
