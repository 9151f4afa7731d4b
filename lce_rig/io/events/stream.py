"""The common interface of event readers: columns of events, and counts of losses."""

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any, BinaryIO, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from lce_rig.core import limits
from lce_rig.core.data import EventColumns, join_events
from lce_rig.core.errors import SourceError, reading
from lce_rig.core.findings import Finding
from lce_rig.core.losses import Losses
from lce_rig.words import sentence

NS_PER_US = 1000
_PIXELS = re.compile("[0-9]{1,9}")


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


def damage(code: str, where: str = "") -> Finding:
    """Make the finding of what was skipped or lost while reading, with the first place and the cause."""
    return Finding(code, "warning", figures={"where": where} if where else {})


def worded(losses: Losses) -> list[str]:
    """Say each loss in one line."""
    return [sentence(finding) for finding in losses.findings()]


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
    """Say how far into a recording a timestamp lies: "2.125 s in"."""
    return f"{(t_ns - first_ns) * 1e-9:.3f} s in"


def open_recorded(path: Path) -> BinaryIO:
    """Open a file of a recording.

    Raises:
        SourceError: it is not a regular file, or may not be read.
    """
    with reading(path, SourceError):
        return limits.open_regular(path)


def parse_size(width: str, height: str) -> tuple[int, int] | None:
    """Read a resolution from a file's text, px; None where no camera has it."""
    # Longer ones are not pixels, and take Python long to read.
    if not (_PIXELS.fullmatch(width) and _PIXELS.fullmatch(height)):
        return None
    size = int(width), int(height)
    return size if 0 < size[0] * size[1] <= limits.MAX_EVENT_PIXELS else None


def to_ns(times_us: NDArray[Any], offset_us: int = 0) -> NDArray[np.int64]:
    """Convert whole microseconds; times beyond any clock become MAX_TIME_NS, for `in_time_order` to skip.

    Args:
        times_us: (N,) integers of any type, or finite numbers.
        offset_us: added to each.
    """
    least_us, limit_us = (sign * limits.MAX_TIME_NS // NS_PER_US - offset_us for sign in (-1, 1))
    t_us = np.array(times_us)
    is_beyond = None
    if len(t_us) and not (least_us < t_us.min() and t_us.max() < limit_us):
        is_beyond = ~((t_us > least_us) & (t_us < limit_us))
        t_us[is_beyond] = 0
    t_ns = t_us.astype(np.int64, copy=False)
    if offset_us:
        t_ns += offset_us
    t_ns *= NS_PER_US
    if is_beyond is not None:
        t_ns[is_beyond] = limits.MAX_TIME_NS
    return t_ns
