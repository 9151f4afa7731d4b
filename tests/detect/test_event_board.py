"""The board in raw events: followed where it truly is, and where it is not seen, the cause is named."""

import numpy as np
import pytest
from moving_board import (
    CENTRE_PX,
    COLS,
    HEIGHT_PX,
    ROWS,
    SQUARE_PX,
    WIDTH_PX,
    Motion,
    board_events,
    events_of,
    join,
    lamps,
    noise,
)

from lce_rig.core.board import Board
from lce_rig.core.camera import Intrinsics
from lce_rig.core.data import Image
from lce_rig.core.results import ImageBoard
from lce_rig.detect.events.figures import gate_event_board
from lce_rig.detect.events.reconstructor import Reconstructor
from lce_rig.detect.events.search import TRACK_NS, find_event_board
from lce_rig.detect.image.search import find_image_board
from lce_rig.rig import QualitySettings

MS = 1_000_000
SQUARE_M, DEPTH_M = 0.07, 1.0
# The board of these scenes is 0.4 squares wider than its print on every side, and faces the camera.
BOARD = Board(COLS - 1, ROWS - 1, SQUARE_M, (COLS + 0.8) * SQUARE_M, (ROWS + 0.8) * SQUARE_M)
FOCAL_PX = SQUARE_PX / SQUARE_M * DEPTH_M
CAMERA = Intrinsics(FOCAL_PX, FOCAL_PX, *CENTRE_PX, WIDTH_PX, HEIGHT_PX)
LIMITS = QualitySettings(min_distance_m=0.5)
STAMP = 1_200 * MS
STEADY = Motion()


@pytest.fixture(scope="module")
def stream():
    return board_events(STEADY, 1.4)


@pytest.fixture(scope="module")
def detection(stream):
    return find(stream, sweep_s=0.02)


def find(events, stamp_ns=STAMP, limits=LIMITS, **more):
    return find_event_board(events, stamp_ns, Reconstructor(), BOARD, CAMERA, limits, **more)


def truth_m(stamp_ns):
    """Position of the board's middle in the camera's x and y."""
    return STEADY.shift_px(stamp_ns * 1e-9) / FOCAL_PX * DEPTH_M


def test_event_board_track_matches_truth(detection):
    picture, board = detection
    assert isinstance(picture, Image) and isinstance(board, ImageBoard)
    assert picture.stamp_ns == board.stamp_ns == STAMP
    assert board.track_ns.tolist() == [STAMP + offset for offset in TRACK_NS]
    assert board.track_T_cam_board.shape == (4, 4, 4) and board.track_cov.shape == (4, 6, 6)
    for stamp_ns, T in zip(
        [STAMP, *board.track_ns], [board.T_cam_board, *board.track_T_cam_board], strict=True
    ):
        # 0.5 px at this distance is 2.5 mm.
        assert np.linalg.norm(T[:2, 3] - truth_m(stamp_ns)) < 0.0025
        assert np.arccos(np.clip(-T[2, 2], -1, 1)) < np.radians(8)


def test_event_board_speed_and_smear_match_truth(detection):
    # The mean motion over the track: the board turns on its figure of eight meanwhile.
    stamps = STAMP + np.array([0, *TRACK_NS])
    places = np.array([truth_m(stamp) for stamp in stamps])
    seconds = (stamps - STAMP) * 1e-9
    velocity = np.polyfit(seconds, places, 1)[0]
    quality = detection[1].events
    assert quality.speed_mps == pytest.approx(np.linalg.norm(velocity), abs=0.02)
    assert quality.smear_m == pytest.approx(0.02 * quality.speed_mps)
    assert quality.turn_deg_s < 25


def test_events_are_counted_on_the_board_only(stream, detection):
    quality = detection[1].events
    on_board = (BOARD.width_m * BOARD.height_m) * (FOCAL_PX / DEPTH_M) ** 2
    recent = stream.between(STAMP - 100 * MS, STAMP)
    # Only the board generates events here, apart from 0.3 noise events per second and pixel.
    assert quality.events_px_s * on_board == pytest.approx(len(recent) / 0.1, rel=0.1)
    assert quality.events_px > 3


@pytest.mark.parametrize(
    ("events", "code", "figures"),
    [
        (lambda s: s.between(0, 0), "read.no_events", {}),
        (lambda s: s.between(1_100 * MS, 1_400 * MS), "read.network_settling", {}),
        (lambda s: s.between(0, 700 * MS), "read.outside_events", {"gap_s": pytest.approx(0.5, abs=1e-3)}),
        (lambda _: noise(0.8), "image.hardly_moved", {}),
        (lambda _: noise(0.005), "image.hardly_moved", {}),
        (lambda _: join(noise(0.3), lamps(100)), "image.flicker", {}),
    ],
)
def test_event_board_none_names_the_cause(stream, events, code, figures):
    board = find(events(stream))[1]
    assert board.code == code
    assert {name: board.figures[name] for name in figures} == figures


def test_hot_pixels_do_not_hide_the_board(stream):
    rng = np.random.default_rng(2)
    n_each, n_hot = 1_500, 25
    t_us = rng.integers(0, 1_400_000, n_each * n_hot)
    x, y = rng.integers(0, WIDTH_PX, n_hot), rng.integers(0, HEIGHT_PX, n_hot)
    hot = events_of(t_us * 1000, np.repeat(x, n_each), np.repeat(y, n_each), rng.random(len(t_us)) < 0.5)
    board = find(join(noise(0.3), hot))[1]
    assert (board.code, board.figures["n_hot"]) == ("image.hot_pixels", 25)
    assert isinstance(find(join(stream, hot))[1], ImageBoard)


@pytest.mark.parametrize(
    ("limit", "code", "figure"),
    [
        ({"max_board_speed_mps": 0.05}, "image.too_fast", "max_speed_mps"),
        ({"min_events_px": 1e3}, "image.hardly_moved", "min_events_px"),
        ({"min_event_contrast": 300.0}, "image.low_contrast", "min_contrast"),
    ],
)
def test_profile_limits_refuse_with_their_figures(detection, limit, code, figure):
    limits = LIMITS.model_copy(update=limit)
    board = find_image_board(detection[0], BOARD, CAMERA, limits=limits, is_from_events=True)
    if isinstance(board, ImageBoard):
        board = gate_event_board(detection[1], limits)
    assert (board.code, board.figures[figure]) == (code, *limit.values())


def test_event_board_far_motion_is_too_fast(detection):
    board = gate_event_board(detection[1], LIMITS.model_copy(update={"max_smear_m": 1e-3}))
    assert board.code == "image.too_fast" and board.figures["max_speed_mps"] == pytest.approx(0.05)


def test_event_gate_without_events_passes(detection):
    bare = find_image_board(detection[0], BOARD, CAMERA, limits=LIMITS, is_from_events=True)
    assert gate_event_board(bare, LIMITS) is bare


def test_event_board_wide_edges_are_refused(detection):
    limits = LIMITS.model_copy(update={"min_event_sharpness": 50.0})
    refusal = find_image_board(detection[0], BOARD, CAMERA, limits=limits, is_from_events=True)
    assert refusal.code == "image.blurred"
    assert refusal.figures["max_edge_px"] == pytest.approx(SQUARE_PX / 50, rel=0.05)
