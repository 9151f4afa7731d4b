"""Simulated sessions: truth, placements, decoys and repeatability, for sensors mounted anyhow."""

from typing import Any

import numpy as np
import pytest

from lce_rig.core.errors import LceRigError, ProfileError
from lce_rig.core.geometry import invert, rotation_angle, transform
from lce_rig.simulate import simulate_captures, truth_extrinsics
from tests.shared import compute_once

from .conftest import make_rig

N_CAPTURES = 4


@pytest.fixture(scope="module")
def rig():
    return make_rig()


@pytest.fixture(scope="module")
def captures(rig):
    return compute_once("captures", lambda: list(simulate_captures(rig, n_captures=N_CAPTURES, seed=11)))


def corners_px(rig, camera, capture):
    corners = transform(capture.T_cam_board[camera], rig.board.to_board().corners())
    return rig.cameras[camera].to_intrinsics().project(corners)[0]


def n_rings_on_board(rig, lidar, capture):
    board = rig.board.to_board()
    scan = next(scan for scan in capture.scans if scan.sensor == lidar)
    xyz = transform(invert(capture.T_lidar_board[lidar]), scan.points.astype(float))
    inside = np.all(np.abs(xyz) < [board.width_m / 2, board.height_m / 2, 0.05], axis=1)
    return int(np.sum(np.bincount(scan.ring[inside], minlength=16) >= 5))


def test_truth_is_within_nominal_tolerance(rig):
    entry = rig.nominal_extrinsics[0]
    nominal = entry.to_matrix()
    truths = [truth_extrinsics(rig, seed)["cam", "lidar"] for seed in range(20)]
    angles = np.degrees([rotation_angle(T[:3, :3], nominal[:3, :3]) for T in truths])
    shifts = np.array([np.linalg.norm(T[:3, 3] - nominal[:3, 3]) for T in truths])
    assert angles.min() > 0.5 and angles.max() < entry.tolerance_deg
    assert shifts.min() > 0.005 and shifts.max() < entry.tolerance_m
    assert not np.allclose(truths[0], truths[1])


def test_simulated_rig_of_paper_has_exact_extrinsics():
    rig = make_rig("sss")
    assert np.allclose(
        truth_extrinsics(rig, 3)["cam", "lidar"], rig.nominal_extrinsics[0].to_matrix(), atol=1e-12
    )


def test_boards_are_visible_and_spread(rig, captures):
    """Tilted, too, and on enough rings."""
    lens = rig.cameras["cam"].to_intrinsics()
    for capture in captures:
        assert lens.is_inside(corners_px(rig, "cam", capture), 2.0).all()
        assert n_rings_on_board(rig, "lidar", capture) >= 5
        distance_m = np.linalg.norm(capture.T_cam_board["cam"][:3, 3])
        assert 1.2 <= distance_m <= 4.0
    middles = np.array([corners_px(rig, "cam", capture).mean(axis=0) for capture in captures])
    assert np.all(np.ptp(middles, axis=0) > [100, 50])
    normals = np.array([capture.T_cam_board["cam"][:3, 2] for capture in captures])
    angles = np.degrees(np.arccos(np.clip(normals @ normals.T, -1, 1)))
    assert angles.max() > 25


def test_same_seed_gives_the_same_bytes(rig, captures):
    again = list(simulate_captures(rig, n_captures=1, seed=11))
    for one, other in zip(captures, again, strict=False):
        assert one.images[0].pixels.tobytes() == other.images[0].pixels.tobytes()
        assert one.scans[0].points.tobytes() == other.scans[0].points.tobytes()
        assert one.T_cam_board["cam"].tobytes() == other.T_cam_board["cam"].tobytes()
    different = next(simulate_captures(rig, n_captures=1, seed=12))
    assert different.scans[0].points.tobytes() != captures[0].scans[0].points.tobytes()


def nominal(camera, **rotation):
    return {"camera": camera, "lidar": "lidar", "translation_m": (0.05, -0.08, -0.1), **rotation}


MOUNTS: dict[str, dict[str, Any]] = {
    # Rows are the camera's right, down and forward axes in the frame of the LiDAR.
    "rear": {"matrix": ((0.0, 1.0, 0.0), (0.0, 0.0, -1.0), (-1.0, 0.0, 0.0))},
    "upside down": {"matrix": ((0.0, 1.0, 0.0), (0.0, 0.0, 1.0), (1.0, 0.0, 0.0))},
    "on its side, looking left": {"matrix": ((0.0, 0.0, 1.0), (1.0, 0.0, 0.0), (0.0, 1.0, 0.0))},
}  # fmt: skip


@pytest.mark.parametrize("mount", sorted(MOUNTS))
def test_cameras_of_any_mounting_see_the_board(mount):
    rig = make_rig(nominal_extrinsics=(nominal("cam", **MOUNTS[mount]),))
    for capture in simulate_captures(rig, n_captures=1, seed=0):
        assert rig.cameras["cam"].to_intrinsics().is_inside(corners_px(rig, "cam", capture)).all()
        assert n_rings_on_board(rig, "lidar", capture) >= 4


def test_two_cameras_take_turns_as_target():
    one = make_rig()
    cameras = {
        "left": {**one.cameras["cam"].model_dump(), "frame": "left", "optical_frame": "left_optical"},
        "rear": {**one.cameras["cam"].model_dump(), "frame": "rear", "optical_frame": "rear_optical"},
    }
    entries = (nominal("left", quaternion_wxyz=(0.5, 0.5, -0.5, 0.5)), nominal("rear", **MOUNTS["rear"]))
    rig = make_rig(cameras=cameras, nominal_extrinsics=entries)
    captures = list(simulate_captures(rig, n_captures=2, seed=0))
    assert [capture.target for capture in captures] == [("left", "lidar"), ("rear", "lidar")]
    for capture in captures:
        assert [image.sensor for image in capture.images] == ["left", "rear"]
        lens = rig.cameras[capture.target[0]].to_intrinsics()
        assert lens.is_inside(corners_px(rig, capture.target[0], capture)).all()
    assert set(truth_extrinsics(rig, 0)) == {("left", "lidar"), ("rear", "lidar")}


def test_unsupported_lidar_is_named(rig):
    odd = make_rig(lidars={"lidar": {"model": "XY-64"}})
    with pytest.raises(ProfileError, match=r"lidars\.lidar\.model") as caught:
        next(simulate_captures(odd, n_captures=1, seed=0))
    assert "OS1-64" in caught.value.hint


def test_lidar_without_view_is_refused():
    ceiling = nominal("cam", matrix=((0.0, -1.0, 0.0), (1.0, 0.0, 0.0), (0.0, 0.0, 1.0)))
    with pytest.raises(LceRigError):
        next(simulate_captures(make_rig(nominal_extrinsics=(ceiling,)), n_captures=1, seed=0))
