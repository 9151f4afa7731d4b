"""HDF5 files as the DSEC data set lays them out: events/{t,x,y,p}, t in us after t_offset.

References:
    https://dsec.ifi.uzh.ch/data-format/
"""

import math
import zlib
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lce_rig.core import limits, unpacking
from lce_rig.core.data import EventColumns
from lce_rig.core.errors import SourceError
from lce_rig.core.losses import Losses
from lce_rig.io.events.stream import damage, open_recorded, to_ns

_BLOCK_EVENTS = 1 << 20
_COLUMNS = ("t", "x", "y", "p")
# What h5py raises on a damaged file.
_DAMAGE = (OSError, RuntimeError, KeyError, ValueError, TypeError, zlib.error)
_DEFLATE, _SHUFFLE, _CHECKSUM = 1, 2, 3
_CHECKSUM_BYTES = 4
# Deflate makes at most 1032 bytes of one: smaller chunks cannot be bombs.
_MAX_UNCHECKED_BYTES = limits.MAX_CHUNK_BYTES // 1032


class Hdf5Events:
    """Events of an HDF5 file; see `EventStream`."""

    def __init__(self, path: Path) -> None:
        """Find the columns.

        Raises:
            SourceError: h5py is missing, or the file has another layout, or asks for more than it holds.
        """
        self._path = path
        self.notes: list[str] = []
        with _open(path) as file:
            try:
                self._find_columns(file)
            except _DAMAGE as error:
                raise SourceError(f"{path}: {error}") from None

    def _find_columns(self, file: Any) -> None:
        events = _child(file, "events")
        missing = [name for name in _COLUMNS if events is None or _child(events, name) is None]
        if missing:
            raise SourceError(
                f"{self._path} has no events/{missing[0]}; it has {_list_names(file)}",
                "Events are read as DSEC lays them out: events/t, events/x, events/y, events/p.",
            )
        columns = {name: events[name] for name in _COLUMNS}
        lengths = {name: _check_column(column) for name, column in columns.items()}
        self._n_events = min(lengths.values())
        if self._n_events < max(lengths.values()):
            said = ", ".join(f"{name} {length}" for name, length in lengths.items())
            self.notes.append(f"{self._path.name}: columns of unequal length ({said}); the shortest is used")
        n_stored = min(sum(column.id.get_storage_size() for column in columns.values()), _n_bytes(self._path))
        n_bytes = self._n_events * sum(column.dtype.itemsize for column in columns.values())
        if n_bytes > unpacking.unpacked_limit(n_stored):
            raise ValueError(
                f"it declares {self._n_events:.3g} events, and stores {n_stored / 1e6:.3g} MB of them"
            )
        width, height = (_integer(events, name) or _integer(file, name) for name in ("width", "height"))
        self.resolution_px = (width, height) if width and height else None
        self._offset_us = _integer(file, "t_offset") or _integer(events, "t_offset") or 0

    def stretches(self, losses: Losses) -> Iterator[EventColumns]:
        """Yield the events a million at a time.

        Raises:
            SourceError: they are compressed by a filter that is not installed, or damaged.
        """
        with _open(self._path) as file:
            columns = [_Hdf5Column(file["events"][name]) for name in _COLUMNS]
            for begin in range(0, self._n_events, _BLOCK_EVENTS):
                end = min(begin + _BLOCK_EVENTS, self._n_events)
                try:
                    block = [column.read(begin, end) for column in columns]
                    yield self._to_columns(block, losses)
                except _DAMAGE as error:
                    if begin:
                        lost = f"event {begin}: {error}"
                        losses.add(damage("recording.torn_end", lost))
                        return
                    raise _unreadable(self._path, file, error) from None

    def _to_columns(self, block: list[NDArray[Any]], losses: Losses) -> EventColumns:
        t_us, x, y, polarity = block
        if t_us.dtype.kind == "f":
            is_whole = np.floor(t_us) == t_us
            if np.count_nonzero(is_whole) < np.count_nonzero(np.isfinite(t_us)):
                raise ValueError("events/t holds fractions, not whole microseconds")
        is_pixel = _is_pixel(x) & _is_pixel(y)
        if not np.all(is_pixel):
            losses.add(damage("recording.events_beyond_sensors"), int(np.count_nonzero(~is_pixel)))
            t_us, x, y, polarity = (column[is_pixel] for column in (t_us, x, y, polarity))
        t_ns = to_ns(t_us, self._offset_us)
        return EventColumns(t_ns, x.astype(np.uint16), y.astype(np.uint16), polarity > 0)


