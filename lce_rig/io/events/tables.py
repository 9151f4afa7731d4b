"""Tables of events: HDF5 as the DSEC data set lays it out, and E2VID's text.

DSEC has events/{t,x,y,p}, t in us after t_offset; E2VID "width height", then a line "t x y polarity" for
every event, t in s.

References:
    https://dsec.ifi.uzh.ch/data-format/, https://github.com/uzh-rpg/rpg_e2vid
"""

from collections.abc import Iterator
from contextlib import contextmanager
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lce_rig.core.data import EventColumns
from lce_rig.core.errors import SourceError, reading, reason_of
from lce_rig.core.findings import Losses
from lce_rig.io import findings
from lce_rig.io.events.event_recording import EventStream, parse_size, to_ns

_BLOCK_EVENTS, _BLOCK_LINES = 1 << 20, 1 << 16
_COLUMNS = ("events/t", "events/x", "events/y", "events/p")
_NO_LINES = np.empty((0, 4))


class Hdf5Events(EventStream):
    """Events of an HDF5 file; see `EventStream`."""

    def __init__(self, path: Path) -> None:
        """Find the columns.

        Raises:
            SourceError: h5py is missing, or the file has another layout.
        """
        self._path = path
        self.notes: list[str] = []
        with _open(path) as file:
            # Columns of a torn file differ in length.
            self._n_events = min(len(_column(file, name)) for name in _COLUMNS)
            width, height = _number(file, "width"), _number(file, "height")
            self.resolution_px = (width, height) if width and height else None
            self._offset_us = _number(file, "t_offset") or 0

    def stretches(self, losses: Losses) -> Iterator[EventColumns]:
        """Yield the events a million at a time.

        Raises:
            SourceError: they are compressed by a filter that is not installed, or damaged.
        """
        with _open(self._path) as file:
            columns = [_column(file, name) for name in _COLUMNS]
            for begin in range(0, self._n_events, _BLOCK_EVENTS):
                end = min(begin + _BLOCK_EVENTS, self._n_events)
                try:
                    t_us, x, y, polarity = (np.asarray(column[begin:end]) for column in columns)
                    t_ns = to_ns(t_us, self._offset_us)
                    yield EventColumns(t_ns, _pixels(x), _pixels(y), polarity > 0)
                except (OSError, RuntimeError, ValueError) as error:
                    if not begin:
                        raise
                    losses.add(findings.TORN_END(where=f"event {begin}: {reason_of(error)}"))
                    return


def _pixels(numbers: NDArray[Any]) -> NDArray[np.uint16]:
    """Give columns or rows (N,) as 16 bits; numbers beyond stay off any sensor."""
    limit = 1 << 16
    return np.where((numbers >= 0) & (numbers < limit), numbers, limit - 1).astype(np.uint16)


@contextmanager
def _open(path: Path) -> Iterator[Any]:
    try:
        import h5py  # type: ignore[import-untyped]
        import hdf5plugin  # type: ignore[import-not-found,import-untyped,unused-ignore]  # noqa: F401  filters: blosc, zstd
    except ImportError as error:
        hint = "pip install 'lce-rig[events]'"
        raise SourceError(f"{path}: {error.name} is not installed", hint) from None
    hint = "Expected DSEC's layout: events/t, events/x, events/y, events/p."
    with reading(path, SourceError, hint), h5py.File(path, "r") as file:
        yield file


def _column(file: Any, name: str) -> Any:
    """Find a list of numbers.

    Raises:
        ValueError: there is none of this name.
    """
    column = file.get(name)
    if getattr(column, "ndim", 0) != 1 or column.dtype.kind not in "biuf":
        raise ValueError(f"it has no list of numbers {name}")
    return column


def _number(file: Any, name: str) -> int | None:
    """Read a number of the file or of its events, an attribute or a dataset of one; None if it is absent."""
    for holder in (file, file["events"]):
        value = holder.attrs.get(name)
        if value is None and name in holder:
            value = holder[name][()]
        if value is not None:
            return int(np.asarray(value).item())
    return None


class TextEvents(EventStream):
    """Events of a text file; see `EventStream`."""

    def __init__(self, path: Path) -> None:
        """Read the first line.

        Raises:
            SourceError: it is no such file.
        """
        self._path = path
        self.notes: list[str] = []
        with reading(path), path.open("rb") as file:
            line = file.readline()
        words = line.decode(errors="replace").split()
        self._has_size = len(words) == 2
        self.resolution_px = parse_size(*words) if self._has_size else None
        is_event = len(words) == 4 or line.startswith(b"#")
        if words and self.resolution_px is None and not is_event:
            raise SourceError(
                f"{path} is not a text file of events: the first line is neither a size nor an event",
                'Expected "width height", then lines "t x y polarity" with t in seconds.',
            )

    def stretches(self, losses: Losses) -> Iterator[EventColumns]:
        """Yield the events of some megabytes of text at a time; a torn last line is skipped.

        Raises:
            SourceError: a line is no event.
        """
        n_lines = int(self._has_size)
        with reading(self._path), self._path.open("rb") as file:
            next(islice(file, n_lines, n_lines), None)
            while lines := list(islice(file, _BLOCK_LINES)):
                if not lines[-1].endswith(b"\n"):
                    losses.add(findings.TORN_END(where=f"line {n_lines + len(lines)}"))
                    lines.pop()
                n_lines += len(lines)
                has_events = any(line.partition(b"#")[0].strip() for line in lines)
                table = np.loadtxt(lines, ndmin=2, comments="#") if has_events else _NO_LINES
                if table.shape[1] != 4:
                    raise ValueError(f"lines up to {n_lines} have {table.shape[1]} numbers, not 4")
                t_s, x, y, polarity = table.T
                # Doubles hold today's seconds to 0.24 us: rounding gives the microsecond that was written.
                t_ns = to_ns(np.rint(t_s * 1e6))
                yield EventColumns(t_ns, _pixels(x), _pixels(y), polarity > 0)
