"""Conditions of live captures, with detections arriving one by one."""

from dataclasses import replace
from functools import cache

import numpy as np

from lce_rig.collect.board_tracker import BoardDetection
from lce_rig.collect.live.guide import StillBoards, make_guides
from lce_rig.core.results import ImageBoard
from lce_rig.detect.finder import BoardFinder
from lce_rig.timing.scan_pairing import Frame
from tests.collect.live.replay import PERIOD_NS, placements, rig

HOLD_S = 0.6
KEY = ("davis", "frames")


@cache
def boards(k=0):
    finder, seen = BoardFinder(rig()), placements()[k]
    image, scan = finder.image(seen.images[0]), finder.scan(seen.scans[0])
    assert isinstance(image, ImageBoard) and isinstance(scan, list)
    return image, scan


def detection(step, shift_px=0.0, k=0):
    """Show a placement at a time, its corners shifted."""
    image, scan = boards(k)
    moved = replace(image, corners_px=image.corners_px + shift_px)
    return BoardDetection(Frame(step * PERIOD_NS, (), ()), {KEY: moved}, {"lidar": scan})


def present():
    return boards()[0].T_cam_board


def test_gate_held_board_is_captured_once():
    gate = StillBoards(rig(), HOLD_S)
    taken = [step for step in range(40) if gate.take(detection(step))]
    # Half a second shows that it stands still; the hold follows.
    assert taken == [12]


def test_gate_early_moved_board_is_skipped():
    gate = StillBoards(rig(), HOLD_S)
    shifts = [0.0] * 9 + [30.0 * k for k in range(1, 6)] + [180.0] * 14
    taken = [step for step, shift in enumerate(shifts) if gate.take(detection(step, shift))]
    assert taken == [14 + 12]


def test_gate_narration_counts_down_then_continues():
    (guide,) = make_guides(rig())
    guide.plan(None, 0.0)
    gate = StillBoards(rig(), HOLD_S)
    said = []
    for step in range(20):
        moments = gate.take(detection(step))
        if moments:
            guide.add("000000", present())
            guide.plan(None, 0.0)
        said.append(gate.narrate(guide, present()))
    assert [each.phase for each in said[:5]] == ["moving"] * 5
    held = [each.hold_s for each in said if each.phase == "holding"]
    assert held == sorted(held, reverse=True) and len(held) == 7
    assert np.isclose(held[0], HOLD_S) and held[-1] < 0.1
    # After the capture, the next placement is shown although the board still stands.
    assert {each.phase for each in said[13:]} == {"moving"}
    assert all(each.headline not in ("", "hold still") for each in said[13:])


def test_gate_known_place_stays_refused():
    (guide,) = make_guides(rig())
    guide.add("000007", present())
    guide.plan(None, 0.0)
    gate = StillBoards(rig(), HOLD_S)
    for step in range(8):
        gate.take(detection(step))
        said = gate.narrate(guide, present())
    assert said.phase == "refused" and said.hold_s is None
    assert "capture 000007" in said.detail
