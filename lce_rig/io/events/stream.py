"""The common interface of event readers: columns of events, and counts of losses."""

import re
from collections.abc import Iterator
from typing import Any, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from lce_rig.core.data import MAX_TIME_NS, EventColumns, join_events
from lce_rig.core.errors import SourceError
from lce_rig.core.losses import Losses

NS_PER_US = 1000
MAX_EVENT_PIXELS = 1 << 22
"""Of one event camera: four times the largest on sale; a damaged file may declare more."""


class NoEventsError(SourceError):
    """A recording that could hold events and holds none."""


NO_EVENTS = EventColumns(
    np.empty(0, np.int64), np.empty(0, np.uint16), np.empty(0, np.uint16), np.empty(0, np.bool_)
)


def join_small(stretches: Iterator[EventColumns], n_events: int) -> Iterator[EventColumns]:
    """Join stretches until they hold at least `n_events`: small packets cost more to hand on than to read."""
    parts: list[EventColumns] = []
    n_held = 0
    for stretch in stretches:
        parts.append(stretch)
        n_held += len(stretch)
        if n_held >= n_events:
            yield join_events(parts)
            parts, n_held = [], 0
    if parts:
        yield join_events(parts)


def worded(losses: Losses) -> list[str]:
    """List the losses, a line each."""
    return [finding.sentence for finding in losses.findings()]


class EventStream(Protocol):
    """One file or topic of events.

    Attributes:
        resolution_px: (width, height) that the file declares; None where it declares none.
        notes: what was chosen or assumed on opening, in words.
    """

    resolution_px: tuple[int, int] | None
    notes: list[str]

    def stretches(self, losses: Losses) -> Iterator[EventColumns]:
        """Yield the events from the beginning, as they lie in the file; may be called again and again.

        Raises:
            SourceError: nothing more can be read for a reason the user can repair.
        """
        ...


@runtime_checkable
class KnowsItsLength(Protocol):
    """A stream whose duration is known without reading it."""

    def duration_ns(self) -> int | None:
        """Return the time from the first event to the last, about; None where damage hides it."""
        ...


def seconds_in(t_ns: int, first_ns: int) -> str:
    """Print how far into a recording a timestamp lies: "2.125 s in"."""
    return f"{(t_ns - first_ns) * 1e-9:.3f} s in"


def parse_size(width: str, height: str) -> tuple[int, int] | None:
    """Read a resolution (px) from a file's text; None if no sensor has it."""
    # No sensor has more than five digits of pixels; int() takes quadratic time over the digits.
    if not all(re.fullmatch("[0-9]{1,5}", text) for text in (width, height)):
        return None
    size = int(width), int(height)
    return size if 0 < size[0] * size[1] <= MAX_EVENT_PIXELS else None


def to_ns(times_us: NDArray[Any], offset_us: int = 0) -> NDArray[np.int64]:
    """Convert whole microseconds; times beyond any clock become MAX_TIME_NS, which `in_time_order` skips.

    Args:
        times_us: (N,) integers of any type, or finite numbers.
        offset_us: added to each.
    """
    limit_us = MAX_TIME_NS // NS_PER_US
    is_time = (times_us > -limit_us - offset_us) & (times_us < limit_us - offset_us)
    t_us = np.where(is_time, times_us, 0).astype(np.int64)
    return np.where(is_time, (t_us + offset_us) * NS_PER_US, MAX_TIME_NS)
