"""The live loop from end to end, on simulated placements that are shown in real time."""

import json
import re
import threading
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from lce_rig.collect.live.collection import collect_live
from lce_rig.collect.live.guide import make_guides
from lce_rig.collect.live.state import LiveOptions, LiveState, TakeBack
from lce_rig.core.errors import SourceError
from lce_rig.session import Session
from tests.collect.live.replay import Show, placements, rig
from tests.collect.live.sent import apart_s
from tests.shared import changed

pytestmark = pytest.mark.realtime
QUICK = LiveOptions(n_wanted=3, timeout_s=300.0, hold_s=0.3)
HERE = "000000 shows the board here"


@pytest.mark.long
def test_collect_still_boards_are_captured(tmp_path):
    show, states = Show(placements(), each_s=2.0), list[LiveState]()
    with show.running(), Session.create(tmp_path / "session", rig()) as session:
        report = collect_live(session, show.sources, QUICK, states.append)
        assert report.ending == "frames" and report.error is None
        assert (
            [capture.name for capture in session.captures]
            == report.captured
            == ["000000", "000001", "000002"]
        )
        shown = []
        for capture in session.captures:
            capture.check()
            # A busy computer may miss a placement, and detect it when it is repeated.
            stamp_ns = capture.scan("lidar").stamp_ns
            (k,) = (k for k, stamps in enumerate(show.stamps) if stamp_ns in stamps)
            shown.append(k)
            sent = placements()[k]
            assert np.array_equal(capture.image("davis", "frames").pixels, sent.images[0].pixels)
            assert np.array_equal(capture.scan("lidar").points, sent.scans[0].points)
            assert abs(apart_s(capture, "davis")) < 0.02
            assert capture.meta["still_boards_only"] is True
            assert capture.meta["motion_m"] < rig().quality.max_motion_m
        assert len(set(shown)) == 3
    assert states[-1].phase == "ended" and states[-1].n_captures == 3
    phases = {state.phase for state in states}
    assert {"holding", "moving"} <= phases
    held = [state.hold_s for state in states if state.phase == "holding"]
    assert all(hold_s is not None and 0 <= hold_s <= 0.3 for hold_s in held)
    sounds = [cue.sound for cue in {cue.number: cue for s in states for cue in s.cues}.values()]
    assert sounds.count("captured") == 3
    assert max(report.latencies_s) < 20.0


@pytest.mark.long
def test_collect_keys_capture_skip_and_stop(tmp_path):
    asked = ["next", "capture"]
    states = []
    show = Show(placements()[:1], each_s=100.0)

    def key():
        if not states or not states[-1].streams or not states[-1].streams[0].sees_board:
            return None
        return asked.pop(0) if asked else "stop" if states[-1].n_captures else None

    with show.running(), Session.create(tmp_path / "session", rig()) as session:
        report = collect_live(
            session, show.sources, LiveOptions(hold_s=300.0, timeout_s=180.0), states.append, key
        )
        assert report.ending == "stopped"
        assert [capture.meta.get("by_hand") for capture in session.captures] == [1.0]
    wanted = [s.drawing.wanted for s in states if s.drawing is not None and s.drawing.wanted is not None]
    assert len({each.tobytes() for each in wanted}) >= 2


@pytest.mark.long
def test_collect_take_back_counts_correctly(tmp_path):
    path, states = tmp_path / "session", list[LiveState]()
    show = Show(placements(), each_s=2.0)
    # Both, the last first; then one that is gone already, as a second tap on a slow page asks for.
    asked = [TakeBack(), TakeBack(), TakeBack("000001")]

    def key():
        has_two = any(state.n_captures == 2 for state in states)
        return asked.pop(0) if asked and has_two else None

    with show.running(), Session.create(path, rig()) as session:
        report = collect_live(session, show.sources, QUICK, states.append, key)
        assert report.ending == "frames" and report.taken_back == ["000001", "000000"]
        assert [each.name for each in session.captures] == report.captured
        assert report.captured == ["000002", "000003", "000004"]
        assert [each.name for each in session.rejected] == ["000000", "000001"]
        for capture in (*session.captures, *session.rejected):
            capture.check()
    rejected = [entry for entry in session.read_journal() if entry["event"] == "rejected"]
    assert [entry["capture"] for entry in rejected] == ["000001", "000000"]
    counts = [state.n_captures for state in states]
    assert [b for a, b in pairwise(counts) if a != b] == [1, 2, 1, 0, 1, 2, 3]
    sounds = [cue.sound for cue in {cue.number: cue for s in states for cue in s.cues}.values()]
    assert sounds.count("taken_back") == 2 and sounds.count("captured") == 5


@pytest.mark.long
def test_pending_capture_can_be_taken_back(tmp_path, monkeypatch):
    states = []
    show = Show(placements()[:1], each_s=100.0)

    def key():
        if not states or not states[-1].last_capture:
            return "stop" if any(state.last_capture for state in states) else None
        return TakeBack()

    with show.running(), Session.create(tmp_path / "session", rig()) as session:
        add, is_asked = session.add_capture, threading.Event()

        def add_slowly(*given):
            """Write like a disk that is busy until the key is pressed."""
            is_asked.wait(60.0)
            return add(*given)

        monkeypatch.setattr(session, "add_capture", add_slowly)

        def watch(state):
            states.append(state)
            if any(each.last_capture for each in states[:-1]):
                is_asked.set()

        report = collect_live(session, show.sources, QUICK, watch, key)
        assert report.captured == [] and report.taken_back == ["000000"]
        assert not session.captures and [each.name for each in session.rejected] == ["000000"]
    assert max(state.n_captures for state in states) == 0


