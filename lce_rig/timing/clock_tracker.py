"""Tracking of a running clock: a model of the last minute, and a report when one of the clocks jumps."""

from collections import deque
from dataclasses import dataclass

import numpy as np

from lce_rig.timing.clock import NS_PER_S, ClockModel
from lce_rig.timing.clock_fit import MIN_PAIRS, RESOLUTION_NS, TimePairs, fit_clock

_MAX_PAIRS = 2048
_N_WITNESSES = 3
_STEP_SIGMAS = 8.0


@dataclass(frozen=True)
class ClockStep:
    """A jump of one clock relative to the other.

    Attributes:
        source_ns: first reading of the source's clock after it.
        size_ns: by how much the reference, seen from the source, went ahead.
    """

    source_ns: int
    size_ns: int


@dataclass(frozen=True)
class _Pair:
    source_ns: int
    reference_ns: int
    bound_ns: float


class ClockTracker:
    """Incoming readings of two clocks, and the model fitted to the latest ones.

    A reading far off the model is held back. One alone is forgotten as an outlier; three in a row that agree
    with each other mean that a clock has jumped, and begin a new model.

    Args:
        what: what the readings are, in words: "time requests".
        window_s: how long readings count: drift changes with temperature.
        min_step_ns: what is smaller is not a jump, however exact the readings are.
        resolution_ns: step of the coarser clock.
    """

    def __init__(
        self,
        what: str,
        window_s: float = 60.0,
        min_step_ns: float = 200_000.0,
        resolution_ns: float = RESOLUTION_NS,
    ) -> None:
        self.steps: list[ClockStep] = []
        self._what = what
        self._window_ns = window_s * NS_PER_S
        self._min_step_ns = min_step_ns
        self._resolution_ns = resolution_ns
        self._pairs: deque[_Pair] = deque(maxlen=_MAX_PAIRS)
        self._suspects: list[_Pair] = []
        self._model: ClockModel | None = None
        self._n_new = 0

    def add(self, source_ns: int, reference_ns: int, bound_ns: float = 0.0) -> ClockStep | None:
        """Take a reading of both clocks; gives the jump that it proves, if it does.

        Args:
            source_ns: on the source's clock.
            reference_ns: on the reference's.
            bound_ns: by how much the two may lie apart in truth.
        """
        pair = _Pair(source_ns, reference_ns, bound_ns)
        if self._pairs and self._ran_back(self._pairs[-1], pair):
            return self._restart([pair])
        model = self._latest(max_new=max(1, len(self._pairs) // 8))
        if model is not None and self._is_far(pair, model):
            return self._suspect(pair, model)
        self._suspects.clear()
        self._pairs.append(pair)
        self._n_new += 1
        while self._pairs[0].source_ns < source_ns - self._window_ns:
            self._pairs.popleft()
        return None

    @property
    def model(self) -> ClockModel | None:
        """The model of the readings so far; None while there are too few."""
        return self._latest(max_new=1)

    def restart(self) -> None:
        """Forget all readings: the device restarted."""
        self._pairs.clear()
        self._suspects.clear()
        self._model = None
        self._n_new = 0

    def _latest(self, max_new: int) -> ClockModel | None:
        if self._n_new >= max_new and len(self._pairs) >= MIN_PAIRS:
            source, reference, bound = zip(
                *((pair.source_ns, pair.reference_ns, pair.bound_ns) for pair in self._pairs), strict=True
            )
            pairs = TimePairs(np.array(source, np.int64), np.array(reference, np.int64), np.array(bound))
            self._model = fit_clock(pairs, self._what, self._resolution_ns)
            self._n_new = 0
        return self._model

    def _ran_back(self, last: _Pair, pair: _Pair) -> bool:
        # Requests that overtake each other on their way are out of order by no more than their round trips.
        room_ns = self._min_step_ns + 2 * (last.bound_ns + pair.bound_ns)
        return pair.source_ns < last.source_ns - room_ns

    def _is_far(self, pair: _Pair, model: ClockModel) -> bool:
        sigma_ns = float(np.hypot(model.rms_ns, model.sigma_ns(pair.source_ns)))
        limit_ns = max(_STEP_SIGMAS * sigma_ns, self._min_step_ns) + pair.bound_ns
        return abs(pair.reference_ns - model.convert(pair.source_ns)) > limit_ns

    def _suspect(self, pair: _Pair, model: ClockModel) -> ClockStep | None:
        """Hold a reading back; with two before it that agree, it proves a jump."""
        self._suspects = [*self._suspects, pair][-_N_WITNESSES:]
        if len(self._suspects) < _N_WITNESSES:
            return None
        sizes_ns = [suspect.reference_ns - model.convert(suspect.source_ns) for suspect in self._suspects]
        room_ns = max(_STEP_SIGMAS * model.rms_ns, self._min_step_ns) + 2 * max(
            suspect.bound_ns for suspect in self._suspects
        )
        if max(sizes_ns) - min(sizes_ns) > room_ns:
            return None
        return self._restart(self._suspects, round(float(np.median(sizes_ns))))

    def _restart(self, pairs: list[_Pair], size_ns: int | None = None) -> ClockStep:
        if size_ns is None:
            last = self._pairs[-1]
            size_ns = (pairs[0].reference_ns - pairs[0].source_ns) - (last.reference_ns - last.source_ns)
        step = ClockStep(pairs[0].source_ns, size_ns)
        self.restart()
        self._pairs.extend(pairs)
        self._n_new = len(pairs)
        self.steps.append(step)
        return step
