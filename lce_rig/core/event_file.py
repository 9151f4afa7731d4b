"""Events as one plain file and back: a NumPy archive of columns t_us, x, y, polarity."""

import io
import math
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from lce_rig.core import limits, unpacking
from lce_rig.core.data import Events

FORMAT_VERSION = 1
_NS_PER_US = 1000
_MAX_HEAD_BYTES = 1 << 16
_MAX_COLUMN_RATIO = 8
_PIECE_BYTES = 1 << 20
# The same events, the same bytes: no time of writing goes into the archive.
_ZIP_EPOCH = (1980, 1, 1, 0, 0, 0)
# By the columns' names in archives of other programs.
_TIMES = {"t_us": _NS_PER_US, "t_ns": 1, "t": None, "ts": None}
_ALIASES = {"x": ("x", "xs"), "y": ("y", "ys"), "polarity": ("polarity", "p", "ps", "pol")}


def encode_events(events: Events) -> bytes:
    """Write events as a compressed archive; the same events give the same bytes.

    Timestamps are stored as whole microseconds (t_us) where they are that, else as nanoseconds (t_ns).

    Returns:
        The bytes of an .npz file, to be put in place in one step by whoever owns the file.
    """
    is_whole = not np.any(events.t_ns % _NS_PER_US)
    columns: dict[str, NDArray[Any]] = {
        "format_version": np.array(FORMAT_VERSION),
        "resolution_px": np.array([events.width_px, events.height_px]),
        "t_us" if is_whole else "t_ns": events.t_ns // _NS_PER_US if is_whole else events.t_ns,
        "x": events.x,
        "y": events.y,
        "polarity": events.polarity,
    }
    if events.host_ns is not None:
        columns["host_ns"] = np.array(events.host_ns)
    buffer = io.BytesIO()
    # A capture must not wait: NumPy's own compression is seven times slower and 5 % smaller; to compress the
    # pixels' columns takes most of the time, and they hardly shrink.
    with zipfile.ZipFile(buffer, "w") as archive:
        for name, column in columns.items():
            plain = io.BytesIO()
            np.lib.format.write_array(plain, np.asarray(column), allow_pickle=False)
            entry = zipfile.ZipInfo(f"{name}.npy", _ZIP_EPOCH)
            how = zipfile.ZIP_STORED if name in ("x", "y") else zipfile.ZIP_DEFLATED
            archive.writestr(entry, plain.getvalue(), how, compresslevel=1)
    return buffer.getvalue()


def decode_events(data: bytes, sensor: str) -> Events:
    """Read an archive of this program or another's from memory; see `EventArchive`.

    Its resolution is the events' extent where it does not say.

    Raises:
        ValueError: what is wrong with the file, in words.
    """
    archive = EventArchive(io.BytesIO(data))
    # A capture of many events is a large file, too: pixels hardly shrink. What is small stays small.
    n_bytes = min(_MAX_COLUMN_RATIO * len(data), limits.MAX_FILE_BYTES)
    limits.check_size(archive.largest_column_bytes, "a column", max(n_bytes, limits.MAX_CHUNK_BYTES))
    t_ns, x, y, polarity = next(archive.stretches(max(archive.n_events, 1)))
    extent_px = (int(x.max()) + 1, int(y.max()) + 1) if len(x) else (0, 0)
    width, height = archive.resolution_px or extent_px
    if width * height > limits.MAX_EVENT_PIXELS:
        raise ValueError(f"its pixels are beyond any sensor: {width}x{height}")
    return Events(sensor, t_ns, x, y, polarity, width, height, archive.host_ns)


