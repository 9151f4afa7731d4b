"""The calibration of a session uses the rig's settings."""

from typing import get_args

import pytest

from lce_rig.calibrate import CalibrateOptions
from lce_rig.core.calibration import Method
from lce_rig.detect.detection import Detections
from lce_rig.pipeline.calibration import calibrate_detections
from lce_rig.rig import find_profile, parse_rig, set_value
from tests.calibrate.boards import simulate

RLFS = find_profile("rlfs").read_text(encoding="utf-8")


def sigma_m_with(*lines):
    """Calibrate simulated boards for an RLFS with these lines in its LiDAR's profile."""
    rig = parse_rig(RLFS.replace("    rate_hz: 10\n", "".join(f"    {line}\n" for line in lines), 1))
    (calibration,), _ = calibrate_detections(rig, found(), CalibrateOptions("ml"))
    return calibration.diagnostics.sigma_systematic_translation_m


def found():
    captures = simulate(10, 3)
    images = {item.capture: item.image for item in captures}
    return Detections({("cam", "frames"): images}, {"lidar": {c.capture: list(c.places) for c in captures}})


@pytest.mark.long
def test_lidar_range_errors_come_from_the_profile():
    exact = sigma_m_with("laser_bias_sigma_m: 0", "range_offset_sigma_m: 0")
    usual = sigma_m_with()
    assert 0 < exact < 0.9 * usual < 0.001


@pytest.mark.parametrize("method", get_args(Method))
def test_exact_profile_adds_no_covariance(method):
    text = RLFS
    for key in ("square_sigma_m", "pattern_offset_sigma_m", "plate_sigma_m", "bow_sigma_m"):
        text = set_value(text, f"board.{key}", "0.0")
    for key in ("focal_sigma_px", "principal_point_sigma_px", "distortion_sigma_px"):
        text = set_value(text, f"cameras.cam.intrinsics.{key}", "0.0")
    options = CalibrateOptions(method)
    (calibration,), _ = calibrate_detections(parse_rig(text), found(), options)
    # Contradictions may widen the covariance; lens and board add nothing.
    assert abs(calibration.cov_shared).max() < 1e-11  # of deviations of a micrometre
    assert 0 < calibration.sigma_translation_m < 0.02
