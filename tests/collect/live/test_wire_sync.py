"""A sync board on a pty ties the clocks of a rig on the wire: its pulses trigger the camera."""

import contextlib
import os
import threading

import pytest
from wire.rig import small_rig
from wire.sync_board import FakeBoard

from lce_rig.collect.live.collection import collect_live
from lce_rig.collect.live.state import LiveOptions, LiveState
from lce_rig.devices import open_live
from lce_rig.rig.profile import SyncSettings, TriggerSettings
from lce_rig.session import Session
from tests.collect.live.sent import apart_s, check_sent, check_whole, read_sent

pytestmark = pytest.mark.realtime


class TriggeringBoard(FakeBoard):
    """Sends a pulse to the camera ten times a second, on the tenths of a second of UTC."""

    def __init__(self, trigger):
        super().__init__(drift=30e-6, period_s=0.1, knows_utc=True)
        self._trigger = trigger
        self._line = -1
        self.pulses_ns = {}

    def _pulse(self, due_ns):
        # A pipe can be written to when its reader is there; ours is the camera's process.
        if self._line < 0:
            with contextlib.suppress(OSError):
                self._line = os.open(self._trigger, os.O_WRONLY | os.O_NONBLOCK)
        super()._pulse(due_ns)
        self.pulses_ns[self.n_sent] = due_ns
        try:
            if self._line >= 0:
                os.write(self._line, b"x")
        except BrokenPipeError:
            os.close(self._line)
            self._line = -1


@pytest.mark.long
def test_pulses_synchronise_images_with_lidar(wire, reel, tmp_path):
    trigger = tmp_path / "trigger"
    os.mkfifo(trigger)
    with TriggeringBoard(trigger) as board:
        lines = {"cam": TriggerSettings(channel=0, rate_hz=10, max_delay_s=0.08)}
        sync = SyncSettings(type="lce1", device=board.path, triggers=lines)
        base = small_rig(is_guided=False)
        rig = wire(rig=base.model_copy(update={"sync": sync}), trigger=trigger).rig
        states, is_tied = list[LiveState](), threading.Event()

        def watch(state):
            states.append(state)
            if not state.requires_still_boards:
                is_tied.set()

        with Session.create(tmp_path / "session", rig) as session:
            n_tied = []

            def stop():
                if is_tied.is_set() and not n_tied:
                    n_tied.append(states[-1].n_captures)
                done = n_tied and states[-1].n_captures >= n_tied[0] + 3
                return "stop" if done else None

            options = LiveOptions(timeout_s=180.0, hold_s=0.0)
            collect_live(session, open_live(rig), options, watch, stop)
    assert n_tied, states[-1].notes
    sent = read_sent(reel, rig.lidars["lidar"])
    for capture in check_whole(tmp_path / "session")[n_tied[0] + 1 :]:
        check_sent(capture, sent)
        assert capture.meta["still_boards_only"] is False
        assert abs(apart_s(capture)) <= 0.051
        stamp_ns = capture.image("cam", "frames").stamp_ns
        assert stamp_ns is not None
        # A picture is stamped by its pulse and the usual delay: all alike to the nanosecond's noise.
        after_ns = min(stamp_ns - pulse_ns for pulse_ns in board.pulses_ns.values() if pulse_ns <= stamp_ns)
        assert 0 <= after_ns < 80_000_000