class EventArchive:
    """An archive of this program or another's: t|ts, x|xs, y|ys, p|ps|pol, in any order of time.

    Times of other programs are seconds where they are fractions, else microseconds.

    Attributes:
        n_events: how many there are.
        largest_column_bytes: of the columns with the events, in memory.
        resolution_px: (width, height); None if the archive does not say.
        host_ns: host time of the first event; None if the archive does not say.
    """

    def __init__(self, file: BinaryIO) -> None:
        """Find the columns.

        Raises:
            ValueError: what is wrong with the file, in words.
        """
        self._columns = _Columns(file)
        self._time = next((name for name in _TIMES if name in self._columns), None)
        if self._time is None:
            raise ValueError(f"it has no times (t_us); it has {self._columns}")
        self._names = [self._time, *(self._find(name) for name in _ALIASES)]
        columns = [self._columns.open(name) for name in self._names]
        if flat := [column.name for column in columns if not column.shape]:
            raise ValueError(f"its column {flat[0]} is not a list of numbers")
        lengths = {column.n_left for column in columns}
        if len(lengths) != 1:
            raise ValueError(f"its columns are of unequal length: {sorted(lengths)}")
        (self.n_events,) = lengths
        self.largest_column_bytes = max(column.n_bytes_left for column in columns)
        self.resolution_px = _resolution(self._columns)
        self.host_ns = _host_ns(self._columns)

    def stretches(
        self, n_events: int
    ) -> Iterator[tuple[NDArray[np.int64], NDArray[np.uint16], NDArray[np.uint16], NDArray[np.bool_]]]:
        """Yield times (ns), x, y and polarity of so many events at a time; once if there is none.

        Raises:
            ValueError: what is wrong with the file, in words.
        """
        t, x, y, polarity = (self._columns.open(name) for name in self._names)
        while True:
            n = min(n_events, t.n_left)
            times = _times(t.read(n), t.name)
            yield times, _pixels(x.read(n)), _pixels(y.read(n)), polarity.read(n) > 0
            if not t.n_left:
                return

    def _find(self, name: str) -> str:
        found = next((alias for alias in _ALIASES[name] if alias in self._columns), None)
        if found is None:
            raise ValueError(f"it has no column {name}; it has {self._columns}")
        return found


class _Columns:
    """The arrays of an archive by name."""

    def __init__(self, file: BinaryIO) -> None:
        with _damage_in_words():
            self._archive = unpacking.open_archive(file)
        members = self._archive.infolist()
        self._members = {member.filename.removesuffix(".npy"): member for member in members}
        if len(self._members) != len(members):
            raise ValueError("it holds several columns of one name")
        n_stored = sum(member.compress_size for member in members)
        self._max_bytes = unpacking.unpacked_limit(min(n_stored, file.seek(0, io.SEEK_END)))

    def __contains__(self, name: str) -> bool:
        return name in self._members

    def __str__(self) -> str:
        return limits.describe(", ".join(sorted(self._members)) or "nothing")

    def open(self, name: str) -> "_Column":
        """Open an array.

        Raises:
            ValueError: it is damaged, too large for what is stored, or no array of numbers.
        """
        return _Column(self._archive, self._members[name], name, self._max_bytes)


class _Column:
    """An array of an archive, read from its beginning on.

    Attributes:
        name: of the array.
        shape: of the whole.
        n_left: numbers that were not read yet.
    """

    def __init__(self, archive: zipfile.ZipFile, member: zipfile.ZipInfo, name: str, max_bytes: int) -> None:
        """Read the header, which must agree with the size of what follows.

        Raises:
            ValueError: it is damaged, too large, or no array of numbers.
        """
        self.name = name
        with _damage_in_words():
            self._file = unpacking.open_member(archive, member, max_bytes)
            head = self._file.read(_MAX_HEAD_BYTES)
            self.shape, self._dtype, begin = _npy_header(head, name)
        self._ahead = head[begin:]
        self.n_left = math.prod(self.shape)
        if self._dtype.kind not in "biuf" or len(self.shape) > 1:
            raise ValueError(f"its column {name} is not a list of numbers")
        if begin + self.n_left * self._dtype.itemsize != member.file_size:
            raise ValueError(f"its column {name} declares {self.n_left} numbers and holds others")

    @property
    def n_bytes_left(self) -> int:
        return self.n_left * self._dtype.itemsize

    def read(self, n_numbers: int) -> NDArray[Any]:
        """Read the next numbers.

        Raises:
            ValueError: they are damaged, or not there.
        """
        self.n_left -= n_numbers
        pieces = [self._ahead]
        n_missing = n_numbers * self._dtype.itemsize - len(self._ahead)
        with _damage_in_words():
            while n_missing > 0 and (piece := self._file.read(min(n_missing, _PIECE_BYTES))):
                pieces.append(piece)
                n_missing -= len(piece)
            if not self.n_left:
                self._file.read(1)  # Only there zipfile compares the checksum.
        data = b"".join(pieces)
        end = n_numbers * self._dtype.itemsize
        if len(data) < end:
            raise ValueError(f"its column {self.name} is truncated")
        self._ahead = data[end:]
        return np.frombuffer(data, self._dtype, n_numbers)


