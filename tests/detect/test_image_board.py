"""The board in a picture, judged on rendered boards with exact truth, damaged pictures and recordings."""

import json
from dataclasses import replace
from functools import cache

import cv2
import numpy as np
import pytest

from lce_rig.core.board import Board
from lce_rig.core.camera import Intrinsics
from lce_rig.core.errors import ProfileError
from lce_rig.core.geometry import difference, pose, rotation_angle, transform
from lce_rig.core.results import ImageBoard
from lce_rig.detect.image.search import find_image_board
from tests.detect.drawn_boards import (
    ASYMMETRIC,
    DAVIS,
    FISHEYE,
    SYMMETRIC,
    TALL,
    WIDE,
    draw,
    looking,
    picture,
)


def found(pixels, board, camera):
    result = find_image_board(picture(pixels), board, camera)
    assert isinstance(result, ImageBoard), result
    return result


def refused(pixels, board, camera):
    result = find_image_board(picture(pixels), board, camera)
    assert result.stage == "image"
    return result


FOLLOWED_FROM = looking(10, 80, 5, (0.1, 0, 2.2))
CASES = [
    pytest.param(ASYMMETRIC, DAVIS, looking(30, 20, 45, (0.05, 0.0, 1.6)), id="davis-near"),
    pytest.param(ASYMMETRIC, DAVIS, looking(35, -60, 130, (-0.2, 0.1, 3.0)), id="davis-far"),
    pytest.param(SYMMETRIC, WIDE, looking(25, 80, 40, (0.3, -0.1, 2.2)), id="wide"),
    pytest.param(TALL, FISHEYE, looking(30, 10, -35, (-0.5, 0.1, 2.4)), id="fisheye"),
]


@pytest.mark.parametrize(("board", "camera", "T"), CASES)
def test_image_board_corners_are_accurate(board, camera, T):
    """To 0.05 px RMS."""
    result = found(draw(board, camera, T), board, camera)
    truth, _ = camera.project(transform(T, board.corners()))
    error = result.corners_px - truth
    assert np.sqrt(np.mean(np.sum(error**2, axis=1))) < 0.05
    assert np.abs(error.mean(axis=0)).max() < 0.01
    offset = difference(result.T_cam_board, T)
    assert np.linalg.norm(offset[:3]) < 1e-3
    assert np.degrees(np.linalg.norm(offset[3:])) < 0.15
    assert result.distance_m == pytest.approx(np.linalg.norm(T[:3, 3]), rel=0.01)
    assert result.quality.n_corners == board.cols * board.rows


@pytest.mark.parametrize("roll_deg", range(0, 360, 60))
def test_image_board_corner_square_sets_turn(roll_deg):
    T = looking(20, 70, roll_deg, (0.0, 0.0, 1.7))
    result = found(draw(ASYMMETRIC, DAVIS, T), ASYMMETRIC, DAVIS)
    assert np.degrees(rotation_angle(result.T_cam_board[:3, :3], T[:3, :3])) < 1.0


@pytest.mark.parametrize("roll_deg", [0, 40, 140, 220])
def test_a_symmetric_board_is_read_with_its_top_row_up(roll_deg):
    T = looking(20, 70, roll_deg, (0.0, 0.0, 2.0))
    result = found(draw(SYMMETRIC, WIDE, T), SYMMETRIC, WIDE)
    assert result.T_cam_board[1, 1] < 0  # board y points up, camera y down
    assert result.T_cam_board[2, 2] < 0  # the print faces the camera
    half_turn = T @ pose(np.diag([-1.0, -1.0, 1.0]), np.zeros(3))
    apart = [np.degrees(rotation_angle(result.T_cam_board[:3, :3], R[:3, :3])) for R in (T, half_turn)]
    assert min(apart) < 1.0


def test_image_board_low_contrast_is_found():
    T = looking(25, 30, 45, (0.0, 0.0, 1.8))
    pixels = draw(ASYMMETRIC, DAVIS, T, black=105, white=135, noise=2.5)
    assert found(pixels, ASYMMETRIC, DAVIS).quality.contrast == pytest.approx(30, abs=6)


@cache
def _first_of_following(board):
    return found(draw(board, WIDE, FOLLOWED_FROM), board, WIDE)


SHIFTS = [(n, to) for n in (0.2, 0.6, 1.0, 1.4, 2.0) for to in ((1.0, 0.0), (0.0, 1.0), (1.0, 1.0))]


