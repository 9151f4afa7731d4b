"""All sensors' timestamps on one clock, synchronised during collection.

With a sync board this clock is the board's UTC. A LiDAR locked to the board's pulses is already on it. Images
are timed by the pulses that triggered them, event cameras by the edges that they detected. All others are
converted by the computer's clock and the board's answers. Without a board, all timestamps stay on
the computer's clock.
"""

from collections import deque
from collections.abc import Collection
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from lce_rig.core.data import Events, Image, LiveSample, Pulse, Sample
from lce_rig.core.findings import Finding
from lce_rig.rig import Rig
from lce_rig.rig.profile import BOARD, PPS_LINE
from lce_rig.timing import findings
from lce_rig.timing.clock import NS_PER_S, ClockModel
from lce_rig.timing.clock_fit import MIN_PAIRS, Stamps, fit_clock, match_edges
from lce_rig.timing.triggers import TriggerMatcher

_N_EDGES = 2048
_WINDOW_NS = 60 * NS_PER_S
# Share of the least time between two pulses within which an edge belongs to a pulse.
_NEAR = 0.4
_MIN_MATCHED = 0.5
#: Rate of the pulses while the first images are matched.
SLOW_TRIGGERS_HZ = 4.0
# Error of a DAVIS's clock, which is set to the computer's time when it is opened.
_COARSE_EDGE_NS = 100_000_000.0
# Error of a locked VLP-16, which counts whole microseconds.
_LOCKED_SIGMA_NS = 1_000.0
# Speed of a board carried in haste.
BOARD_SPEED_MPS = 1.0


class SyncVerdict(NamedTuple):
    """Whether boards must stand still while they are captured; `reasons` is empty if they may move."""

    reasons: tuple[Finding, ...]

    @property
    def requires_still_boards(self) -> bool:
        """Whether boards must stand still."""
        return bool(self.reasons)

    @property
    def finding(self) -> Finding:
        """The verdict itself, without the reasons."""
        return findings.BOARDS_MUST_STAND() if self.reasons else findings.BOARDS_MAY_MOVE()


class EdgeClock:
    """The board's time on a sensor's clock, fitted to the board's pulses and the sensor's edges.

    A DAVIS346 timestamps the edges at its trigger input without numbers. Edges are matched to pulses by a
    coarse model of its clock and, once a fit exists, by the fit.

    Attributes:
        problem: why a model is not available; None with one.
    """

    def __init__(self, sensor: str, coarse_error_ns: float) -> None:
        """Start without a model.

        Args:
            sensor: the sensor's name in the profile.
            coarse_error_ns: largest error of the coarse model.
        """
        self.problem: Finding | None = findings.NO_EDGES(sensor)
        self._sensor = sensor
        self._coarse_error_ns = coarse_error_ns
        self._coarse: ClockModel | None = None
        self._model: ClockModel | None = None
        self._sent_ns: deque[int] = deque(maxlen=_N_EDGES)
        self._seen_ns: deque[int] = deque(maxlen=_N_EDGES)

    def set_clock(self, board_from_sensor: ClockModel) -> None:
        """Set a coarse model: for a sensor with the computer's time, the board's own inverted."""
        self._coarse = board_from_sensor

    def take_sent(self, pulse: Pulse) -> None:
        """Add a pulse sent by the board."""
        if self._sent_ns and pulse.stamp_ns < self._sent_ns[-1]:
            self.restart()
        self._sent_ns.append(pulse.stamp_ns)

    def take_seen(self, pulse: Pulse) -> None:
        """Add an edge detected by the sensor."""
        if self._seen_ns and pulse.stamp_ns < self._seen_ns[-1]:
            self.restart()
        self._seen_ns.append(pulse.stamp_ns)

    def restart(self) -> None:
        """Discard all edges after a clock change or restart."""
        self._sent_ns.clear()
        self._seen_ns.clear()
        self._model = None

    def fit(self) -> ClockModel | None:
        """Fit the board's time on the sensor's clock to the last minute's edges; None if that fails."""
        start = self._model or self._coarse
        if start is None or len(self._sent_ns) < MIN_PAIRS or not self._seen_ns:
            return None
        sent_ns = _recent(self._sent_ns)
        # Only edges in the time range of known pulses.
        back, seen_ns = start.inverse(), _recent(self._seen_ns)
        first_ns = back.convert(int(sent_ns[0])) - self._coarse_error_ns
        last_ns = back.convert(int(sent_ns[-1])) + self._coarse_error_ns
        seen_ns = seen_ns[(seen_ns >= first_ns) & (seen_ns <= last_ns)]
        if len(seen_ns) < MIN_PAIRS:
            return None
        least_ns = float(np.diff(sent_ns).min())
        if self._model is None and self._coarse_error_ns > _NEAR * least_ns:
            sigma_ms, period_ms = self._coarse_error_ns / 1e6, least_ns / 1e6
            self.problem = findings.EDGES_TOO_CLOSE(self._sensor, sigma_ms=sigma_ms, period_ms=period_ms)
            return None
        edges = match_edges(seen_ns, sent_ns, start, min(self._coarse_error_ns, _NEAR * least_ns))
        if len(edges[0]) < max(MIN_PAIRS, _MIN_MATCHED * len(seen_ns)):
            self.problem = findings.EDGES_NOT_THE_PULSES(self._sensor)
            return None
        self._model, self.problem = fit_clock(*edges, "edges"), None
        return self._model


