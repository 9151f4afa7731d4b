"""Overlay images: drawn and omitted marks, sizes and files."""

import cv2
import numpy as np
import pytest

from lce_rig.core.board import Board
from lce_rig.core.camera import Intrinsics
from lce_rig.core.data import Image, Scan
from lce_rig.core.errors import SessionError
from lce_rig.core.geometry import transform
from lce_rig.core.results import ImageBoard, LidarBoard
from lce_rig.detect.findings import IMAGE_TILTED
from lce_rig.show.overlays.canvas import MAGENTA, ORANGE, RED, with_note, write_picture
from lce_rig.show.overlays.debug_image import draw_debug
from lce_rig.show.overlays.overlay import draw_overlay
from tests.calibrate.boards import measured_plate

BOARD = Board(cols=8, rows=6, square_m=0.07, width_m=0.767, height_m=0.626)
FOLDING = Intrinsics(300.0, 300.0, 172.5, 129.5, 346, 260, "radtan", (-0.4, 0.0, 0.0, 0.0, 0.0))
LARGE = Intrinsics(1177.0, 1177.0, 960.0, 604.0, 1920, 1208, "equidistant", (-0.05, 0.0, 0.0, 0.0))
# LiDAR x forward, y left, z up; camera x right, y down, z forward; same place.
T_CAM_LIDAR = np.array([[0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0], [0, 0, 0, 1]], dtype=np.float64)
T_CAM_BOARD = np.array([[1, 0, 0, 0], [0, -1, 0, 0], [0, 0, -1, 2.0], [0, 0, 0, 1]], dtype=np.float64)


def scan_of(points):
    n = len(points)
    return Scan("lidar", None, points.astype(np.float32), np.zeros(n, np.float32), np.zeros(n, np.int16))


def wall(x_m=2.0):
    y, z = np.meshgrid(np.linspace(-0.38, 0.38, 39), np.linspace(-0.3, 0.3, 8))
    return np.stack([np.full(y.size, x_m), y.ravel(), z.ravel()], axis=1)


def grey(camera):
    return np.full((camera.height_px, camera.width_px), 128, np.uint8)


def image_board(camera):
    corners, _ = camera.project(transform(T_CAM_BOARD, BOARD.corners()))
    return ImageBoard(T_CAM_BOARD, np.eye(6) * 1e-6, None, np.inf, corners, 0.1, 0.07)


def lidar_board(points):
    T_lidar_board = np.linalg.inv(T_CAM_LIDAR) @ T_CAM_BOARD
    ends = points[np.abs(points[:, 1]) > 0.37]
    return LidarBoard(
        points=points,
        ring=np.zeros(len(points), np.int16),
        edge_points=ends,
        edge_ring=np.zeros(len(ends), np.int16),
        edge_side=np.ones(len(ends), np.int8),
        edge_behind_m=np.full(len(ends), np.inf),
        edge_echo=np.zeros(len(ends)),
        azimuth_step_rad=0.0035,
        plane=np.array([-1.0, 0, 0, 2.0]),
        sigma_m=0.01,
        T_lidar_board=T_lidar_board,
        quality=measured_plate(BOARD.width_m, BOARD.height_m, points),
    )


def overlay(camera, points, **boards):
    return draw_overlay(
        Image("cam", "frames", None, grey(camera)),
        scan_of(points),
        camera,
        T_CAM_LIDAR,
        lidar_board=boards.get("lidar"),  # type: ignore[arg-type]
        image_board=boards.get("image"),  # type: ignore[arg-type]
        board=BOARD,
    )


def count(drawn, colour):
    return int(np.all(np.abs(drawn.astype(int) - colour) < 20, axis=-1).sum())


@pytest.mark.parametrize("camera", [FOLDING, LARGE], ids=["346x260", "1920x1208"])
def test_points_board_and_ends_are_drawn_at_any_size(camera):
    points = wall()
    drawn = overlay(camera, points, lidar=lidar_board(points), image=image_board(camera))
    assert drawn.dtype == np.uint8 and drawn.shape[1] >= 960 and drawn.shape[1] % camera.width_px == 0
    assert count(drawn, MAGENTA) > 300
    assert count(drawn, ORANGE) > 50


def test_a_point_appears_where_the_camera_sees_it():
    part = overlay(FOLDING, np.array([[2.0, 0.4, 0.2]]))
    v, u = np.argwhere(np.any(part != 128, axis=-1)).mean(axis=0)
    truth, _ = FOLDING.project(np.array([-0.4, -0.2, 2.0]))
    assert (u, v) == pytest.approx(tuple((truth + 0.5) * 3 - 0.5), abs=0.8)


def test_overlay_hidden_points_are_not_drawn():
    """Behind the camera, or folded by the distortion."""
    behind = wall(-2.0)
    # At 60 deg r = 1.73, beyond the fold of 1 - 0.4 r^2 at r = 0.91, where the polynomial draws it at -0.35.
    folded = np.stack([np.ones(20), np.full(20, np.tan(np.radians(60))), np.linspace(-0.2, 0.2, 20)], axis=1)
    part = overlay(FOLDING, np.concatenate([behind, folded]))
    assert np.all(part == 128)


def test_near_points_cover_far_ones():
    far, near = wall(4.0) * [1, 2, 2], wall(2.0)
    both = overlay(FOLDING, np.concatenate([near, far]))
    swapped = overlay(FOLDING, np.concatenate([far, near]))
    assert np.array_equal(both, swapped)


@pytest.mark.parametrize("has_image", [True, False])
@pytest.mark.parametrize("has_lidar", [True, False])
def test_debug_image_is_drawn_from_available_data(has_image, has_lidar):
    points = wall()
    refusal = IMAGE_TILTED.refusal(tilt_deg=71.0, max_tilt_deg=70.0, turn_deg=6.0)
    drawn = draw_debug(
        Image("cam", "frames", None, grey(FOLDING)) if has_image else None,
        scan_of(points) if has_lidar else None,
        image_board(FOLDING) if has_image else refusal,
        [lidar_board(points), lidar_board(points - [0, 0.2, 0])] if has_lidar else refusal,
        board=BOARD,
        intrinsics=FOLDING,
        title="capture 000000",
    )
    assert drawn.shape[1] == 1600
    assert (count(drawn[:, 800:], MAGENTA) > 100) == has_lidar


def test_a_picture_reads_back_unchanged(tmp_path):
    drawn = overlay(FOLDING, wall())
    assert np.array_equal(cv2.imread(str(write_picture(tmp_path / "overlays" / "a.png", drawn))), drawn)


def test_unwritable_image_error_names_the_file(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(SessionError, match=r"file.a\.png"):
        write_picture(tmp_path / "file" / "a.png", np.zeros((4, 4, 3), np.uint8))


def test_with_note_adds_red_band_below():
    drawn = overlay(LARGE, wall())
    noted = with_note(drawn, "FAIL: ring ends 62 mm from the board's edges", RED)
    assert np.array_equal(noted[: len(drawn)], drawn)
    assert 0.6 < count(noted[len(drawn) :], RED) / noted[len(drawn) :, :, 0].size < 0.999