@pytest.mark.parametrize("board", [SYMMETRIC, ASYMMETRIC], ids=["symmetric", "asymmetric"])
@pytest.mark.parametrize(("n_squares", "direction"), [(0.0, (1.0, 0.0)), *SHIFTS])
def test_image_board_followed_equals_search(board, n_squares, direction):
    first = _first_of_following(board)
    shift = n_squares * board.square_m * np.array(direction)
    T_moved = FOLLOWED_FROM.copy()
    T_moved[:3, 3] += FOLLOWED_FROM[:3, :2] @ shift
    moved = picture(draw(board, WIDE, T_moved, noise=1.0))
    whole = find_image_board(moved, board, WIDE)
    followed = find_image_board(moved, board, WIDE, last=first)
    assert isinstance(followed, ImageBoard) and isinstance(whole, ImageBoard)
    off_px = followed.corners_px - whole.corners_px
    assert np.sqrt(np.mean(off_px**2)) < 0.03 and np.abs(off_px).max() < 0.15


@cache
def _first_of_a_quick_search(camera, z_m):
    return found(draw(ASYMMETRIC, camera, looking(10, 80, 5, (0.0, 0, z_m))), ASYMMETRIC, camera)


@pytest.mark.parametrize(
    ("camera", "z_m"), [(WIDE, 1.2), (WIDE, 3.0), (DAVIS, 1.6)], ids=["near", "far", "small picture"]
)
@pytest.mark.parametrize(("turn_deg", "closer"), [(0, 1.0), (12, 0.9), (-12, 1.1)])
def test_image_board_quick_search_follows(camera, z_m, turn_deg, closer):
    first = _first_of_a_quick_search(camera, z_m)
    shift_m = 1.5 * ASYMMETRIC.square_m
    T_moved = looking(10, 80, 5 + turn_deg, (shift_m, shift_m, closer * z_m))
    moved = picture(draw(ASYMMETRIC, camera, T_moved, noise=1.0))
    whole = find_image_board(moved, ASYMMETRIC, camera)
    quick = find_image_board(moved, ASYMMETRIC, camera, last=first, is_thorough=False)
    assert isinstance(quick, ImageBoard) and isinstance(whole, ImageBoard)
    assert np.abs(quick.corners_px - whole.corners_px).max() < 0.15


def test_image_board_moved_far_is_found():
    pixels = draw(SYMMETRIC, WIDE, looking(25, 80, 40, (0.5, 0, 2.2)))
    before = found(draw(SYMMETRIC, WIDE, looking(25, 80, 40, (-0.7, 0, 2.2))), SYMMETRIC, WIDE)
    result = find_image_board(picture(pixels), SYMMETRIC, WIDE, last=before)
    assert isinstance(result, ImageBoard)


@pytest.mark.parametrize("step", [(-1, 0), (0, 1), (1, 1)])
@pytest.mark.parametrize(("board", "camera", "T"), CASES[::2])
def test_wrong_inner_corners_are_named_with_those_seen(board, camera, T, step):
    wrong = replace(board, cols=board.cols + step[0], rows=board.rows + step[1])
    refusal = refused(draw(board, camera, T), wrong, camera)
    assert refusal.code == (
        "image.part" if min(wrong.cols - board.cols, wrong.rows - board.rows) >= 0 else "image.other_board"
    )
    assert refusal.figures == {
        "n_cols": wrong.cols,
        "n_rows": wrong.rows,
        "n_cols_seen": board.cols,
        "n_rows_seen": board.rows,
    }


def test_image_board_far_part_is_no_other():
    """The refusal does not name another corner count."""
    pixels = draw(SYMMETRIC, DAVIS, looking(40, 80, 45, (0, 0, 5.2)), seed=2, blur_px=1.2)
    refusal = refused(pixels, SYMMETRIC, DAVIS)
    assert refusal.code == "image.part" and "n_cols_seen" not in refusal.figures


def test_image_board_cut_by_border_is_reported():
    shifted = replace(WIDE, cx_px=1180.0)
    pixels = draw(SYMMETRIC, shifted, looking(5, 0, 5, (0.0, 0.0, 1.8)))
    refusal = refused(pixels, SYMMETRIC, shifted)
    assert (refusal.code, refusal.figures["side"]) == ("image.cut_off", "right")
    # A part of a pattern does not determine the number of its corners.
    assert "n_cols_seen" not in refusal.figures


