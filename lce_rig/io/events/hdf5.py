"""Events in HDF5 as the DSEC data set lays them out: events/{t,x,y,p}, t in us after t_offset.

References:
    https://dsec.ifi.uzh.ch/data-format/
"""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lce_rig.core.data import EventColumns
from lce_rig.core.errors import SourceError, reading, reason_of
from lce_rig.core.findings import Losses
from lce_rig.io import findings
from lce_rig.io.events.event_recording import EventStream, to_ns

_BLOCK_EVENTS = 1 << 20
_COLUMNS = ("events/t", "events/x", "events/y", "events/p")


class Hdf5Events(EventStream):
    """Events of an HDF5 file; see `EventStream`."""

    def __init__(self, path: Path) -> None:
        """Find the columns.

        Raises:
            SourceError: h5py is missing, or the file has another layout.
        """
        self._path = path
        self.notes: list[str] = []
        self.resolution_px = None
        with _open(path) as file:
            # Columns of a torn file differ in length.
            self._n_events = min(len(_column(file, name)) for name in _COLUMNS)
            self._offset_us = int(file["t_offset"][()]) if "t_offset" in file else 0

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
