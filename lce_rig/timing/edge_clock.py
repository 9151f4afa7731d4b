"""The clock of a sensor that sees the sync board's pulses, fitted to the board's by them.

A DAVIS346 stamps the edges at its trigger input and does not number them. Which edge is which pulse follows
from a coarse model of its clock; once a fit is made, the fit itself decides.
"""

from collections import deque

import numpy as np

from lce_rig.core.data import Pulse
from lce_rig.core.findings import Finding
from lce_rig.timing.clock import NS_PER_S, ClockModel
from lce_rig.timing.clock_fit import MIN_PAIRS, RESOLUTION_NS, Stamps, fit_clock, match_edges

_N_EDGES = 2048
_WINDOW_NS = 60 * NS_PER_S
# Of the least time between two pulses: an edge farther from its pulse could be the next one's.
_NEAR = 0.4
_MIN_MATCHED = 0.5


class EdgeClock:
    """Pulses of the board and edges that a sensor saw, and the board's time on that sensor's clock.

    Attributes:
        problem: why there is no model; None while there is one.
    """

    def __init__(self, sensor: str, coarse_error_ns: float) -> None:
        """Begin without a model.

        Args:
            sensor: its name in the profile.
            coarse_error_ns: how far off the coarse model may be.
        """
        self.problem: Finding | None = Finding("edges.none_seen", "error", sensor)
        self._sensor = sensor
        self._coarse_error_ns = coarse_error_ns
        self._coarse: ClockModel | None = None
        self._model: ClockModel | None = None
        self._sent_ns: deque[int] = deque(maxlen=_N_EDGES)
        self._seen_ns: deque[int] = deque(maxlen=_N_EDGES)

    def set_clock(self, board_from_sensor: ClockModel) -> None:
        """Take a coarse model: for a sensor that stamps the computer's time, the board's own inverted."""
        self._coarse = board_from_sensor

    def take_sent(self, pulse: Pulse) -> None:
        """Take a pulse as the board sent it."""
        if self._sent_ns and pulse.stamp_ns < self._sent_ns[-1]:
            self.restart()
        self._sent_ns.append(pulse.stamp_ns)

    def take_seen(self, pulse: Pulse) -> None:
        """Take an edge as the sensor saw it."""
        if self._seen_ns and pulse.stamp_ns < self._seen_ns[-1]:
            self.restart()
        self._seen_ns.append(pulse.stamp_ns)

    def restart(self) -> None:
        """Forget all edges: a clock was set, or the board began anew."""
        self._sent_ns.clear()
        self._seen_ns.clear()
        self._model = None

    def fit(self) -> ClockModel | None:
        """Fit the board's time on the sensor's clock to the last minute's edges; None where it cannot be."""
        start = self._model or self._coarse
        if start is None or len(self._sent_ns) < MIN_PAIRS or not self._seen_ns:
            return None
        sent_ns = _recent(self._sent_ns)
        seen_ns = self._seen_during(sent_ns, start)
        if len(seen_ns) < MIN_PAIRS:
            return None
        least_ns = float(np.diff(sent_ns).min())
        if self._model is None and self._coarse_error_ns > _NEAR * least_ns:
            figures = {"sigma_ms": self._coarse_error_ns / 1e6, "period_ms": least_ns / 1e6}
            self.problem = Finding("edges.too_close", "error", self._sensor, figures)
            return None
        pairs = match_edges(seen_ns, sent_ns, start, min(self._coarse_error_ns, _NEAR * least_ns))
        if pairs is None or len(pairs) < max(MIN_PAIRS, _MIN_MATCHED * len(seen_ns)):
            self.problem = Finding("edges.not_the_pulses", "error", self._sensor)
            return None
        self._model, self.problem = fit_clock(pairs, "edges", RESOLUTION_NS), None
        return self._model

    def _seen_during(self, sent_ns: Stamps, start: ClockModel) -> Stamps:
        """Give the edges whose pulses are known; others say nothing."""
        back = start.inverse()
        first_ns = back.convert(int(sent_ns[0])) - self._coarse_error_ns
        last_ns = back.convert(int(sent_ns[-1])) + self._coarse_error_ns
        seen_ns = _recent(self._seen_ns)
        return np.asarray(seen_ns[(seen_ns >= first_ns) & (seen_ns <= last_ns)])


def _recent(times_ns: deque[int]) -> Stamps:
    times = np.array(times_ns, dtype=np.int64)
    return np.asarray(times[times >= times[-1] - _WINDOW_NS])
