"""Boards and scene in one estimate: what the scene adds, and when it may not."""

from dataclasses import replace

import numpy as np

import lce_rig as lce
from lce_rig.core.geometry import difference, invert, perturb, transform
from lce_rig.pipeline.witness import scene_views, share_of
from lce_rig.scene.views import without_movers
from lce_rig.session import Session

from .conftest import deployed

WEAK = np.diag([0.01, 0.03, 0.02, *np.radians([0.3, 0.5, 0.3])]) ** 2


def boards_alone(seen, tangent, cov, shared=None):
    """A board result that is off by a tangent and claims a covariance, some of it by lens and print."""
    off = deployed(perturb(seen.truth.T_cam_lidar, tangent))
    return replace(off, cov=cov, cov_shared=0 * cov if shared is None else shared)


def share(seen, calibration, views=None):
    lens = seen.rig.cameras["cam"].to_intrinsics()
    return share_of(without_movers(seen.views if views is None else views), lens, calibration)


def yaw_error_deg(seen, T):
    return float(abs(np.degrees(difference(T, seen.truth.T_cam_lidar)[4])))


def test_a_weak_board_result_is_moved_towards_the_truth_and_claims_less(seen):
    off = np.array([0.0, 0.0, 0.0, 0.0, np.radians(0.7), 0.0])
    calibration = boards_alone(seen, off, WEAK)
    found = share(seen, calibration)
    assert found.state == "used" and found.n_directions >= 1
    assert yaw_error_deg(seen, found.T_cam_lidar) < 0.3 < yaw_error_deg(seen, calibration.T_cam_lidar)
    assert found.cov[4, 4] < 0.5 * WEAK[4, 4]
    assert np.allclose(perturb(found.T_cam_lidar_boards, found.change), found.T_cam_lidar, atol=1e-9)


def test_a_strong_board_result_stays(seen):
    strong = boards_alone(seen, np.zeros(6), WEAK * 1e-6)
    found = share(seen, strong)
    assert found.state == "unknown" and found.n_directions == 0
    assert np.abs(found.change).max() < 1e-4


def test_a_scene_that_contradicts_the_boards_is_not_used(seen):
    off = np.array([0.0, 0.0, 0.0, 0.0, np.radians(1.5), 0.0])
    found = share(seen, boards_alone(seen, off, np.diag([0.005] * 3 + [np.radians(0.15)] * 3) ** 2))
    assert found.state == "contradicts" and found.surprise > 10


def test_the_scene_does_not_reduce_errors_of_lens_and_print(seen):
    shared = np.diag([0.004, 0.004, 0.004, *np.radians([0.3, 0.3, 0.3])]) ** 2
    off = np.array([0.0, 0.0, 0.0, 0.0, np.radians(0.7), 0.0])
    whole, split = (share(seen, boards_alone(seen, off, WEAK + shared, part)) for part in (None, shared))
    assert np.linalg.eigvalsh(split.cov - shared).min() > 0
    assert split.cov[4, 4] > whole.cov[4, 4]
    # What it may share with the boards is not counted against the scene.
    assert split.surprise < share(seen, boards_alone(seen, off, WEAK)).surprise


def test_the_board_is_left_out(seen, room):
    session = Session.open(room)
    views = scene_views(session, lce.detect(session), seen.truth, 60)
    assert [view.capture for view in views] == [capture.name for capture in session.captures]
    size_m = np.array([seen.rig.board.width_m, seen.rig.board.height_m])
    for view, capture in zip(views, seen.captures, strict=True):
        on_board = transform(invert(capture.T_lidar_board["lidar"]), view.edges.points)
        is_near = np.all(np.abs(on_board) < [*(0.5 * size_m + 0.03), 0.1], axis=1)
        assert len(view.edges) > 20 and not is_near.any()
