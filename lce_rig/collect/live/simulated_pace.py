"""Whether this computer simulates as fast as sensors sense: where it does not, low rates are its doing."""

import threading
import time
from collections import deque
from collections.abc import Callable

from lce_rig.core.findings import Finding

#: Longer than the board is on its way, when everything has to be rendered anew.
WINDOW_S = 10.0
#: Rendering a moving board takes longer than the sensors would: no slower than this is as it should be.
USUAL = 2.0
#: Nothing is said of what has only begun.
LEAST_S = 4.0
_FACTORS = (2, 3, 5, 10, 20, 50)


class SimulatedPace:
    """How much slower than real time a simulation runs; may be asked from any thread.

    Args:
        period_s: simulated time between two turns of the simulation.
        now_s: the clock.
    """

    def __init__(self, period_s: float, now_s: Callable[[], float] = time.monotonic) -> None:
        self._period_s = period_s
        self._now_s = now_s
        self._began_s: float | None = None
        self._turns_s: deque[float] = deque()
        self._n_turns = 0
        self._lock = threading.Lock()

    def begin(self) -> None:
        """Count from now on."""
        with self._lock:
            self._began_s = self._now_s()

    def turn(self) -> None:
        """Count a turn that has just come."""
        with self._lock:
            self._turns_s.append(self._now_s())
            self._n_turns += 1

    @property
    def simulated_s(self) -> float:
        """Simulated time since the beginning."""
        with self._lock:
            return self._n_turns * self._period_s

    @property
    def slowness(self) -> float:
        """Real time over simulated time of the last seconds: 1 in real time, 4 for four times slower."""
        now_s = self._now_s()
        with self._lock:
            if self._began_s is None:
                return 1.0
            if now_s - self._began_s < LEAST_S:
                return 1.0
            since_s = max(self._began_s, now_s - WINDOW_S)
            while self._turns_s and self._turns_s[0] < since_s:
                self._turns_s.popleft()
            n_due = (now_s - since_s) / self._period_s
            return max(n_due / max(len(self._turns_s), 1), 1.0)

    def problem(self) -> Finding | None:
        """Find whether the computer is too slow; None where it is not."""
        slowness = self.slowness
        if slowness < USUAL:
            return None
        # Rounded, so that it is not said again with every sample.
        factor = max(value for value in _FACTORS if value <= slowness * 1.1)
        figures = {"factor": factor, "is_more": slowness > factor * 1.2 and factor == _FACTORS[-1]}
        return Finding("stream.simulated_slowly", "warning", figures=figures)
