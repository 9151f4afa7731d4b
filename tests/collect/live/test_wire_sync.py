"""A sync board on a pty ties the clocks of a rig on the wire: its pulses trigger the camera."""

import contextlib
import os
import select
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path

import pytest
from wire.reel import Reel
from wire.rig import WireRig, small_rig

from lce_rig.collect.live.collection import collect_live
from lce_rig.collect.live.state import LiveOptions, LiveState
from lce_rig.devices import open_live
from lce_rig.devices.lce1 import write_sentence
from lce_rig.rig.profile import SyncSettings, TriggerSettings
from lce_rig.session import Session
from tests.collect.live.sent import check_sent, check_whole, read_sent

sys.path.insert(0, str(Path(__file__).parents[2] / "devices"))
from fake_board import FakeBoard

PERIOD_NS = 100_000_000


class TriggeringBoard(FakeBoard):
    """Sends a pulse to the camera ten times a second, on the tenths of a second of UTC."""

    def __init__(self, trigger: Path) -> None:
        super().__init__(drift=30e-6)
        self._trigger = trigger
        self._line = -1
        self.pulses_ns: dict[int, int] = {}

    def _run(self) -> None:
        # A pipe can be written to when its reader is there; ours is the camera's process.
        due, rest = time.time_ns() // PERIOD_NS + 1, b""
        while not self.has_gone:
            if self._has_said_something():
                rest = self._answer(rest + self._read())
            if time.time_ns() >= due * PERIOD_NS:
                with self._lock:
                    self._pulse_at(due * PERIOD_NS)
                due += 1

    def _has_said_something(self) -> bool:
        return bool(select.select([self._master], [], [], 0.001)[0])

    def _pulse_at(self, utc_ns: int) -> None:
        if self._line < 0:
            with contextlib.suppress(OSError):
                self._line = os.open(self._trigger, os.O_WRONLY | os.O_NONBLOCK)
        self.n_sent += 1
        t_us = self.board_us(utc_ns)
        self.pulses_ns[self.n_sent] = utc_ns
        self._say(write_sentence(f"LCETG,0,{self.n_sent},{t_us},R"))
        if utc_ns % 10**9 == 0:
            self.n_pps += 1
            self._say(write_sentence(f"LCEPP,{self.n_pps},{t_us},{utc_ns // 10**9},G"))
        try:
            if self._line >= 0:
                os.write(self._line, b"x")
        except BrokenPipeError:
            os.close(self._line)
            self._line = -1


@pytest.mark.long
def test_pulses_tie_the_cameras_pictures_to_the_lidars_time(
    wire: Callable[..., WireRig], reel: Reel, tmp_path: Path
) -> None:
    trigger = tmp_path / "trigger"
    os.mkfifo(trigger)
    with TriggeringBoard(trigger) as board:
        lines = {"cam": TriggerSettings(channel=0, rate_hz=10, max_delay_s=0.08)}
        sync = SyncSettings(type="lce1", device=board.path, triggers=lines)
        base = small_rig(is_guided=False)
        rig = wire(rig=base.model_copy(update={"sync": sync}), trigger=trigger).rig
        states, is_tied = list[LiveState](), threading.Event()

        def watch(state: LiveState) -> None:
            states.append(state)
            if not state.requires_still_boards:
                is_tied.set()

        with Session.create(tmp_path / "session", rig) as session:
            n_tied: list[int] = []

            def stop() -> str | None:
                if is_tied.is_set() and not n_tied:
                    n_tied.append(states[-1].n_captures)
                done = n_tied and states[-1].n_captures >= n_tied[0] + 3
                return "stop" if done else None

            options = LiveOptions(timeout_s=60.0, hold_s=0.0)
            collect_live(session, open_live(rig), options, watch, stop)
    assert n_tied, states[-1].notes
    sent = read_sent(reel, rig.lidars["lidar"])
    for capture in check_whole(tmp_path / "session")[n_tied[0] + 1 :]:
        check_sent(capture, sent)
        (pair,) = capture.meta["pairs"]
        assert capture.meta["still_boards_only"] is False
        assert all(source in pair["clock"] for source in ("PPS", "NMEA", "time requests"))
        assert 0 < pair["sigma_s"] < 0.01 and abs(pair["difference_s"]) <= 0.051
        stamp_ns = capture.image("cam", "frames").stamp_ns
        assert stamp_ns is not None
        # A picture is stamped by its pulse and the usual delay: all alike to the nanosecond's noise.
        after_ns = min(stamp_ns - pulse_ns for pulse_ns in board.pulses_ns.values() if pulse_ns <= stamp_ns)
        assert 0 <= after_ns < 80_000_000
