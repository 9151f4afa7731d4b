"""Every sensor's stamps on one clock, tied while collecting goes on.

With a sync board that is UTC as the board has it: the LiDAR's own where it is locked to the board's pulses,
pictures by the pulses that made them, an event camera by the edges it saw, all else by the computer's clock
and the board's answers. Without one everything stays on the computer's clock.
"""

from collections.abc import Collection, Mapping
from dataclasses import replace

from lce_rig.core.data import Image, LiveSample, Pulse, Sample
from lce_rig.core.findings import Finding
from lce_rig.rig import Rig
from lce_rig.rig.sync import BOARD, PPS_LINE, TriggerSettings
from lce_rig.timing.clock import ClockModel
from lce_rig.timing.edge_clock import EdgeClock
from lce_rig.timing.sync import CommonClock, SyncVerdict, judge_sync
from lce_rig.timing.triggers import TriggerMatcher

#: Pulses a second at which the first pictures are matched.
SLOW_TRIGGERS_HZ = 4.0
# A DAVIS takes the computer's time when it is opened.
_COARSE_EDGE_NS = 100_000_000.0
# A locked VLP-16 counts whole microseconds.
_LOCKED_SIGMA_NS = 1_000.0


class RigClock:
    """Puts samples onto the rig's clock: the same while collecting and for `doctor`.

    Attributes:
        common: the models from the sensors' clocks to the rig's.
    """

    def __init__(self, rig: Rig, *, has_board: bool, edge_cameras: Collection[str] = ()) -> None:
        """Begin with nothing tied.

        Args:
            rig: says which sensors there are, and which of the board's lines triggers which.
            has_board: whether a sync board is there.
            edge_cameras: cameras that stamp the board's edges themselves.
        """
        self.common = CommonClock()
        self._rig = rig
        self._has_board = has_board
        self._host: ClockModel | None = None
        self._utc: ClockModel | None = None
        self._matchers: dict[str, TriggerMatcher] = {}
        self._edges: dict[str, EdgeClock] = {}
        self._edge_models: dict[str, ClockModel | None] = {}
        self._is_slow = False
        if has_board and rig.sync is not None:
            self._set_up(rig.sync.triggers, edge_cameras)

    def _set_up(self, triggers: Mapping[str, TriggerSettings], edge_cameras: Collection[str]) -> None:
        for name in self._rig.cameras:
            if name in edge_cameras:
                self._edges[name] = EdgeClock(name, _COARSE_EDGE_NS)
            elif name in triggers:
                self._matchers[name] = TriggerMatcher(name, round(1e9 * triggers[name].max_delay_s))
        fast = [triggers[name] for name in self._matchers]
        self._is_slow = any(trigger.rate_hz * trigger.max_delay_s >= 1 for trigger in fast)

    @property
    def needs_slow_triggers(self) -> bool:
        """Whether pulses at the profile's rates are too quick to tell yet which made which picture."""
        return self._is_slow

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

    def refresh(
        self, host_clock: ClockModel | None, utc_clock: ClockModel | None, locked: Collection[str]
    ) -> None:
        """Take new models.

        Args:
            host_clock, utc_clock: the computer's time and UTC on the board's clock; None where unknown.
            locked: LiDARs whose stamps are UTC by the board's pulses.
        """
        self._host, self._utc = host_clock, utc_clock
        host = self._rig_from_host()
        for name in self._rig.lidars:
            own = ClockModel.identity(_LOCKED_SIGMA_NS, "UTC by PPS and NMEA")
            self._tie(name, own if name in locked else host)
        for name in self._rig.cameras:
            if name not in self._edges:
                self._tie(name, host)
        self._refresh_board()

    def edge_clock(self, camera: str) -> tuple[ClockModel | None, Finding | None]:
        """Give the board's time on the clock of a camera that stamps its edges; or why there is none."""
        return self._edge_models.get(camera), self._edges[camera].problem

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
        if not self._has_board:
            return SyncVerdict(True, (Finding("sync.no_board", "warning"),))
        return judge_sync(self._rig, self.common)

    def _take_pulse(self, source: str, pulse: Pulse) -> list[Sample]:
        if source != BOARD:
            edges = self._edges.get(pulse.sensor)
            if edges is not None:
                edges.take_seen(pulse)
            return []
        for name, edges in self._edges.items():
            line = edge_line(self._rig, name)
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
        clock = self._utc or self._host
        assert clock is not None  # without it no picture was matched
        return replace(image, stamp_ns=clock.convert(board_ns))

    def _place(self, sample: Sample) -> Sample:
        placed = self.common.place(sample)
        assert not isinstance(placed, Pulse)
        return placed

    def _refresh_board(self) -> None:
        clock = self._utc or self._host
        if clock is None or self._host is None:
            return
        for matcher in self._matchers.values():
            matcher.set_clock(self._host.inverse())
        for name, edges in self._edges.items():
            edges.set_clock(self._host.inverse())
            model = self._edge_models[name] = edges.fit()
            self._tie(name, None if model is None else model.then(clock))
        if all(matcher.problem is None for matcher in self._matchers.values()):
            self._is_slow = False

    def _rig_from_host(self) -> ClockModel | None:
        """Give the model for stamps of the computer's time; None where it is the rig's clock itself."""
        if self._host is None or self._utc is None:
            return None
        return self._host.inverse().then(self._utc)

    def _tie(self, sensor: str, model: ClockModel | None) -> None:
        if model is None:
            self.common.untie(sensor)
        else:
            self.common.tie(sensor, model)


def edge_line(rig: Rig, camera: str) -> str:
    """Name the board's line whose edges a camera sees: its own trigger, else the pulse per second."""
    return camera if rig.sync is not None and camera in rig.sync.triggers else PPS_LINE
