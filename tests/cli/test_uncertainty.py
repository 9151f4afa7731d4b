"""The report states uncertainty by axis and by distance, in 80 columns."""

from dataclasses import replace

import numpy as np

from lce_rig.cli.calibrate import uncertainty_lines
from lce_rig.core.results import Calibration, Certificate, Metrics, PointUncertainty


def calibration() -> Calibration:
    cov = np.diag(np.square([0.003, 0.004, 0.012, *np.radians([0.05, 0.12, 0.01])]))
    return Calibration(
        camera="cam",
        channel="frames",
        lidar="lidar",
        T_cam_lidar=np.eye(4),
        cov=cov,
        certificate=Certificate(True, 0.0),
        metrics=Metrics(0.005, 0.005, 0.1),
        n_captures=20,
        n_detected=20,
        captures_used=(),
        captures_refused={},
        verdict="pass",
        reasons=(),
        uncertainty=tuple(PointUncertainty(d, 123.4, 0.123 * d, 134.5, 0.234 * d) for d in (5.0, 10.0, 20.0)),
    )


def test_every_axis_and_distance_is_named_in_80_columns() -> None:
    lines = uncertainty_lines(calibration())
    assert "known to     0.130 deg, 13.0 mm (1 sigma)" in lines[0]
    assert "about x right 0.050, y down 0.120, z forward 0.010 deg" in lines[1]
    assert "along x right 3.0, y down 4.0, z forward 12.0 mm" in lines[2]
    assert lines[4].split() == ["a", "point", "5", "m", "away", "10", "m", "away", "20", "m", "away"]
    assert "123.4 px, 61.5 cm" in lines[5]
    assert "134.5 px, 117.0 cm" in lines[6]
    assert max(map(len, lines)) <= 80


def test_without_a_lens_only_the_axes_are_named() -> None:
    assert len(uncertainty_lines(replace(calibration(), uncertainty=()))) == 4
