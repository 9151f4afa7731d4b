"""The report states uncertainty by axis and by distance, in 80 columns."""

import re

import numpy as np

from lce_rig.cli.calibrate import uncertainty_lines
from lce_rig.core.calibration import Calibration, Certificate, Metrics, PointUncertainty, WeakestMotion
from tests.saved_results import made_calibration

WEAK = "translation along the camera's z axis (line of sight), sigma 104.9 mm"


def calibration() -> Calibration:
    cov = np.diag(np.square([0.003, 0.004, 0.012, *np.radians([0.05, 0.12, 0.01])]))
    return made_calibration(
        np.eye(4),
        cov,
        certificate=Certificate(True, 0.0),
        metrics=Metrics(0.005, 0.005, 0.1),
        captures_used=(),
        weakest=WeakestMotion("translation_z", 0.1049),
        uncertainty=tuple(PointUncertainty(d, 123.4, 0.123 * d, 134.5, 0.234 * d) for d in (5.0, 10.0, 20.0)),
    )


def test_every_axis_and_distance_is_named_in_80_columns() -> None:
    lines = uncertainty_lines(calibration())
    assert "0.130 deg, 13.0 mm" in lines[0]
    for line, figures in ((lines[1], (0.05, 0.12, 0.01)), (lines[2], (3, 4, 12))):
        said = re.findall(r"(x right|y down|z forward) ([\d.]+)", line)
        assert [axis for axis, _ in said] == ["x right", "y down", "z forward"]
        assert tuple(float(value) for _, value in said) == figures
    assert WEAK in lines[3]
    assert lines[4].split() == ["a", "point", "5", "m", "away", "10", "m", "away", "20", "m", "away"]
    assert "123.4 px, 61.5 cm" in lines[5]
    assert "134.5 px, 117.0 cm" in lines[6]
    assert max(map(len, lines)) <= 80