@contextmanager
def _damage_in_words() -> Iterator[None]:
    try:
        yield
    except Exception as error:  # A damaged archive fails in any way: zip, zlib, encryption, sizes, syntax.
        raise ValueError(f"it is not an archive of events, or it is damaged: {error}") from None


def _npy_header(data: bytes, name: str) -> tuple[tuple[int, ...], np.dtype[Any], int]:
    """Read shape and type of an array, and where its numbers begin."""
    file = io.BytesIO(data)
    if not data.startswith(np.lib.format.MAGIC_PREFIX):
        raise ValueError(f"its column {name} is not an array")
    version = np.lib.format.read_magic(file)
    if version == (1, 0):
        shape, _, dtype = np.lib.format.read_array_header_1_0(file)
    elif version == (2, 0):
        shape, _, dtype = np.lib.format.read_array_header_2_0(file)
    else:
        raise ValueError(f"its column {name} is of version {version}")
    return shape, dtype, file.tell()


def _times(times: NDArray[Any], name: str) -> NDArray[np.int64]:
    scale = _TIMES[name]
    if scale is None and times.dtype.kind == "f":
        with np.errstate(over="ignore"):  # Of numbers longer than double; seen below.
            times_us = times.astype(np.float64) * 1e6
        _check_times(times_us, _NS_PER_US, name)
        return np.asarray(np.rint(times_us), dtype=np.int64) * _NS_PER_US
    scale = scale or _NS_PER_US
    _check_times(times, scale, name)
    return times.astype(np.int64) * scale


def _check_times(times: NDArray[Any], scale: int, name: str) -> None:
    limit = limits.MAX_TIME_NS // scale
    # NaN compares as false.
    if len(times) and not (times.min() > -limit and times.max() < limit):
        raise ValueError(f"its column {name} holds times beyond any clock")


def _pixels(found: NDArray[Any]) -> NDArray[np.uint16]:
    if len(found) and not (found.min() >= 0 and found.max() <= np.iinfo(np.uint16).max):
        raise ValueError("its pixels are beyond any sensor")
    return found.astype(np.uint16)


def _resolution(columns: _Columns) -> tuple[int, int] | None:
    if "resolution_px" not in columns:
        return None
    column = columns.open("resolution_px")
    size = column.read(2) if column.shape == (2,) else np.empty(0)
    if size.dtype.kind not in "iu":
        raise ValueError("its resolution_px is not a width and height")
    width, height = map(int, size)
    if width * height > limits.MAX_EVENT_PIXELS:
        raise ValueError(f"its pixels are beyond any sensor: {width}x{height}")
    return width, height


def _host_ns(columns: _Columns) -> int | None:
    column = columns.open("host_ns") if "host_ns" in columns else None
    if column is None or column.shape:
        return None
    (host,) = column.read(1)
    return int(host) if host.dtype.kind in "iu" and abs(int(host)) < limits.MAX_TIME_NS else None
