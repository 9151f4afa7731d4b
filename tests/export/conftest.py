"""Results to export."""

from collections.abc import Callable

import numpy as np
import pytest

from lce_rig.collect.findings import CALIBRATE_KNOWN_PLACEMENT
from lce_rig.core.calibration import Calibration, Certificate, Diagnostics, Metrics
from lce_rig.core.findings import Finding
from lce_rig.core.geometry import exp_so3, pose
from lce_rig.detect.findings import LIDAR_TOO_FEW_RINGS
from lce_rig.judge.findings import LAST_REJECTED, ROTATION_UNCERTAIN
from lce_rig.rig import Rig, load_rig

Make = Callable[..., Calibration]


@pytest.fixture(scope="session")
def three_sensor_rig():
    """Two LiDARs, and three cameras with each kind of lens."""
    data = load_rig("rles").model_dump()
    data["name"] = "trio"
    front, back = data["lidars"]["lidar"], dict(data["lidars"]["lidar"], frame="velodyne_back")
    data["lidars"] = {"front": front, "back": back}
    davis = data["cameras"]["davis"]
    lens = dict(davis["intrinsics"], distortion=(-0.3, 0.1, 1e-3, -2e-5, 0.01, 0.02, -0.01, 0.003))
    fish = dict(davis["intrinsics"], model="equidistant", distortion=(-0.05, -0.07, 0.09, -0.05))
    data["cameras"]["left"] = dict(davis, intrinsics=lens, frame="left_link", optical_frame="left_optical")
    data["cameras"]["fish"] = dict(davis, intrinsics=fish, frame="fish_link", optical_frame="fish_optical")
    data["nominal_extrinsics"] = []
    return Rig.model_validate(data)


_UNCERTAIN = {
    "sigma_deg": 0.3,
    "target_deg": 0.2,
    "by_axis_deg": (0.1, 0.2, 0.2),
    "weakest": "rotation_x",
}


def calibration(T_cam_lidar=None, **changes):
    """Build a plausible result."""
    sides = np.diag([1e-3, 1e-3, 2e-3, 1e-4, 2e-4, 1e-4])
    mixing = np.eye(6) + 0.1 * np.ones((6, 6))
    fields = {
        "camera": "davis",
        "channels": ("frames",),
        "lidar": "lidar",
        "T_cam_lidar": some_pose() if T_cam_lidar is None else T_cam_lidar,
        "cov": sides @ mixing @ sides,
        "certificate": Certificate(True, 1.25e-9),
        "metrics": Metrics(0.009, 0.0085, 0.2),
        "n_captures": 4,
        "n_detected": 3,
        "captures_used": ("000000", "000002"),
        "captures_refused": {
            "000003": CALIBRATE_KNOWN_PLACEMENT.refusal(capture="000002", instruction="näher – ¼ m"),
            "000001": LIDAR_TOO_FEW_RINGS.refusal(n_rings=2, min_rings=4, distance_m=1.6, closer_m=0.8),
        },
        "verdict": "pass",
        "findings": (
            LAST_REJECTED(capture="000003"),
            ROTATION_UNCERTAIN(severity="warning", action="measure_ranges", **_UNCERTAIN),
        ),
        "diagnostics": Diagnostics(n_placements=4.0, fit_plane_rms_m=1 / 300),
    }
    return Calibration(**(fields | changes))


def reason(text):
    """A reason of a verdict that differs from others only in its words."""
    return Finding("verdict.text", figures={"text": text}, stored=(text, ""))


def some_pose(phi=(1.2, -1.3, 1.1), t=(0.12, -0.07, -0.08)):
    return pose(exp_so3(np.array(phi)), np.array(t))


@pytest.fixture(scope="session")
def make():
    """The builder of results; without arguments a plausible one of rig rles."""
    return calibration
