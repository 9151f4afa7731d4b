"""Two cameras with exchanged images do not pass."""

from dataclasses import replace
from pathlib import Path

import pytest

from lce_rig.calibrate import CalibrateOptions
from lce_rig.core.calibration import Calibration
from lce_rig.core.planar_pose import solve_planar_pose
from lce_rig.core.results import Observation
from lce_rig.detect.detection import Detections
from lce_rig.detect.image.search import board_from_pose
from lce_rig.pipeline.calibration import calibrate_detections
from lce_rig.rig import Rig, load_rig
from tests.calibrate.boards import BOARD
from tests.calibrate.two_cameras import LEFT, RIGHT, Session, simulate_two

RIG = load_rig(Path(__file__).parents[1] / "rigs/two_cameras.yaml")
LONGER = 1.04


def calibrated(rig: Rig, session: Session, names: tuple[str, str]) -> list[Calibration]:
    images = {
        (name, "frames"): {board.capture: board.image for board in session[camera]}
        for name, camera in zip((LEFT, RIGHT), names, strict=True)
    }
    scans = {board.capture: [board.lidar] for board in session[LEFT]}
    options = CalibrateOptions("paper")
    return calibrate_detections(rig, Detections(images, {"lidar": scans}), options)[0]


def exchanged(calibrations: list[Calibration]) -> list[tuple[object, ...]]:
    found = [f for c in calibrations for f in c.findings if f.code == "verdict.exchanged"]
    return [f.figures["fits"] for f in found]  # type: ignore[misc]


def with_longer_right_lens() -> Rig:
    right = RIG.cameras[RIGHT]
    lens = right.intrinsics.model_copy(
        update={"fx_px": LONGER * right.intrinsics.fx_px, "fy_px": LONGER * right.intrinsics.fy_px}
    )
    cameras = {**RIG.cameras, RIGHT: right.model_copy(update={"intrinsics": lens})}
    return RIG.model_copy(update={"cameras": cameras, "nominal_extrinsics": ()})


def through(rig: Rig, camera: str, source: str, board: Observation) -> Observation:
    """Take a board's image with the lens of one camera, and read it with that of another."""
    lens, profile = rig.cameras[camera].to_intrinsics(), rig.cameras[source].to_intrinsics()
    factor = lens.fx_px / RIG.cameras[LEFT].intrinsics.fx_px
    centre = [lens.cx_px, lens.cy_px]
    corners = centre + factor * (board.image.corners_px - centre)
    solved = solve_planar_pose(corners, BOARD.corners(), profile)
    assert solved is not None
    return replace(board, pose=board_from_pose(corners, solved))


@pytest.mark.long
def test_exchanged_like_cameras_are_found() -> None:
    session = simulate_two(12, 1)
    assert exchanged(calibrated(RIG, session, (LEFT, RIGHT))) == []
    found = calibrated(RIG, session, (RIGHT, LEFT))
    assert exchanged(found) == [("mounting",)] * 2
    assert {c.verdict for c in found} == {"fail"}
    assert {c.findings[0].code for c in found} == {"verdict.exchanged"}


@pytest.mark.long
def test_exchanged_other_lenses_are_found() -> None:
    rig, session = with_longer_right_lens(), simulate_two(16, 2)
    sound = {name: [through(rig, name, name, board) for board in session[name]] for name in (LEFT, RIGHT)}
    assert exchanged(calibrated(rig, sound, (LEFT, RIGHT))) == []
    wrong = {
        LEFT: [through(rig, LEFT, RIGHT, board) for board in session[LEFT]],
        RIGHT: [through(rig, RIGHT, LEFT, board) for board in session[RIGHT]],
    }
    assert exchanged(calibrated(rig, wrong, (RIGHT, LEFT))) == [("lenses",)] * 2
