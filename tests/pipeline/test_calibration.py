"""The calibration of a session takes from the rig what the algorithm cannot know."""

from lce_rig import pipeline
from lce_rig.detect.detection import Detections
from lce_rig.extrinsics import CalibrateOptions
from lce_rig.rig import find_profile, parse_rig
from tests.extrinsics.boards import simulate

RLFS = find_profile("rlfs").read_text(encoding="utf-8")


def systematic_sigma_m(*lines: str) -> float:
    """Calibrate simulated boards for an RLFS whose LiDAR has these lines in its profile."""
    rig = parse_rig(RLFS.replace("    rate_hz: 10\n", "".join(f"    {line}\n" for line in lines), 1))
    captures = simulate(10, 3)
    images = {item.capture: item.image for item in captures}
    scans = {item.capture: list(item.lidar) for item in captures}
    detections = Detections({("cam", "frames"): images}, {"lidar": scans})
    (calibration,), _ = pipeline.calibrate_detections(rig, detections, CalibrateOptions("paper", n_draws=0))
    return calibration.diagnostics.sigma_systematic_translation_m


def test_the_lidars_range_errors_come_from_the_profile() -> None:
    exact = systematic_sigma_m("laser_bias_sigma_m: 0", "range_offset_sigma_m: 0")
    assert exact == 0
    usual = systematic_sigma_m()
    assert 0.003 < usual < 0.015
    coarse = systematic_sigma_m("laser_bias_sigma_m: 0.016", "range_offset_sigma_m: 0.01")
    assert coarse > 1.9 * usual
