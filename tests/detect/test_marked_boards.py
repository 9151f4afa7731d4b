"""ChArUco boards and AprilGrids in pictures, judged on rendered boards with exact truth."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from lce_rig.core.board import Board
from lce_rig.core.camera import Intrinsics
from lce_rig.core.findings import Refusal
from lce_rig.core.geometry import Array, difference, pose, rotation_angle, transform
from lce_rig.core.pattern import markers_of
from lce_rig.core.results import ImageBoard
from lce_rig.detect.image.search import find_image_board
from tests.detect.drawn_boards import DAVIS, FISHEYE, WIDE, draw, looking, picture

CHECKERBOARD = Board(8, 6, 0.07, 0.767, 0.626)
CHARUCO = replace(CHECKERBOARD, type="charuco", marker_share=0.75, dictionary="5X5_100")
EVEN = replace(CHARUCO, cols=7, rows=5)
APRILGRID = Board(
    8, 6, 0.13, 0.767, 0.626, (0.004, -0.003), "aprilgrid", gap_share=0.3, dictionary="APRILTAG_36h11"
)
NEAR, FAR = looking(25, 40, 20, (0.1, 0, 1.6)), looking(35, 160, -50, (-0.3, 0.2, 3.0))


def covered(pixels: NDArray[np.uint8], board: Board, camera: Intrinsics, T: Array) -> NDArray[np.uint8]:
    """Cover 30 % of the pattern with grey paper."""
    w, h = np.array(board.pattern_size_m) * np.sqrt(0.3)
    low = np.array(board.pattern_size_m) / 2 - [w, h]
    paper = np.array([[0, 0, 0], [w, 0, 0], [w, h, 0], [0, h, 0]]) + [*low, 0]
    outline, _ = camera.project(transform(T, paper))
    return np.asarray(cv2.fillConvexPoly(pixels.copy(), np.rint(outline).astype(np.int32), 90))


def found(pixels: NDArray[np.uint8], board: Board, camera: Intrinsics) -> ImageBoard:
    result = find_image_board(picture(pixels), board, camera)
    assert isinstance(result, ImageBoard), result
    return result


def code(pixels: NDArray[np.uint8], board: Board) -> str:
    result = find_image_board(picture(pixels), board, WIDE)
    assert isinstance(result, Refusal)
    return result.code


@pytest.mark.parametrize("T", [NEAR, FAR], ids=["near", "far"])
@pytest.mark.parametrize("board", [CHARUCO, APRILGRID], ids=["charuco", "aprilgrid"])
@pytest.mark.parametrize("is_covered", [False, True], ids=["whole", "covered"])
def test_marked_board_corners_are_accurate(board, T, is_covered):
    """Covered boards too: as accurate as on a checkerboard."""
    pixels = draw(board, WIDE, T)
    result = found(covered(pixels, board, WIDE, T) if is_covered else pixels, board, WIDE)
    truth, _ = WIDE.project(transform(T, board.corners()))
    is_seen = np.isfinite(result.corners_px).all(axis=1)
    error_px = (result.corners_px - truth)[is_seen]
    assert is_seen.all() if not is_covered else 0.35 < is_seen.mean() < 0.8
    assert np.abs(error_px).max() < 0.15
    plain = found(draw(CHECKERBOARD, WIDE, T), CHECKERBOARD, WIDE)
    error_plain_px = plain.corners_px - WIDE.project(transform(T, CHECKERBOARD.corners()))[0]
    assert np.sqrt(np.mean(error_px**2)) < 1.5 * np.sqrt(np.mean(error_plain_px**2)) + 0.005
    off = difference(T, result.T_cam_board)
    assert np.linalg.norm(off[:3]) < 0.002 and np.linalg.norm(off[3:]) < np.radians(0.15)
    assert result.quality is not None and result.quality.n_corners == is_seen.sum()


@pytest.mark.parametrize("noise", [2.0, 8.0, 12.0])
def test_aprilgrid_noise_does_not_join_tags(noise):
    T = looking(25, 40, 20, (0.1, 0, 2.6))
    pixels = covered(draw(APRILGRID, WIDE, T, noise=noise), APRILGRID, WIDE, T)
    result = find_image_board(picture(pixels), APRILGRID, WIDE, is_thorough=False)
    assert isinstance(result, ImageBoard)
    assert np.linalg.norm(difference(T, result.T_cam_board)[:3]) < 0.005


@pytest.mark.parametrize("board", [CHARUCO, APRILGRID], ids=["charuco", "aprilgrid"])
def test_marked_board_is_found_at_low_contrast(board):
    pixels = draw(board, WIDE, NEAR)
    dim = np.rint(60 + 40.0 * (pixels / 255.0)).astype(np.uint8)
    assert np.isfinite(found(dim, board, WIDE).corners_px).mean() > 0.9


@pytest.mark.parametrize(("camera", "distance_m"), [(FISHEYE, 0.9), (DAVIS, 0.9)], ids=["fisheye", "davis"])
@pytest.mark.parametrize("board", [CHARUCO, APRILGRID], ids=["charuco", "aprilgrid"])
def test_strong_lenses_and_small_images_show_all_corners(board, camera, distance_m):
    T = looking(20, 70, 10, (0.05, 0, distance_m))
    result = found(draw(board, camera, T, blur_px=0.5), board, camera)
    error_px = result.corners_px - camera.project(transform(T, board.corners()))[0]
    assert np.isfinite(error_px).all() and np.abs(error_px).max() < 0.2


@pytest.mark.parametrize("roll_deg", [0, 90, 180, 270])
@pytest.mark.parametrize("board", [EVEN, APRILGRID], ids=["charuco", "aprilgrid"])
def test_markers_determine_orientation(board, roll_deg):
    T = looking(20, 70, roll_deg, (0, 0, 1.8))
    result = found(draw(board, WIDE, T), board, WIDE)
    assert rotation_angle(result.T_cam_board[:3, :3], T[:3, :3]) < np.radians(1)


def test_boards_drawn_by_opencv_are_read_in_either_layout():
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_5X5_100)
    for is_legacy in (False, True):
        drawn = cv2.aruco.CharucoBoard((8, 6), 0.07, 0.0525, dictionary)
        drawn.setLegacyPattern(is_legacy)
        pixels = cv2.GaussianBlur(drawn.generateImage((800, 600), marginSize=80), (0, 0), 0.8)
        lens = Intrinsics(900, 900, 399.5, 299.5, 800, 600, "radtan", (0.0,) * 4)
        result = found(np.asarray(pixels, dtype=np.uint8), EVEN, lens)
        grid = result.corners_px.reshape(5, 7, 2)
        assert np.all(np.diff(grid[..., 0], axis=1) > 70) and np.all(np.diff(grid[..., 1], axis=0) > 70)


def test_tags_with_a_border_of_one_module_are_read():
    pixels = np.full((700, 900), 230, np.uint8)
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)
    for number in range(12):
        u, v = 70 + 208 * (number % 4), 40 + 208 * (2 - number // 4)
        pixels[v : v + 160, u : u + 160] = cv2.aruco.generateImageMarker(dictionary, number, 160)
        for du, dv in ((-48, -48), (-48, 160), (160, -48), (160, 160)):
            pixels[max(v + dv, 0) : v + dv + 48, max(u + du, 0) : u + du + 48] = 0
    lens = Intrinsics(900, 900, 449.5, 349.5, 900, 700, "radtan", (0.0,) * 4)
    result = found(np.asarray(cv2.GaussianBlur(pixels, (0, 0), 0.8), dtype=np.uint8), APRILGRID, lens)
    np.testing.assert_allclose(result.corners_px[0], [69.5, 39.5], atol=0.1)


@pytest.mark.long
def test_marked_board_wrong_marks_are_named():
    pixels, grid = draw(CHARUCO, WIDE, NEAR), draw(APRILGRID, WIDE, NEAR)
    assert code(pixels, replace(CHARUCO, dictionary="6X6_100")) == "image.other_dictionary"
    assert code(grid, CHARUCO) == "image.other_dictionary"
    assert code(pixels, replace(CHARUCO, first_id=50)) == "image.other_ids"
    assert code(pixels, replace(CHARUCO, rows=4)) == "image.other_ids"
    assert code(grid, replace(APRILGRID, rows=4)) == "image.other_ids"
    assert code(grid, replace(APRILGRID, cols=10, rows=6)) == "image.other_layout"
    assert code(pixels, replace(CHARUCO, cols=9)) == "image.other_layout"
    assert code(draw(replace(CHARUCO, marker_share=0.5), WIDE, NEAR), CHARUCO) == "image.other_layout"
    assert code(draw(CHECKERBOARD, WIDE, NEAR), CHARUCO) == "image.no_board"


@pytest.mark.parametrize("T", [NEAR, FAR], ids=["near", "far"])
@pytest.mark.parametrize("stated", [0.2, 0.25, 0.28, 0.35, 0.4])
def test_aprilgrid_wrong_spacing_is_measured(stated, T):
    """Near the truth the corners would fit a pose within limits that is centimetres away."""
    pixels = covered(draw(APRILGRID, WIDE, T), APRILGRID, WIDE, T)
    result = find_image_board(picture(pixels), replace(APRILGRID, gap_share=stated), WIDE)
    assert isinstance(result, Refusal) and result.code == "image.other_spacing"
    assert result.figure("share") == pytest.approx(APRILGRID.gap_share, abs=0.005)


@pytest.mark.parametrize("part", [0.2, 0.5])
def test_aprilgrid_wrong_lens_is_not_spacing(part):
    lens = replace(WIDE, distortion=tuple(part * c for c in WIDE.distortion))
    for board in (APRILGRID, replace(APRILGRID, cols=4, rows=4, square_m=0.2)):
        pixels = draw(board, lens, looking(15, 40, 20, (0.2, 0, 1.3)))
        result = find_image_board(picture(pixels), board, replace(WIDE, distortion=(0.0,) * 4))
        assert isinstance(result, ImageBoard) or result.code == "image.misfit"


@pytest.mark.long
@pytest.mark.parametrize("family", ["APRILTAG_25h9", "APRILTAG_36h10"])
def test_another_family_of_apriltags_is_named(family):
    result = find_image_board(
        picture(draw(replace(APRILGRID, dictionary=family), WIDE, NEAR)), APRILGRID, WIDE
    )
    assert isinstance(result, Refusal) and result.code == "image.other_dictionary"
    assert result.figures["seen_dictionary"] == family


@pytest.mark.long
def test_charuco_second_board_is_refused():
    other = replace(CHARUCO, first_id=40)
    left, right = looking(10, 0, 0, (-0.45, 0, 1.8)), looking(10, 0, 0, (0.45, 0, 1.8))
    pixels, beside = draw(CHARUCO, WIDE, left), draw(other, WIDE, right)
    pixels[:, 640:] = beside[:, 640:]
    assert code(pixels, CHARUCO) == "image.other_ids"


def test_few_corners_are_refused():
    pixels = draw(CHARUCO, WIDE, NEAR)
    markers = markers_of(CHARUCO).corners.reshape(-1, 3)
    keep, _ = WIDE.project(transform(NEAR, markers[:8]))
    mask = cv2.fillConvexPoly(np.zeros_like(pixels), cv2.convexHull(np.rint(keep).astype(np.int32)), 1)
    mask = cv2.dilate(mask, np.ones((5, 5), np.uint8))
    assert code(np.where(mask > 0, pixels, 150).astype(np.uint8), CHARUCO) == "image.few_corners"


@pytest.mark.parametrize("board", [CHARUCO, APRILGRID], ids=["charuco", "aprilgrid"])
@pytest.mark.parametrize("is_covered", [False, True], ids=["whole", "covered"])
def test_marked_board_is_tracked(board, is_covered):
    """Moved by a little, and by whole squares or tags, where crossings of the same colours are."""

    def seen(T):
        pixels = draw(board, WIDE, T)
        return covered(pixels, board, WIDE, T) if is_covered else pixels

    last = found(seen(NEAR), board, WIDE)
    unit_m = board.square_m * (1 if board.type == "charuco" else 1 + board.gap_share)
    for shift_m in ([0.004, 0.002, 0.0], [unit_m, unit_m, 0.0], [-unit_m, unit_m, 0.0], [-2 * unit_m, 0, 0]):
        T = NEAR @ pose(np.eye(3), np.array(shift_m))
        result = find_image_board(picture(seen(T)), board, WIDE, last=last)
        assert isinstance(result, ImageBoard)
        truth, _ = WIDE.project(transform(T, board.corners()))
        assert np.nanmax(np.abs(result.corners_px - truth)) < 0.15
        assert np.linalg.norm(result.T_cam_board[:3, 3] - T[:3, 3]) < 0.003
