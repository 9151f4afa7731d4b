"""How a sensor's motion changes the extrinsics of its pairs."""

import numpy as np
import pytest

from lce_rig.core.geometry import difference, invert, perturb
from lce_rig.judge.findings import MOVED
from lce_rig.judge.moved_sensor import MovedSensor, PairCosts, with_motion
from lce_rig.judge.validate import Validation

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


def moved(place, severity):
    figures = {"captures": ("000003",), "n_captures": 1, "place": place, "neighbour": "000002"}
    return MOVED(severity=severity, rotation_deg=1.0, translation_m=0.0, chance=1e-9, **figures)


def test_sensor_is_named_in_the_reason_alone():
    reason, note = moved("last", "error"), moved("", "note")
    validation = Validation(np.eye(6), np.eye(6), np.eye(6), (), [reason, note], False, None, [])
    pair = PairCosts(("first", "second"), None, np.eye(4), np.eye(4), ("000001",), reason)
    named = with_motion(validation, pair, MovedSensor("second", "000003", -9.0, reason)).causes
    assert named[0].figures["sensor"] == "second" and named[1] is note
