"""How a sensor's motion changes the extrinsics of its pairs."""

import numpy as np
import pytest

from lce_rig.core.geometry import difference, invert, perturb
from lce_rig.judge.moved_sensor import PairCosts

MOTION = 1e-6 * np.array([1.0, -2.0, 0.5, 0.3, 0.8, -1.2])


def random_pose(rng):
    return perturb(np.eye(4), rng.normal(size=6))


@pytest.mark.parametrize("sensor", ["first", "second"])
def test_slopes_equal_finite_differences(sensor):
    rng = np.random.default_rng(0)
    T, T_view, moved = random_pose(rng), random_pose(rng), perturb(np.eye(4), MOTION)
    pair = PairCosts(("first", "second"), None, T, T_view, (), None)
    after = moved @ T if sensor == "first" else T @ invert(moved)
    found = difference(T_view @ after, T_view @ T)
    assert pair.slopes(sensor) @ MOTION == pytest.approx(found, abs=1e-10)
