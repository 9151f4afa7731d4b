"""HDF5 files as the DSEC data set lays them out: events/{t,x,y,p}, t in us after t_offset.

References:
    https://dsec.ifi.uzh.ch/data-format/
"""

from collections.abc import Iterator
from contextlib import suppress
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np

from lce_rig.core.errors import SourceError
from lce_rig.sources.events.stream import NS_PER_US, EventColumns, Findings

_BLOCK_EVENTS = 1 << 20
_COLUMNS = ("t", "x", "y", "p")
# What h5py raises on a damaged file.
_DAMAGE = (OSError, RuntimeError, KeyError, ValueError, TypeError)


class Hdf5Events:
    """Events of an HDF5 file; see `EventStream`."""

    def __init__(self, path: Path) -> None:
        """Find the columns.

        Raises:
            SourceError: h5py is missing, or the file is none of this layout.
        """
        self._path = path
        self.notes: list[str] = []
        with _open(path) as file:
            try:
                self._find_columns(file)
            except _DAMAGE as error:
                raise SourceError(f"{path} is damaged: {error}") from None

    def _find_columns(self, file: Any) -> None:
        columns = [file.get(f"events/{name}") for name in _COLUMNS]
        missing = [name for name, column in zip(_COLUMNS, columns, strict=True) if column is None]
        if missing:
            raise SourceError(
                f"{self._path} has no events/{missing[0]}; it has {_list_names(file)}",
                "Events are read as DSEC lays them out: events/t, events/x, events/y, events/p.",
            )
        lengths = {name: len(column) for name, column in zip(_COLUMNS, columns, strict=True)}
        self._n_events = min(lengths.values())
        if self._n_events < max(lengths.values()):
            said = ", ".join(f"{name} {length}" for name, length in lengths.items())
            self.notes.append(f"{self._path.name}: columns of unequal length ({said}); the shortest is taken")
        group = file["events"]
        size = [_integer(group, name) or _integer(file, name) for name in ("width", "height")]
        self.resolution_px = (size[0], size[1]) if size[0] and size[1] else None
        self._offset_us = _integer(file, "t_offset") or _integer(group, "t_offset") or 0

    def stretches(self, findings: Findings) -> Iterator[EventColumns]:
        """Yield the events a million at a time.

        Raises:
            SourceError: they are compressed by a filter that is not installed, or damaged.
        """
        with _open(self._path) as file:
            for begin in range(0, self._n_events, _BLOCK_EVENTS):
                try:
                    block = [file[f"events/{name}"][begin : begin + _BLOCK_EVENTS] for name in _COLUMNS]
                except _DAMAGE as error:
                    if begin:
                        lost = f"event {begin}: {error}"
                        findings.add("torn ends of the file left out", lost)
                        return
                    raise _unreadable(self._path, file, error) from None
                t_us, x, y, polarity = block
                t_ns = (t_us[: len(polarity)].astype(np.int64) + self._offset_us) * NS_PER_US
                yield EventColumns(t_ns, x.astype(np.uint16), y.astype(np.uint16), polarity > 0)


def _open(path: Path) -> Any:
    try:
        import h5py  # type: ignore[import-untyped]
    except ImportError:
        raise SourceError(f"{path}: h5py is not installed", 'pip install "lce-rig[events]"') from None
    # Registers the compression filters (blosc, zstd) that event files use.
    with suppress(ImportError):
        import_module("hdf5plugin")
    try:
        return h5py.File(path, "r")
    except OSError as error:
        raise SourceError(f"{path} cannot be read as HDF5: {error}") from None


def _unreadable(path: Path, file: Any, error: Exception) -> SourceError:
    """Say why: HDF5's own message on a missing filter names a folder and nothing else."""
    from h5py.h5z import filter_avail  # type: ignore[import-untyped]

    for name in _COLUMNS:
        settings = file[f"events/{name}"].id.get_create_plist()
        filters = [settings.get_filter(i) for i in range(settings.get_nfilters())]
        missing = [
            label.decode() or str(number) for number, _, _, label in filters if not filter_avail(number)
        ]
        if missing:
            what = f"{path}: events/{name} is compressed by {missing[0]}, which is not installed"
            return SourceError(what, "pip install hdf5plugin")
    return SourceError(f"{path}: its events cannot be read: {error}")


def _integer(holder: Any, name: str) -> int | None:
    value = holder.attrs.get(name)
    if value is None and name in holder and getattr(holder[name], "size", 0) == 1:
        value = holder[name][()]
    return None if value is None else int(np.asarray(value).ravel()[0])


def _list_names(file: Any) -> str:
    names: list[str] = []
    with suppress(RuntimeError):
        file.visit(names.append)
    return ", ".join(names[:12]) or "nothing"
