"""Events in HDF5: columns {t,x,y,p} of DSEC's group events or of the root, or Metavision's table CD/events.

Times are microseconds, after t_offset if the file has one.

References:
    https://dsec.ifi.uzh.ch/data-format/
    https://docs.prophesee.ai/stable/data/file_formats/hdf5.html
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
_FIELDS = ("t", "x", "y", "p")
_GROUPS = ("events/", "CD/events/", "")
_TABLE = "CD/events"
_MOST_LINKS = 8
_ECF = 36559
"""Number of Prophesee's HDF5 filter, which Metavision's files are compressed by."""


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
            self._n_events = min(map(len, _columns(file)))
            offset = _find(file, "t_offset")
            self._offset_us = 0 if offset is None else int(offset[()])

    def stretches(self, losses: Losses) -> Iterator[EventColumns]:
        """Yield the events a million at a time.

        Raises:
            SourceError: the events are damaged, or compressed by a filter that is not installed.
        """
        with _open(self._path) as file:
            columns = _columns(file)
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
    """Convert columns or rows (N,) to 16 bits; larger numbers stay outside any sensor."""
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
    hint = f"Expected t, x, y and p: columns of the group events or of the root, or fields of {_TABLE}."
    with reading(path, SourceError, hint), h5py.File(path, "r") as file:
        yield file


def _columns(file: Any) -> list[Any]:
    """Find the columns t, x, y and p, each of which reads a slice as an array (N,).

    Raises:
        ValueError: a column is missing.
    """
    table = _find(file, _TABLE)
    if {*_FIELDS} <= {*(getattr(getattr(table, "dtype", None), "names", None) or ())}:
        _require_filter(table)
        return [table.fields(name) for name in _FIELDS]
    group = next((group for group in _GROUPS if _find(file, f"{group}t") is not None), _GROUPS[0])
    return [_column(file, f"{group}{name}") for name in _FIELDS]


def _find(group: Any, name: str, most_links: int = _MOST_LINKS) -> Any:
    """Return the object at a path, following links inside the file; None if there is none.

    Args:
        group: origin of a relative name.
        name: path, with slashes.
        most_links: soft links that may follow each other.

    Raises:
        SourceError: the object is in another file, which is not opened.
        ValueError: soft links lead in a circle.
    """
    import h5py

    here = group.file if name.startswith("/") else group
    for part in filter(None, name.split("/")):
        links = getattr(getattr(here, "id", None), "links", None)
        if part == "." or links is None or not links.exists(part.encode()):
            here = here if part == "." else None
            continue
        kind = links.get_info(part.encode()).type
        if kind == h5py.h5l.TYPE_HARD:
            here = here[part]
        elif kind == h5py.h5l.TYPE_SOFT:
            if not most_links:
                raise ValueError(f"the links of {name} lead in a circle")
            here = _find(here, links.get_val(part.encode()).decode(), most_links - 1)
        else:
            raise _of_other_file(group, name)
    if isinstance(here, h5py.Dataset) and (here.is_virtual or here.external):
        raise _of_other_file(group, name)
    return here


def _of_other_file(group: Any, name: str) -> SourceError:
    return SourceError(
        f"{group.file.filename}: {name} is in another file, which is not opened",
        "Copy all columns into one file: h5py's `file.copy(name, target, expand_external=True)`.",
    )


def _require_filter(table: Any) -> None:
    """Raise SourceError for a table compressed by Prophesee's filter if the filter is missing."""
    import h5py

    settings = table.id.get_create_plist()
    filters = {settings.get_filter(k)[0] for k in range(settings.get_nfilters())}
    if _ECF in filters and not h5py.h5z.filter_avail(_ECF):
        raise SourceError(
            f"{table.file.filename}: compressed by Prophesee's filter hdf5_ecf, which is not installed",
            "Set HDF5_PLUGIN_PATH to the folder of Metavision's HDF5 plugins, or record RAW (EVT3).",
        )


def _column(file: Any, name: str) -> Any:
    """Find a list of numbers.

    Raises:
        ValueError: there is no column of this name.
    """
    column = _find(file, name)
    if getattr(column, "ndim", 0) != 1 or column.dtype.kind not in "biuf":
        raise ValueError(f"it has no list of numbers {name}")
    return column
