"""Putting a stream of events in the order of time, with as little held in memory as that needs."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lce_rig.core.errors import SourceError
from lce_rig.sources.events.stream import NS_PER_US, EventColumns, Findings, join, seconds_in

# Recorders with several threads, and readout that is not in order, mix stamps by this much at most.
REORDER_NS = 20_000_000
# Counters of 31 and 32 bits of microseconds are common; they wrap after 36 and 72 minutes.
_WRAPS_NS = tuple((1 << bits) * NS_PER_US for bits in (31, 32))
_MAX_GAP_NS = 60_000_000_000
# Cameras may send a little before their clock is set at the start.
_MAX_LEAD_NS = 1_000_000_000
# More stray stamps than this are no damage here and there but a clock that was set.
_MAX_STRAY_SHARE = 0.01
_MAX_DAMAGED_SHARE = 0.25


def in_time_order(
    path: Path, stretches: Iterator[EventColumns], findings: Findings
) -> Iterator[EventColumns]:
    """Yield stretches whose stamps never decrease, within and from one to the next.

    Stamps mixed within 20 ms are sorted; counters that wrap are unwrapped; single stray stamps are left out.

    Raises:
        SourceError: the stamps run back for good; everything before has been yielded.
    """
    held: EventColumns | None = None
    clock = _Clock()
    delivered_ns: int | None = None
    first_ns: int | None = None
    for stretch in stretches:
        if not len(stretch):
            continue
        current = clock.unwrap(stretch, findings)
        first_ns = int(current.t_ns[0]) if first_ns is None else first_ns
        if held is None:
            together = current
        elif int(current.t_ns.min()) >= held.t_ns[-1]:
            yield held
            delivered_ns, together = int(held.t_ns[-1]), current
        else:
            together = join([held, current])
        if _never_falls(together.t_ns):
            held = together
            continue
        mixed = _sorted(path, together, findings, first_ns, delivered_ns)
        cut = int(np.searchsorted(mixed.t_ns, mixed.t_ns[-1] - REORDER_NS)) if len(mixed) else 0
        if cut:
            yield mixed.select(slice(0, cut))
            delivered_ns = int(mixed.t_ns[cut - 1])
        held = mixed.select(slice(cut, None)) if cut < len(mixed) else None
    if held is not None:
        yield held


class _Clock:
    """Counts the wraps of a counter of microseconds."""

    def __init__(self) -> None:
        self._last_ns: int | None = None
        self._shift_ns = 0

    def unwrap(self, stretch: EventColumns, findings: Findings) -> EventColumns:
        raw = stretch.t_ns
        steps = np.diff(raw, prepend=raw[0] if self._last_ns is None else self._last_ns)
        self._last_ns = int(raw[-1])
        shifts = np.zeros(0, np.int64)
        if steps.min() < _MAX_GAP_NS - _WRAPS_NS[0]:
            shifts = np.zeros(len(raw), np.int64)
            for wrap_ns in _WRAPS_NS:
                wrapped = (steps < _MAX_GAP_NS - wrap_ns) & (steps >= -wrap_ns)
                shifts[wrapped] = wrap_ns
                findings.add(f"wraps of a {wrap_ns * 1e-9 / 60:.1f} min clock undone", n=int(wrapped.sum()))
            shifts = np.cumsum(shifts)
        if not len(shifts) and not self._shift_ns:
            return stretch
        t_ns = raw + self._shift_ns + (shifts if len(shifts) else 0)
        self._shift_ns += int(shifts[-1]) if len(shifts) else 0
        return EventColumns(t_ns, stretch.x, stretch.y, stretch.polarity, stretch.host_ns)


def _never_falls(t_ns: NDArray[np.int64]) -> bool:
    return bool(np.all(t_ns[1:] >= t_ns[:-1]))


def _sorted(
    path: Path, events: EventColumns, findings: Findings, first_ns: int, delivered_ns: int | None
) -> EventColumns:
    """Leave out stray stamps and sort the others."""
    t_ns = events.t_ns
    latest_before = np.maximum.accumulate(t_ns)
    earliest_after = np.minimum.accumulate(t_ns[::-1])[::-1]
    late, early = latest_before - t_ns > REORDER_NS, t_ns - earliest_after > REORDER_NS
    # A stamp too far ahead makes all that follow look late, and the other way round: the fewer are astray.
    stray = min(late, early, key=np.count_nonzero)
    n_stray = int(np.count_nonzero(stray))
    if n_stray:
        worst = int(np.argmax(latest_before - t_ns))
        back_s = (latest_before[worst] - t_ns[worst]) * 1e-9
        where = f"{seconds_in(int(latest_before[worst]), first_ns)} they run back by {back_s:.3f} s"
        # A clock that was set divides the stream; damage lies between stamps that go on.
        is_between = not (stray[0] or stray[-1]) and n_stray <= _MAX_DAMAGED_SHARE * len(t_ns)
        if n_stray > max(1, _MAX_STRAY_SHARE * len(t_ns)) and not is_between:
            reset = int(np.argmax(latest_before - t_ns > REORDER_NS))
            if delivered_ns is None and latest_before[reset] - first_ns < _MAX_LEAD_NS:
                findings.add("events before the clock was set left out", where, reset)
                return _sorted(path, events.select(slice(reset, None)), findings, int(t_ns[reset]), None)
            raise SourceError(
                f"{path}: the stamps of {n_stray} of {len(t_ns)} events do not fit: {where}",
                "The clock was set, or two recordings were joined: split the recording there.",
            )
        findings.add("events with stray stamps left out", where, n_stray)
        events = events.select(~stray)
    if delivered_ns is not None and len(events):
        is_late = events.t_ns < delivered_ns
        findings.add("events that came too late left out", n=int(np.count_nonzero(is_late)))
        events = events.select(~is_late)
    n_back = int(np.count_nonzero(np.diff(events.t_ns) < 0))
    if n_back:
        findings.add("places where stamps run back by up to 20 ms, sorted", n=n_back)
        events = events.select(np.argsort(events.t_ns, kind="stable"))
    return events