@pytest.mark.long
def test_collect_known_placement_is_ignored(tmp_path):
    """Nor does the capture key take it."""
    states, told_s = list[LiveState](), list[float]()
    show = Show(placements()[:1], each_s=100.0)

    def key():
        if not states or not states[-1].n_captures:
            return None
        told_s.extend(state.elapsed_s for state in states[-1:] if any(HERE in line for line in state.log))
        return "stop" if told_s and states[-1].elapsed_s > told_s[0] + 3.0 else "capture"

    with show.running(), Session.create(tmp_path / "session", rig()) as session:
        report = collect_live(session, show.sources, replace(QUICK, n_wanted=None), states.append, key)
    assert report.captured == ["000000"]
    assert any(HERE in line for line in states[-1].log)
    assert states[-2].drawing is not None and states[-2].drawing.wanted_px is not None


def test_collect_silent_sensors_hide_board(tmp_path):
    show, states = Show(placements()[:1], each_s=100.0), list[LiveState]()

    def watch(state):
        states.append(state)
        if all(stream.sees_board for stream in state.streams[:1]):
            show.pause()

    def key():
        return "stop" if states and "no image" in states[-1].detail else None

    with show.running(), Session.create(tmp_path / "session", rig()) as session:
        collect_live(session, show.sources, replace(QUICK, hold_s=20.0), watch, key)
    told = next(state for state in states if "no image" in state.detail)
    assert told.phase == "searching" and "waiting" in told.headline
    assert any(stream.sees_board for state in states for stream in state.streams)
    assert [stream.sees_board for stream in told.streams] == [None] * len(told.streams)


def test_collect_lost_sensor_keeps_captures(tmp_path):
    states = []
    show = Show(placements(), each_s=2.0)

    def unplug(state):
        states.append(state)
        if state.n_captures == 1:
            show.sources[1].fail(SourceError("lidar: no packets for 2 s", "Check the cable."))

    with show.running(), Session.create(tmp_path / "session", rig()) as session:
        options = LiveOptions(hold_s=0.3, lost_s=1.0, timeout_s=180.0)
        report = collect_live(session, show.sources, options, unplug)
        assert report.ending == "lost" and report.error is not None
        assert "no packets" in report.error.what
        assert len(session.captures) >= 1
    # On a busy computer the loop may notice it no earlier than the end.
    assert "lost" in [cue.sound for cue in states[-1].cues]
    entries = [json.loads(line) for line in (tmp_path / "session/journal.jsonl").read_text().splitlines()]
    assert entries[-1]["ending"] == "lost" and "no packets" in entries[-1]["error"]


@pytest.mark.long
def test_collect_unattended_run_ends(tmp_path):
    show = Show(placements()[:1], each_s=100.0)
    options = replace(QUICK, n_wanted=5, idle_s=8.0)
    with show.running(), Session.create(tmp_path / "session", rig()) as session:
        report = collect_live(session, show.sources, options)
    assert report.ending == "exhausted" and not report.is_enough
    assert len(report.captured) == 1
    (waited_s,) = (float(s) for note in report.notes for s in re.findall(r"last (\d+) s", note))
    assert waited_s >= 8


@pytest.fixture
def met(tmp_path):
    """A session whose captures meet a modest target, wherever its pictures were taken."""
    profile = changed(rig(), calibration__target_sigma_deg=5.0, calibration__target_sigma_m=0.5)
    (guide,) = make_guides(profile)
    with Session.create(tmp_path / "met", profile) as session:
        for k in range(12):
            guide.plan(None, float(k))
            meta = {"T_cam_board": {"davis.frames": guide.wanted.tolist()}}
            guide.add(str(k), guide.wanted)
            session.add_capture(placements()[0].images, placements()[0].scans, meta)
    return tmp_path / "met"


@pytest.mark.long
def test_collect_more_than_enough_is_guided(met):
    show, states = Show(placements(), each_s=2.0), list[LiveState]()
    with show.running(), Session.open(met, writable=True) as session:
        report = collect_live(session, show.sources, replace(QUICK, n_wanted=14), states.append)
    assert report.ending == "frames" and report.is_enough
    assert len(report.captured) == 2
    assert "enough" not in {state.phase for state in states}
    assert any(s.drawing is not None and s.drawing.wanted is not None for s in states)
    (said,) = {line.split(" ", 1)[1] for line in states[-1].log if "target" in line}
    assert said.endswith("14 captures")


def test_collect_ends_at_once_if_target_is_met(met):
    show = Show(placements()[:1], each_s=2.0)
    with show.running(), Session.open(met, writable=True) as session:
        report = collect_live(session, show.sources, replace(QUICK, n_wanted=None))
    assert report.ending == "enough" and not report.captured


@pytest.mark.long
def test_collect_guides_to_the_other_camera(met):
    profile = Session.open(met).rig
    nominal = profile.nominal_extrinsics[0]
    both = (nominal, changed(nominal, camera="right"))
    two = changed(profile, cameras__right=profile.cameras["davis"], nominal_extrinsics=both)
    show, states = Show(placements()[:1], each_s=100.0), list[LiveState]()
    with Session.create(met.parent / "two", two) as session, show.running():
        for capture in Session.open(met).captures:
            images = [capture.image("davis", "frames")]
            session.add_capture(images, [capture.scan("lidar")], dict(capture.meta))
        options = replace(QUICK, n_wanted=None, idle_s=3.0)
        report = collect_live(session, show.sources, options, states.append)
    assert report.ending == "exhausted" and not report.is_enough
    assert any(state.headline.endswith("to right") for state in states)