@pytest.mark.long
def test_image_board_bad_images_are_refused():
    T = looking(20, 30, 40, (0, 0, 1.8))
    noise = np.random.default_rng(0).normal(0, 2, (260, 346))
    stripes = np.where(np.arange(346) // 20 % 2, 200, 40).astype(np.uint8)
    for pixels, code in (
        (np.clip(10 + noise, 0, 255).astype(np.uint8), "image.too_dark"),
        (np.full((260, 346), 255, np.uint8), "image.overexposed"),
        (np.clip(140 + noise, 0, 255).astype(np.uint8), "image.low_contrast"),
        (draw(ASYMMETRIC, DAVIS, T, blur_px=9.0), "image.blurred"),
        (np.tile(stripes, (260, 1)), "image.no_board"),
    ):
        refusal = refused(pixels, ASYMMETRIC, DAVIS)
        assert (refusal.code, refusal.action) == (code, "")


def test_empty_event_image_advises_motion():
    grey = np.clip(140 + np.random.default_rng(0).normal(0, 3, (260, 346)), 0, 255).astype(np.uint8)
    result = find_image_board(picture(grey, "events"), ASYMMETRIC, DAVIS, is_from_events=True)
    assert (result.code, result.action) == ("image.low_contrast", "events")


def test_image_board_other_size_is_refused():
    pixels = cv2.resize(draw(ASYMMETRIC, DAVIS, looking(20, 30, 40, (0, 0, 1.8))), (692, 520))
    with pytest.raises(ProfileError, match=r"692x520 px.*346x260 px") as raised:
        find_image_board(picture(pixels), ASYMMETRIC, DAVIS)
    assert "by 2" in raised.value.hint


def test_image_board_margin_changes_nothing():
    """A readout that is cut short does not either."""
    pixels = draw(ASYMMETRIC, DAVIS, looking(20, 30, 40, (0, 0, 1.8)))
    padded = np.full((480, 640), 128, np.uint8)
    padded[:260, :346] = pixels
    for variant in (padded, pixels[:258]):
        corners = found(variant, ASYMMETRIC, DAVIS).corners_px
        assert np.allclose(corners, found(pixels, ASYMMETRIC, DAVIS).corners_px, atol=0.01)


def test_image_board_other_lens_is_refused():
    pixels = draw(SYMMETRIC, WIDE, looking(30, 40, 40, (-0.5, 0.15, 1.2)))
    wrong = replace(WIDE, distortion=(0.3, 0.0, 0.0, 0.0))
    refusal = refused(pixels, SYMMETRIC, wrong)
    assert refusal.code == "image.misfit" and refusal.figure("rms_px") > refusal.figure("max_rms_px")
    assert (refusal.figures["width_px"], refusal.figures["height_px"]) == (1280, 720)


def _recording(folder):
    params = json.loads((folder / "params.json").read_text())
    spec, K = params["board"], params["K"]
    offset = tuple(spec.get("pattern_offset_m", (0.0, 0.0)))
    cols, rows = spec["inner_corners"]
    board = Board(cols, rows, spec["square_m"], spec["width_m"], spec["height_m"], (offset[0], offset[1]))
    model = "equidistant" if "model" in params else "radtan"
    size = params["image_size"]
    camera = Intrinsics(K[0][0], K[1][1], K[0][2], K[1][2], *size, model=model, distortion=tuple(params["D"]))
    return board, camera, sorted((folder / "img").iterdir())


def _find(path, board, camera):
    return find_image_board(picture(cv2.imread(str(path), cv2.IMREAD_UNCHANGED)), board, camera)


@pytest.mark.long
@pytest.mark.dataset
@pytest.mark.parametrize(
    ("name", "at_least", "median_px"),
    [
        ("rlfs01", 18, 0.1),
        ("sss_noise15mm", 20, 0.05),
        ("acfr_vlp16", 10, 0.2),
        ("rles01_lf", 19, 0.08),
        ("rles01_le", 36, 0.3),
        ("rles02_lf", 55, 0.12),
        ("rles02_le", 55, 0.25),
    ],
)
def test_boards_of_recordings_are_found(recordings, name, at_least, median_px):
    board, camera, paths = _recording(recordings / name)
    results = [_find(path, board, camera) for path in paths]
    boards = [result for result in results if isinstance(result, ImageBoard)]
    assert len(boards) >= at_least
    assert np.median([result.reprojection_px for result in boards]) < median_px


@pytest.mark.long
@pytest.mark.dataset
def test_frames_and_event_images_agree(recordings):
    board, camera, paths = _recording(recordings / "rles02_lf")
    angles = []
    for path in paths:
        twin = recordings / "rles02_le" / "img" / path.name
        pair = [_find(one, board, camera) for one in (path, twin) if one.exists()]
        if len(pair) == 2 and all(isinstance(one, ImageBoard) for one in pair):
            R = [one.T_cam_board[:3, :3] for one in pair if isinstance(one, ImageBoard)]
            angles.append(np.degrees(rotation_angle(*R)))
    assert len(angles) > 50
    assert max(angles) < 10  # the board is hand-held and moves a little between the two
