"""Every sensor's stamps on one clock, tied while collecting goes on.

With a sync board that is UTC as the board has it: the LiDAR's own where it is locked to the board's pulses,
pictures by the pulses that made them, an event camera by the edges it saw, all else by the computer's clock
and the board's answers. Without one everything stays on the computer's clock.
"""

import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Protocol, runtime_checkable

from lce_rig.collect.edge_clock import EdgeClock
from lce_rig.collect.sync import CommonClock, SyncVerdict, judge_sync
from lce_rig.collect.triggers import TriggerMatcher
from lce_rig.core.clock import ClockModel
from lce_rig.core.data import Image
from lce_rig.core.findings import Finding
from lce_rig.rig import Rig
from lce_rig.sources.base import Sample
from lce_rig.sources.live.base import LiveSample, Pulse, SourceStatus
from lce_rig.sources.live.opening import driver_type

REFRESH_S = 0.5
#: Pulses a second at which the first pictures are matched.
SLOW_TRIGGERS_HZ = 4.0
# A DAVIS takes the computer's time when it is opened.
_COARSE_EDGE_NS = 100_000_000.0
_PPS = "pps"
# A locked VLP-16 counts whole microseconds.
_LOCKED_SIGMA_NS = 1_000.0


@runtime_checkable
class SyncTimes(Protocol):
    """What the clock needs of a sync board."""

    sensor: str

    @property
    def host_clock(self) -> ClockModel | None:
        """The computer's time on the board's clock."""
        ...

    @property
    def utc_clock(self) -> ClockModel | None:
        """UTC on the board's clock."""
        ...

    def start_triggers(self, rate_hz: float | None = None) -> None:
        """Let the pulses begin, at the profile's rates or at another one."""
        ...


