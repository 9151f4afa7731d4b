"""Results of simulated boards, with all that a report shows."""

from pathlib import Path

import pytest

from lce_rig.calibrate import CalibrateOptions
from lce_rig.core.calibration import Calibration
from lce_rig.detect.detection import Detections
from lce_rig.pipeline.calibration import calibrate_detections
from lce_rig.rig import Rig, load_rig
from lce_rig.show.report.calibration_page import calibration_page
from tests.calibrate.boards import simulate
from tests.calibrate.two_cameras import simulate_two

RLFS = load_rig("rlfs")
TWO = load_rig(str(Path(__file__).parents[2] / "rigs" / "two_cameras.yaml"))


def overlay_of(c: Calibration, capture: str) -> list[str]:
    return [f"overlays/{c.camera}/{capture}.png"]


def page(rig: Rig, *calibrations: Calibration) -> str:
    return calibration_page(rig, calibrations, facts=[("rig", rig.name)], overlays=overlay_of)


@pytest.fixture(scope="session")
def one() -> Calibration:
    """One camera."""
    captures = simulate(12, 3)
    images = {item.capture: item.image for item in captures}
    scans = {item.capture: list(item.places) for item in captures}
    seen = Detections({("cam", "frames"): images}, {"lidar": scans})
    (calibration,), _ = calibrate_detections(RLFS, seen, CalibrateOptions(n_draws=0))
    return calibration


@pytest.fixture(scope="session")
def two() -> list[Calibration]:
    """Two cameras that saw the same boards, estimated together."""
    session = simulate_two(12, 0)
    images = {(name, "frames"): {c.capture: c.image for c in own} for name, own in session.items()}
    seen = Detections(images, {"lidar": {c.capture: list(c.places) for c in next(iter(session.values()))}})
    calibrations, _ = calibrate_detections(TWO, seen, CalibrateOptions("ml", n_draws=0))
    return calibrations


@pytest.fixture(scope="session")
def one_page(one: Calibration) -> str:
    return page(RLFS, one)


@pytest.fixture(scope="session")
def two_page(two: list[Calibration]) -> str:
    return page(TWO, *two)
