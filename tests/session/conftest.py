"""Small sessions for the tests of `lce_rig.session`."""

import numpy as np
import pytest

from lce_rig.core.data import Image, Scan


@pytest.fixture
def samples():
    """An image and a scan of noise for each seed."""

    def build(seed, n_points=300):
        rng = np.random.default_rng(seed)
        image = Image("cam", "frames", 10**18 + seed, rng.integers(0, 256, (24, 32, 3), dtype=np.uint8), None)
        scan = Scan(
            "lidar",
            10**18 + seed,
            rng.normal(size=(n_points, 3)).astype(np.float32),
            rng.uniform(0, 255, n_points).astype(np.float32),
            rng.integers(0, 16, n_points).astype(np.int16),
            np.sort(rng.integers(0, 10**8, n_points)),
            10**18 + seed + 5,
        )
        return [image], [scan]

    return build
