"""Results of simulated boards, with all that a report shows."""

from pathlib import Path

import numpy as np
import pytest

from lce_rig.calibrate import CalibrateOptions
from lce_rig.core.data import Image
from lce_rig.detect.detection import Detections
from lce_rig.pipeline.calibration import calibrate_detections
from lce_rig.rig import load_rig
from lce_rig.session import Session
from lce_rig.show.report.calibration_page import report_page
from tests.calibrate.boards import simulate
from tests.calibrate.two_cameras import simulate_two
from tests.saved_results import result_file
from tests.shared import compute_once

RLFS = load_rig("rlfs")
TWO = load_rig(str(Path(__file__).parents[2] / "rigs" / "two_cameras.yaml"))


@pytest.fixture(scope="session")
def page(tmp_path_factory):
    """Write the report of a rig's results, with a session of one uniform image per camera."""

    def write(rig, *calibrations, **options):
        path = tmp_path_factory.mktemp("report") / "s"
        with Session.create(path, rig) as session:
            for k in range(12):
                images = [
                    Image(name, "frames", k, np.full(camera.resolution_px[::-1], 80 + k, np.uint8))
                    for name, camera in rig.cameras.items()
                ]
                session.add_capture(images, [], {})
            return report_page(session, result_file(rig.name, calibrations), "overlays", **options)

    return write


@pytest.fixture(scope="session")
def one():
    """One camera."""
    return compute_once("report_one", _calibrate_one)


@pytest.fixture(scope="session")
def two():
    """Two cameras that saw the same boards, estimated together."""
    return compute_once("report_two", _calibrate_two)


def _calibrate_one():
    captures = simulate(12, 3)
    images = {item.capture: item.image for item in captures}
    scans = {item.capture: list(item.places) for item in captures}
    seen = Detections({("cam", "frames"): images}, {"lidar": scans})
    (calibration,), _ = calibrate_detections(RLFS, seen, CalibrateOptions())
    return calibration


def _calibrate_two():
    session = simulate_two(12, 0)
    images = {(name, "frames"): {c.capture: c.image for c in own} for name, own in session.items()}
    seen = Detections(images, {"lidar": {c.capture: list(c.places) for c in next(iter(session.values()))}})
    calibrations, _ = calibrate_detections(TWO, seen, CalibrateOptions("ml"))
    return calibrations


@pytest.fixture(scope="session")
def one_page(page, one):
    return page(RLFS, one)


@pytest.fixture(scope="session")
def two_page(page, two):
    return page(TWO, *two)
