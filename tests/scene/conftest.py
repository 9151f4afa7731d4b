"""A simulated room with exact truth, seen in four captures by a small camera and a VLP-16."""

from typing import NamedTuple

import numpy as np
import pytest

from lce_rig.core.calibration import Calibration
from lce_rig.rig import Rig, load_rig
from lce_rig.scene.outline_score import OutlineView
from lce_rig.scene.views import build_view
from lce_rig.session import Session
from lce_rig.simulate import SimulatedCapture, simulate_captures, truth_extrinsics
from tests.saved_results import made_calibration, write_result
from tests.shared import compute_once, half_size

COV = np.diag([0.003] * 3 + [0.0015] * 3) ** 2
SEED = 2


class Seen(NamedTuple):
    """The sensors' data, and the truth."""

    rig: Rig
    captures: list[SimulatedCapture]
    truth: Calibration
    views: list[OutlineView]


def small_rig(name="rlfs"):
    """A rig with a camera of half its resolution, which renders fast."""
    return half_size(load_rig(name))


def deployed(T_cam_lidar):
    """Make a result with given extrinsics."""
    return made_calibration(T_cam_lidar, COV, n_captures=4, n_detected=4)


def simulate_seen(rig, n_captures, seed):
    captures = list(simulate_captures(rig, n_captures=n_captures, seed=seed))
    truth = deployed(truth_extrinsics(rig, seed)["cam", "lidar"])
    views = [build_view(rig, truth, str(c.index), c.images[0], c.scans[0]) for c in captures]
    return Seen(rig, captures, truth, views)


@pytest.fixture(scope="session")
def seen():
    """Simulate the captures once."""
    return compute_once("scene", lambda: simulate_seen(small_rig(), 4, SEED))


@pytest.fixture(scope="session")
def room(seen, tmp_path_factory):
    """A session of the captures with the true extrinsics as its result."""
    path = tmp_path_factory.mktemp("scene") / "room"
    with Session.create(path, seen.rig) as session:
        for capture in seen.captures:
            session.add_capture(capture.images, capture.scans, {})
    write_result(path / "calibration" / "result.json", seen.rig.name, [seen.truth])
    return path
