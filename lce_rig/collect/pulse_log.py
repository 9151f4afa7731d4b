"""The last pulses of a line, found by number and by time."""

from bisect import bisect_left

_N_PULSES = 1024
_N_RECENT = 8
_MAX_INTERPOLATED = 8


class PulseLog:
    """The last thousand pulses of one line, numbers and board times rising."""

    def __init__(self) -> None:
        self._counts: list[int] = []
        self._times_ns: list[int] = []

    def __len__(self) -> int:
        return len(self._counts)

    def __contains__(self, time_ns: int) -> bool:
        at = bisect_left(self._times_ns, time_ns)
        return at < len(self._times_ns) and self._times_ns[at] == time_ns

    def add(self, count: int, time_ns: int) -> None:
        """Append a pulse."""
        self._counts.append(count)
        self._times_ns.append(time_ns)
        if len(self._counts) > 2 * _N_PULSES:
            del self._counts[:_N_PULSES], self._times_ns[:_N_PULSES]

    def clear(self) -> None:
        """Forget all."""
        self._counts.clear()
        self._times_ns.clear()

    @property
    def last_count(self) -> int:
        """Number of the last pulse."""
        return self._counts[-1]

    @property
    def last_ns(self) -> int:
        """Time of the last pulse."""
        return self._times_ns[-1]

    def within(self, start_ns: float, end_ns: float) -> list[int]:
        """List the numbers of the pulses from a time to another, both included."""
        first = bisect_left(self._times_ns, start_ns)
        return [
            count
            for count, time_ns in zip(self._counts[first:], self._times_ns[first:], strict=True)
            if time_ns <= end_ns
        ]

    def time_of(self, count: int) -> tuple[int, bool] | None:
        """Find the time of a pulse, and whether it is interpolated between neighbours.

        Returns:
            None where neither it nor neighbours within 8 numbers of each other are known.
        """
        after = bisect_left(self._counts, count)
        if after < len(self._counts) and self._counts[after] == count:
            return self._times_ns[after], False
        if not 0 < after < len(self._counts):
            return None
        n_apart = self._counts[after] - self._counts[after - 1]
        if n_apart > _MAX_INTERPOLATED:
            return None
        span_ns = self._times_ns[after] - self._times_ns[after - 1]
        return self._times_ns[after - 1] + span_ns * (count - self._counts[after - 1]) // n_apart, True

    def period_ns(self, count: int) -> float:
        """Tell the time between two pulses about a number; infinite where there is but one pulse."""
        if len(self._counts) < 2:
            return float("inf")
        after = min(max(bisect_left(self._counts, count), 1), len(self._counts) - 1)
        return self._period_before(after)

    def least_period_ns(self) -> float:
        """Tell the shortest time between two pulses among the last few."""
        recent = range(max(1, len(self._counts) - _N_RECENT), len(self._counts))
        return min((self._period_before(after) for after in recent), default=float("inf"))

    def _period_before(self, after: int) -> float:
        n_apart = self._counts[after] - self._counts[after - 1]
        return (self._times_ns[after] - self._times_ns[after - 1]) / n_apart
