"""Boards in view judge deployed extrinsics in all six axes together, and beside the scene."""

from dataclasses import replace

import numpy as np
import pytest

from lce_rig.core.calibration import MOTIONS, Calibration, State
from lce_rig.core.geometry import Array, perturb
from lce_rig.detect.detection import Detections
from lce_rig.judge.board_drift import BoardDrift, watch_boards
from lce_rig.judge.scene_drift import SceneDrift
from lce_rig.pipeline.pair_drift import PairDrift
from lce_rig.rig import load_rig
from lce_rig.scene.estimate import REACH, SceneEstimate
from tests.calibrate.boards import T_FORWARD, Scenario, simulate
from tests.saved_results import made_calibration

RIG = load_rig("rlfs")
SIGMAS = np.r_[np.full(3, 0.004), np.radians([0.08, 0.08, 0.04])]


def deployed(change: Array) -> Calibration:
    return made_calibration(perturb(T_FORWARD, change), np.diag(SIGMAS**2))


def seen_by(calibration: Calibration, seed: int) -> Detections:
    boards = simulate(15, seed, Scenario(laser_bias_sigma_m=0.008, footprint_m=0.006))
    images = {board.capture: board.image for board in boards}
    scans = {board.capture: [board.lidar] for board in boards}
    return Detections({(calibration.camera, "frames"): images}, {calibration.lidar: scans})


def watched(calibration: Calibration, seed: int) -> BoardDrift:
    found = watch_boards(RIG, calibration, "frames", seen_by(calibration, seed))
    assert found is not None
    return found


def test_board_drift_hidden_rotation_is_seen() -> None:
    hidden = np.array([0, 0.05, 0, np.radians(1.01), 0, 0])
    for seed in range(3):
        board = watched(deployed(hidden), seed)
        assert board.state == "changed"
        assert {"translation_y", "rotation_x"} & set(board.main_axes)
        assert "scene.board_changed_jointly" in [finding.code for finding in board.findings]


@pytest.mark.parametrize("seeds", [range(2), pytest.param(range(2, 6), marks=pytest.mark.long)])
def test_board_drift_unchanged_extrinsics_pass(seeds: range) -> None:
    for seed in seeds:
        board = watched(deployed(np.zeros(6)), seed)
        assert board.state == "unchanged"
        # Directions that boards do not determine are a note.
        assert [f.severity for f in board.findings if f.code == "scene.board_hides"] == ["note"]


@pytest.mark.parametrize(("board_deg", "state"), [(0.10, "unknown"), (0.9, "changed")])
def test_boards_refute_or_confirm_a_change_that_the_scene_sees(board_deg: float, state: State) -> None:
    calibration = deployed(np.zeros(6))
    change, cov = np.radians(1.2) * np.eye(6)[5], np.diag(SIGMAS**2)
    estimate = SceneEstimate(perturb(T_FORWARD, change), cov, "usable", 0.3, 5.0, 15, 4000, REACH)
    drift = SceneDrift(T_FORWARD, cov, estimate, 15)
    boards = BoardDrift(np.radians(board_deg) * np.eye(6)[5], 4 * cov, 2.5, 15, 15)
    pair = PairDrift(calibration, drift, boards, None)
    assert pair.state == state
    assert (pair.findings[0].code == "scene.contradiction") == (state == "unknown")


def test_board_drift_hidden_direction_is_unknown() -> None:
    sigmas = np.r_[np.full(3, 0.05), np.radians([0.05, 0.05, 0.05])]
    board = BoardDrift(np.zeros(6), np.diag(sigmas**2), 2.0, 3, 3)
    assert board.state == "unknown"
    assert [each.code for each in board.findings] == ["scene.board_hides"]
    assert board.findings[0].advice == "hold the board at more places"


def test_watch_boards_one_outlier_keeps_the_verdict() -> None:
    calibration = deployed(np.zeros(6))
    detections = seen_by(calibration, 1)
    (key, images), (lidar, scans) = *detections.images.items(), *detections.lidars.items()
    name = sorted(images)[0]
    shifted = replace(images[name], T_cam_board=perturb(images[name].T_cam_board, 0.2 * np.eye(6)[0]))
    board = watch_boards(
        RIG, calibration, "frames", Detections({key: {**images, name: shifted}}, {lidar: scans})
    )
    assert board is not None
    assert (board.n_boards, board.state) == (14, "unchanged")


@pytest.mark.parametrize("axis", range(6))
def test_watch_boards_moved_sensor_measures_the_change(axis: int) -> None:
    change = np.where(axis == np.arange(6), np.repeat([0.08, np.radians(3.0)], 3), 0.0)
    board = watched(deployed(-change), 2)
    error = board.tangent - change
    assert np.all(np.abs(error) < 4 * np.sqrt(np.diag(board.cov)))
    assert board.state == "changed"
    assert MOTIONS[axis] in board.main_axes


def test_board_drift_names_pitch_with_height() -> None:
    # Boards at one distance of 2.5 m see the sum of a height and 2.5 m times a pitch.
    inverse = np.diag(np.r_[np.full(3, 0.01), np.radians([0.1, 0.1, 0.1])] ** -2)
    seen = np.array([0.0, 1.0, 0.0, 2.5, 0.0, 0.0])
    pair = np.ix_([1, 3], [1, 3])
    inverse[pair] = np.outer(seen, seen)[pair] / 0.002**2 + np.diag([0.5**-2, 0.2**-2])
    board = BoardDrift(np.array([0.0, 0.06, 0.0, 0.0, 0.0, 0.0]), np.linalg.inv(inverse), 2.5, 15, 15)
    assert board.main_axes == ("translation_y", "rotation_x")
    assert board.findings[0].figures["translation_m"] == pytest.approx(0.03, abs=0.001)