class _Hdf5Column:
    """A column of events, read in ranges.

    HDF5 takes what memory a deflated chunk unpacks to, however much more that is than it should. Chunks large
    enough for that to matter are unpacked here.
    """

    def __init__(self, dataset: Any) -> None:
        self._dataset = dataset
        self._large: dict[int, int] = {}
        self._latest: tuple[int, NDArray[Any]] | None = None
        self._filters = _filters(dataset)
        if dataset.chunks and _DEFLATE in self._filters:
            dataset.id.chunk_iter(self._note_chunk)

    def _note_chunk(self, chunk: Any) -> None:
        is_deflated = not chunk.filter_mask >> self._filters.index(_DEFLATE) & 1
        if is_deflated and chunk.size > _MAX_UNCHECKED_BYTES:
            self._large[chunk.chunk_offset[0]] = chunk.filter_mask

    def read(self, begin: int, end: int) -> NDArray[Any]:
        """Read the numbers from begin on, up to end."""
        if not self._large:
            return np.asarray(self._dataset[begin:end])
        (length,) = self._dataset.chunks
        starts = range(begin // length * length, end, length)
        pieces = [self._chunk(start)[max(begin - start, 0) : end - start] for start in starts]
        return np.concatenate(pieces)

    def _chunk(self, start: int) -> NDArray[Any]:
        if start not in self._large:
            return np.asarray(self._dataset[start : start + self._dataset.chunks[0]])
        if self._latest is None or self._latest[0] != start:
            self._latest = start, self._unpacked(start)
        return self._latest[1]

    def _unpacked(self, start: int) -> NDArray[Any]:
        """Unpack a chunk; deflate carries a checksum of its own, so that HDF5's is not checked."""
        dtype, (length,) = self._dataset.dtype, self._dataset.chunks
        skipped, packed = self._dataset.id.read_direct_chunk((start,))
        data = unpacking.decompress(_Inflater(), packed, dtype.itemsize * length + _CHECKSUM_BYTES)
        if _SHUFFLE in self._filters and not skipped >> self._filters.index(_SHUFFLE) & 1:
            by_byte = np.frombuffer(data, np.uint8, dtype.itemsize * length).reshape(dtype.itemsize, length)
            numbers = np.empty(length, dtype)
            for i, column in enumerate(by_byte):
                numbers.view(np.uint8)[i :: dtype.itemsize] = column
            return numbers
        return np.frombuffer(data, dtype, length)


class _Inflater:
    """zlib's, in the form of the other libraries' decompressors."""

    def __init__(self) -> None:
        self._zlib = zlib.decompressobj()

    @property
    def eof(self) -> bool:
        return self._zlib.eof

    @property
    def needs_input(self) -> bool:
        return not self._zlib.unconsumed_tail

    def decompress(self, data: bytes, max_length: int = -1) -> bytes:
        return self._zlib.decompress(data or self._zlib.unconsumed_tail, max_length)


@contextmanager
def _open(path: Path) -> Iterator[Any]:
    try:
        import h5py  # type: ignore[import-untyped]
    except ImportError:
        raise SourceError(f"{path}: h5py is not installed", 'pip install "lce-rig[events]"') from None
    # Registers the compression filters (blosc, zstd) that event files use.
    with suppress(ImportError):
        import_module("hdf5plugin")
    # HDF5 would wait for what comes out of a pipe.
    open_recorded(path).close()
    try:
        file = h5py.File(path, "r")
    except _DAMAGE as error:
        raise SourceError(f"{path} cannot be read as HDF5: {error}") from None
    try:
        yield file
    finally:
        # What is damaged may show on closing; it was only read.
        with suppress(*_DAMAGE):
            file.close()


def _child(group: Any, name: str) -> Any:
    """Find a member of a group; None where there is none.

    Raises:
        ValueError: it is a link, which might lead to any file.
    """
    import h5py

    if not isinstance(group, h5py.Group):
        raise ValueError(f"{group.name[1:]} is not a group")
    link = group.get(name, getlink=True)
    if link is None:
        return None
    if not isinstance(link, h5py.HardLink):
        where = f"{group.name}/{name}".lstrip("/")
        raise ValueError(f"{where} is a link to elsewhere, which is not followed: copy what it names in here")
    return group[name]


def _check_column(column: Any) -> int:
    """Make sure that a column is a list of numbers in this file, and count them.

    Raises:
        ValueError: it is not.
    """
    name = column.name[1:]
    _check_dataset(column)
    if len(column.shape) != 1:
        raise ValueError(f"{name} has {len(column.shape)} dimensions, not one")
    if column.chunks and column.dtype.itemsize * math.prod(column.chunks) > limits.MAX_CHUNK_BYTES:
        raise ValueError(f"{name} lies in chunks of {column.chunks[0]:.3g} numbers: more than one may have")
    if sum(number not in (_SHUFFLE, _CHECKSUM) for number in _filters(column)) > 1:
        raise ValueError(f"{name} is compressed more than once")
    return int(column.shape[0])


def _check_dataset(dataset: Any) -> None:
    """Make sure that a dataset holds numbers, in this file.

    Raises:
        ValueError: it does not.
    """
    import h5py

    name = dataset.name[1:]
    if not isinstance(dataset, h5py.Dataset):
        raise ValueError(f"{name} is not a dataset")
    if dataset.is_virtual or dataset.id.get_create_plist().get_external_count():
        raise ValueError(f"{name} lies in other files, which are not followed: copy it in here")
    if dataset.dtype.kind not in "biuf" or dataset.shape is None:
        raise ValueError(f"{name} holds {limits.describe(dataset.dtype)}, not numbers")


def _filters(dataset: Any) -> list[int]:
    settings = dataset.id.get_create_plist()
    return [settings.get_filter(i)[0] for i in range(settings.get_nfilters())]


def _is_pixel(column: NDArray[Any]) -> NDArray[np.bool_] | np.bool_:
    if column.dtype.kind != "f" and column.dtype in (np.uint8, np.uint16):
        return np.True_
    return (column >= 0) & (column < 1 << 16)


def _n_bytes(path: Path) -> int:
    return path.stat().st_size


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
    """Read a number that is an attribute or a dataset of one; None where it is not there.

    Raises:
        ValueError: it is not a whole number.
    """
    if name in holder.attrs:
        attribute = holder.attrs.get_id(name)
        kind, n_values = attribute.dtype.kind, attribute.get_space().get_simple_extent_npoints()
        value = holder.attrs[name] if kind in "iuf" and n_values == 1 else None
    else:
        dataset = _child(holder, name)
        if dataset is None:
            return None
        _check_dataset(dataset)
        value = dataset[()] if dataset.size == 1 else None
    number = None if value is None else float(np.asarray(value).ravel()[0])
    if number is None or not abs(number) < limits.MAX_TIME_NS // 1000:
        raise ValueError(f"{name} is not a number")
    return int(np.asarray(value).ravel()[0])


def _list_names(file: Any) -> str:
    names: list[str] = []

    def take(name: str) -> bool | None:
        names.append(name)
        return len(names) >= 12 or None

    with suppress(RuntimeError):
        file.visit(take)
    return ", ".join(names) or "nothing"