def _recent(times_ns: deque[int]) -> Stamps:
    times = np.array(times_ns, dtype=np.int64)
    return np.asarray(times[times >= times[-1] - _WINDOW_NS])


class RigClock:
    """Puts samples onto the rig's clock, for `collect` and `doctor` alike.

    Attributes:
        models: model from each sensor's clock to the rig's; samples placed earlier keep their time.
    """

    def __init__(self, rig: Rig, *, has_board: bool, edge_cameras: Collection[str] = ()) -> None:
        """Start without models.

        Args:
            rig: the profile, with the sensors and their trigger lines.
            has_board: whether a sync board is attached.
            edge_cameras: cameras that timestamp the board's edges themselves.
        """
        self.models: dict[str, ClockModel] = {}
        self._rig = rig
        self._has_board = has_board
        self._host: ClockModel | None = None
        self._utc: ClockModel | None = None
        self._matchers: dict[str, TriggerMatcher] = {}
        self._edges: dict[str, EdgeClock] = {}
        self._edge_models: dict[str, ClockModel | None] = {}
        self._quick: list[TriggerMatcher] = []
        is_tied = has_board and rig.sync is not None
        triggers = rig.sync.triggers if rig.sync is not None else {}
        for name in rig.cameras if is_tied else ():
            if name in edge_cameras:
                self._edges[name] = EdgeClock(name, _COARSE_EDGE_NS)
            elif name in triggers:
                trigger = triggers[name]
                self._matchers[name] = TriggerMatcher(name, round(1e9 * trigger.max_delay_s))
                if trigger.rate_hz * trigger.max_delay_s >= 1:
                    self._quick.append(self._matchers[name])

    @property
    def needs_slow_triggers(self) -> bool:
        """Whether pulses at the profile's rates are still too fast to match images to them."""
        return any(matcher.problem is not None for matcher in self._quick)

    def take(self, source: str, sample: LiveSample) -> list[Sample]:
        """Add a sample of a source; return the samples with a known time, on the rig's clock."""
        if isinstance(sample, Pulse):
            return self._take_pulse(source, sample)
        matcher = self._matchers.get(sample.sensor)
        if isinstance(sample, Image) and matcher is not None:
            was_matching = matcher.problem is None
            matched = matcher.take_image(sample)
            if was_matching:
                return [self._at_pulse(each.image, each.stamp_ns) for each in matched]
            # Until pulses are matched, use the computer's clock.
        return [self.place(sample)]

    def place(self, sample: Sample) -> Sample:
        """Return a sample with timestamps on the rig's clock; unchanged without a model of its sensor."""
        model = self.models.get(sample.sensor)
        if model is None:
            return sample
        if isinstance(sample, Events):
            return replace(sample, t_ns=model.convert_all(sample.t_ns))
        return sample if sample.stamp_ns is None else replace(sample, stamp_ns=model.convert(sample.stamp_ns))

    def refresh(
        self, host_clock: ClockModel | None, utc_clock: ClockModel | None, locked: Collection[str]
    ) -> None:
        """Set new models.

        Args:
            host_clock, utc_clock: models of the computer's time and UTC on the board's clock; None if
                unknown.
            locked: LiDARs whose timestamps are UTC by the board's pulses.
        """
        self._host, self._utc = host_clock, utc_clock
        # For timestamps of the computer's time; None if that is the rig's clock itself.
        host = host_clock.inverse().then(utc_clock) if host_clock and utc_clock else None
        for name in self._rig.lidars:
            own = ClockModel.identity(_LOCKED_SIGMA_NS, "UTC by PPS and NMEA")
            self._tie(name, own if name in locked else host)
        for name in self._rig.cameras:
            if name not in self._edges:
                self._tie(name, host)
        board_clock = self._utc or self._host
        if board_clock is None or self._host is None:
            return
        for matcher in self._matchers.values():
            matcher.set_clock(self._host.inverse())
        for name, edges in self._edges.items():
            edges.set_clock(self._host.inverse())
            model = self._edge_models[name] = edges.fit()
            self._tie(name, None if model is None else model.then(board_clock))

    def edge_clock(self, camera: str) -> tuple[ClockModel | None, Finding | None]:
        """Return the board's time on the clock of a camera that timestamps its edges, or the problem."""
        return self._edge_models.get(camera), self._edges[camera].problem

    def problems(self) -> list[Finding]:
        """List the clocks without the expected synchronisation, and why."""
        matchers = [each.problem for each in self._matchers.values()]
        edges = [each.problem for each in self._edges.values()]
        return [problem for problem in matchers + edges if problem is not None]

    def account(self) -> list[Finding]:
        """List the cameras whose counts, or those of their pulses, have restarted."""
        return [
            Finding(findings.SLIPPED.code, findings.SLIPPED.severity, name, matcher.figures())
            for name, matcher in self._matchers.items()
            if matcher.counts["n_restarts"]
        ]

    def verdict(self) -> SyncVerdict:
        """Judge whether boards must stand still while they are captured.

        A carried board moves at 1 m/s, so the times must be accurate to quality.max_motion_m / (1 m/s).
        """
        if not self._has_board:
            return SyncVerdict((findings.NO_BOARD(),))
        rig, reasons = self._rig, list[Finding]()
        limit_ns = rig.quality.max_motion_m / BOARD_SPEED_MPS * 1e9
        sensors = [(name, f"lidars.{name}", lidar.timestamps) for name, lidar in rig.lidars.items()]
        for name, camera in rig.cameras.items():
            for channel, settings in camera.channels.items():
                sensors.append((name, f"cameras.{name}.channels.{channel}", settings.timestamps))
        for name, key, timestamps in sensors:
            model = self.models.get(name)
            reason: Finding | None = None
            if timestamps.sync == "none":
                reason = findings.NONE_IN_PROFILE(name, key=f"{key}.timestamps.sync")
            elif model is None:
                reason = findings.NOT_TIED(name)
            elif model.sigma_ns(model.last_ns) > limit_ns:
                sigma_ms = model.sigma_ns(model.last_ns) / 1e6
                reason = findings.TOO_UNCERTAIN(name, sigma_ms=sigma_ms, limit_ms=limit_ns / 1e6)
            # Channels of one camera share its clock.
            if reason is not None and reason not in reasons:
                reasons.append(reason)
        return SyncVerdict(tuple(reasons))

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
        """Timestamp an image by the pulse that triggered it; unchanged while no clock is known."""
        clock = self._utc or self._host
        if clock is None:  # A clock that jumped has no model until a few answers have come.
            return image
        return replace(image, stamp_ns=clock.convert(board_ns))

    def _tie(self, sensor: str, model: ClockModel | None) -> None:
        if model is None:
            self.models.pop(sensor, None)
        else:
            self.models[sensor] = model


def edge_line(rig: Rig, camera: str) -> str:
    """Name the board's line whose edges a camera sees: its own trigger, else the pulse per second."""
    return camera if rig.sync is not None and camera in rig.sync.triggers else PPS_LINE