class RigClock:
    """Puts samples onto the rig's clock.

    Attributes:
        common: the models from the sensors' clocks to the rig's.
    """

    def __init__(self, rig: Rig, board: SyncTimes | None) -> None:
        """Begin with nothing tied.

        Args:
            rig: says which sensors there are, and which of the board's lines triggers which.
            board: the sync board; None where there is none.
        """
        self.common = CommonClock()
        self._rig = rig
        self._board = board
        self._refreshed_s = -1e9
        self._matchers: dict[str, TriggerMatcher] = {}
        self._edges: dict[str, EdgeClock] = {}
        self._is_slow = False
        if board is not None and rig.sync is not None:
            self._set_up(rig, board)

    def _set_up(self, rig: Rig, board: SyncTimes) -> None:
        assert rig.sync is not None
        for name, camera in rig.cameras.items():
            trigger = rig.sync.triggers.get(name)
            if driver_type("camera", name, camera.model, camera.driver) == "davis":
                self._edges[name] = EdgeClock(name, _COARSE_EDGE_NS)
            elif trigger is not None:
                self._matchers[name] = TriggerMatcher(name, round(1e9 * trigger.max_delay_s))
        fast = [rig.sync.triggers[name] for name in self._matchers]
        self._is_slow = any(trigger.rate_hz * trigger.max_delay_s >= 1 for trigger in fast)
        if self._is_slow:
            board.start_triggers(SLOW_TRIGGERS_HZ)

    def take(self, source: str, sample: LiveSample) -> list[Sample]:
        """Take a sample of a source, and give those whose time is now known, on the rig's clock."""
        if isinstance(sample, Pulse):
            return self._take_pulse(source, sample)
        matcher = self._matchers.get(sample.sensor)
        if isinstance(sample, Image) and matcher is not None:
            was_matching = matcher.problem is None
            matched = matcher.take_image(sample)
            if was_matching:
                return [self._at_pulse(each.image, each.stamp_ns) for each in matched]
            # Until pulses are matched, the computer's clock must do.
            return [self._place(sample)]
        return [self._place(sample)]

    def refresh(self, ask: Callable[[], Mapping[str, SourceStatus]]) -> None:
        """Take new models, every half second at most.

        Args:
            ask: gives the statuses of the sensors, by name; asked only when it is time.
        """
        now_s = time.monotonic()
        if now_s - self._refreshed_s < REFRESH_S:
            return
        self._refreshed_s = now_s
        statuses, host = ask(), self._rig_from_host()
        for name in self._rig.lidars:
            state = statuses[name].clock if name in statuses else None
            is_own = state is not None and state.is_utc
            self._tie(name, ClockModel.identity(_LOCKED_SIGMA_NS, "UTC by PPS and NMEA") if is_own else host)
        for name in self._rig.cameras:
            if name not in self._edges:
                self._tie(name, host)
        self._refresh_board()

    def problems(self) -> list[Finding]:
        """List which clocks are not tied as they should be, and why."""
        matchers = [each.problem for each in self._matchers.values()]
        edges = [each.problem for each in self._edges.values()]
        return [problem for problem in matchers + edges if problem is not None]

    def account(self) -> list[Finding]:
        """List the cameras whose counts slipped against their pulses so far."""
        counts = {name: matcher.counts for name, matcher in self._matchers.items()}
        return [
            Finding("pulses.slipped", "note", name, dict(vars(each)))
            for name, each in counts.items()
            if each.n_slips or each.n_restarts
        ]

    def verdict(self) -> SyncVerdict:
        """Judge whether boards must stand still while they are captured."""
        if self._board is None:
            return SyncVerdict(True, (Finding("sync.no_board", "warning"),))
        return judge_sync(self._rig, self.common)

    def _take_pulse(self, source: str, pulse: Pulse) -> list[Sample]:
        if self._board is None or source != self._board.sensor:
            edges = self._edges.get(pulse.sensor)
            if edges is not None:
                edges.take_seen(pulse)
            return []
        assert self._rig.sync is not None
        for name, edges in self._edges.items():
            line = name if name in self._rig.sync.triggers else _PPS
            if pulse.sensor == line:
                edges.take_sent(pulse)
        matcher = self._matchers.get(pulse.sensor)
        if matcher is None:
            return []
        was_matching = matcher.problem is None
        matched = matcher.take_pulse(pulse)
        return [self._at_pulse(each.image, each.stamp_ns) for each in matched] if was_matching else []

    def _at_pulse(self, image: Image, board_ns: int) -> Image:
        """Stamp a picture by the pulse that made it."""
        clock = self._rig_from_board()
        assert clock is not None  # without it no picture was matched
        return replace(image, stamp_ns=clock.convert(board_ns))

    def _place(self, sample: Sample) -> Sample:
        placed = self.common.place(sample)
        assert not isinstance(placed, Pulse)
        return placed

    def _refresh_board(self) -> None:
        clock, host = self._rig_from_board(), self._board.host_clock if self._board is not None else None
        if self._board is None or clock is None or host is None:
            return
        for matcher in self._matchers.values():
            matcher.set_clock(host.inverse())
        for name, edges in self._edges.items():
            edges.set_clock(host.inverse())
            model = edges.fit()
            self._tie(name, None if model is None else model.then(clock))
        if self._is_slow and all(matcher.problem is None for matcher in self._matchers.values()):
            self._is_slow = False
            self._board.start_triggers()

    def _rig_from_board(self) -> ClockModel | None:
        if self._board is None:
            return None
        return self._board.utc_clock or self._board.host_clock

    def _rig_from_host(self) -> ClockModel | None:
        """Give the model for stamps of the computer's time; None where it is the rig's clock itself."""
        if self._board is None or self._board.host_clock is None or self._board.utc_clock is None:
            return None
        return self._board.host_clock.inverse().then(self._board.utc_clock)

    def _tie(self, sensor: str, model: ClockModel | None) -> None:
        if model is None:
            self.common.untie(sensor)
        else:
            self.common.tie(sensor, model)
