"""Which moments of a moving board become captures for an event camera, and why others do not."""

from dataclasses import replace

import numpy as np
import pytest

from lce_rig.collect.board_tracker import BoardDetection
from lce_rig.collect.gates import MotionGate, StillnessGate, find_moments
from lce_rig.collect.placement_dedupe import Placements
from lce_rig.core.board import Board
from lce_rig.core.findings import Losses, Refusal

from .event_sightings import event_stream, watch

PLENTY = event_stream([(-1.3, 6.0, 6.0)])
SOME = event_stream([(-1.3, 6.0, 2.0)])


def choose(detections, rles, **options):
    tally = Losses()
    moments = find_moments(detections, MotionGate(rles, Placements(0.15, 10.0), tally, **options))
    return list(moments), tally.by_code()


def places_m(moments):
    return [float(m.detection.images["davis", "frames"].T_cam_board[0, 3]) for m in moments]


def test_slow_board_is_captured_once_per_placement(rles):
    moments, refused = choose(watch(rles, lambda t: (0.1 * t - 0.25, 0.0), 5.0, SOME), rles)
    assert len(moments) in (3, 4) and not refused
    assert np.diff(places_m(moments)).min() >= 0.15
    for moment in moments:
        assert moment.figures["speed_mps"] == pytest.approx(0.1, abs=0.001)
        assert moment.figures["unsteady_m"] < 1e-3
        assert moment.figures["events_px"] == pytest.approx(2.0, rel=0.05)


@pytest.mark.parametrize(
    ("speed_mps", "rate", "lamp_hz", "code"),
    [
        (0.0, 0.2, 0.0, "image.hardly_moved"),
        (0.8, 6.0, 0.0, "image.too_fast"),
        (0.1, 0.3, 0.0, "image.few_events"),
        (0.0, 8.0, 100.0, "image.flicker"),
    ],
)
def test_motion_useless_boards_are_refused(rles, speed_mps, rate, lamp_hz, code):
    stream = event_stream([(-1.3, 3.0, rate)], lamp_hz=lamp_hz)
    detections = watch(rles, lambda t: (speed_mps * (t - 0.5), 0.0), 1.0, stream)
    assert choose(detections, rles) == ([], {code: 10})


def test_motion_plenty_of_events_is_accepted(rles):
    moments, refused = choose(watch(rles, lambda _t: (0.0, 0.0), 2.0, PLENTY), rles)
    assert len(moments) == 1 and not refused
    assert moments[0].figures["speed_mps"] < 0.01 and moments[0].figures["events_px"] > 4


def test_motion_slowest_part_is_preferred(rles):
    def way(t):
        """In at 0.4 m/s, then on at 0.1 m/s."""
        return (0.4 * (t - 1.0) if t < 1.0 else 0.1 * (t - 1.0), 0.0)

    moments, _ = choose(watch(rles, way, 2.2, SOME), rles)
    near = [moment for moment in moments if abs(places_m([moment])[0]) < 0.15]
    assert any(moment.figures["speed_mps"] == pytest.approx(0.1, abs=0.01) for moment in near)
    assert all(np.diff(sorted(places_m(moments))) >= 0.15)


def test_motion_moments_outside_stream_are_counted(rles):
    stream = event_stream([(1.0, 2.0, 4.0)])
    _, refused = choose(watch(rles, lambda t: (0.05 * t, 0.0), 6.0, stream), rles)
    # Scans 8 to 31 begin less than 1.2 s after its end and end less than 0.15 s before its beginning.
    # The board moves on in five of them with too few events left.
    assert refused["read.no_events_at_scan"] == 8 + 28 + 5


@pytest.mark.parametrize(("speed_mps", "is_kept"), [(0.1, True), (0.8, False)])
def test_motion_gate_frames_without_events_are_kept(rles, speed_mps, is_kept):
    detections = watch(rles, lambda t: (speed_mps * (t - 1.5), 0.0), 3.0, [])
    moments, _ = choose(detections, rles, takes_frames=True)
    assert bool(moments) is is_kept
    assert all(m.figures["speed_mps"] == pytest.approx(speed_mps, abs=0.001) for m in moments)


def test_motion_board_missing_in_scan_is_not_captured(rles):
    assert choose(watch(rles, lambda t: (0.1 * t, 0.0), 1.0, SOME, has_lidar=False), rles) == ([], {})


def test_motion_returning_board_is_captured_once(rles):
    moments, _ = choose(watch(rles, lambda t: (0.1 * abs(t - 3.0), 0.0), 6.0, SOME), rles)
    places = sorted(places_m(moments))
    assert 2 <= len(places) <= 3 and np.diff(places).min() >= 0.15


def test_motion_unseen_board_names_the_cause(rles):
    lit = event_stream([(-1.3, 3.0, 8.0)], lamp_hz=60.0)
    unseen = Refusal("image.no_board")
    for stream, code in [(lit, "image.flicker"), (event_stream([(-1.3, 3.0, 0.3)]), "image.hardly_moved")]:
        detections = watch(
            rles, lambda _t: (0.0, 0.0), 1.0, stream, channel="events", is_seen=lambda _t: False
        )
        told = [BoardDetection(s.frame, {}, {}, {("davis", "events"): unseen}) for s in detections]
        moments, refused = choose(told, rles)
        assert moments == [] and list(refused) == [code]


@pytest.mark.parametrize(
    ("markers", "is_turned", "is_still"),
    [("charuco", False, True), ("charuco", True, False), ("checkerboard", True, True)],
)
def test_stillness_markers_detect_a_turn(rles, markers, is_turned, is_still):
    board = Board(8, 6, 0.07, 0.767, 0.626)
    corners_px = 100 + 400 * board.corners()[:, :2]
    if markers == "charuco":
        board = replace(board, type="charuco", marker_share=0.75, dictionary="5X5_50")
        # Of these columns no corner has a neighbour in its row.
        corners_px[~np.isin(np.arange(48) % 8, (0, 2, 5, 7))] = np.nan
    gate = StillnessGate(board, 0.01)
    for k, detection in enumerate(watch(rles, lambda _t: (0.0, 0.0), 1.0, PLENTY)):
        px = corners_px[::-1] if is_turned and k % 2 else corners_px
        images = {key: replace(image, corners_px=px) for key, image in detection.images.items()}
        (plate,) = detection.lidars["lidar"]
        lidars = {"lidar": [replace(plate, plane=np.array([0, 0, 1.0, 0]))]}
        gate.take(replace(detection, images=images, lidars=lidars))
    assert (gate.motion_m < 0.001) == is_still
