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
# Columns of a sensor shrink to a tenth at best.
_USUAL_RATIO = 20
# The same events, the same bytes: no time of writing goes into the archive.
_ZIP_EPOCH = (1980, 1, 1, 0, 0, 0)
# By the columns' names in archives of other programs.
_TIMES = {"t_us": _NS_PER_US, "t_ns": 1, "t": None, "ts": None}
_ALIASES = {"x": ("x", "xs"), "y": ("y", "ys"), "polarity": ("polarity", "p", "ps", "pol")}


def encode_events(events: Events) -> bytes:
    """Write events as a compressed archive; the same events give the same bytes.

    Stamps are stored as whole microseconds (t_us) where they are that, else as nanoseconds (t_ns).

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


def decode_events(data: bytes, sensor: str, resolution_px: tuple[int, int] | None = None) -> Events:
    """Read an archive of this program or another's from memory; see `read_events`."""
    return read_events(io.BytesIO(data), sensor, resolution_px)


def read_events(file: BinaryIO, sensor: str, resolution_px: tuple[int, int] | None = None) -> Events:
    """Read an archive of this program or another's: t|ts, x|xs, y|ys, p|ps|pol, in any order of time.

    Times of other programs are seconds where they are fractions, else microseconds.

    Args:
        file: the archive.
        sensor: name of the camera.
        resolution_px: (width, height) where the archive does not say; None takes the events' extent.

    Raises:
        ValueError: what is wrong with the file, in words.
    """
    columns = _Columns(file)
    t_ns = _times(columns)
    x, y = _pixels(columns, "x"), _pixels(columns, "y")
    polarity = _column(columns, "polarity") > 0
    lengths = {len(column) for column in (t_ns, x, y, polarity)}
    if len(lengths) != 1:
        raise ValueError(f"its columns are of unequal length: {sorted(lengths)}")
    declared_px = _resolution(columns)
    extent_px = (int(x.max()) + 1, int(y.max()) + 1) if len(x) else (0, 0)
    width, height = declared_px or resolution_px or extent_px
    if width * height > limits.MAX_EVENT_PIXELS:
        raise ValueError(f"its pixels are beyond any sensor: {width}x{height}")
    return Events(sensor, t_ns, x, y, polarity, width, height, _host_ns(columns))


class _Columns:
    """The arrays of an archive by name, each unpacked when asked for."""

    def __init__(self, file: BinaryIO) -> None:
        with _damage_in_words():
            self._archive = unpacking.open_archive(file)
        members = self._archive.infolist()
        self._members = {member.filename.removesuffix(".npy"): member for member in members}
        if len(self._members) != len(members):
            raise ValueError("it holds several columns of one name")

    def __contains__(self, name: str) -> bool:
        return name in self._members

    def __str__(self) -> str:
        return limits.describe(", ".join(sorted(self._members)) or "nothing")

    def read(self, name: str) -> NDArray[Any]:
        """Unpack one; its own header must agree with what is there.

        Raises:
            ValueError: it is damaged, too large, or no array of numbers.
        """
        with _damage_in_words():
            member = self._members[name]
            # A long recording is large in the file, too; what is small there stays small.
            stored = min(_USUAL_RATIO * member.compress_size, 8 * limits.MAX_EVENTS)
            data = unpacking.read_member(self._archive, member, max(stored, limits.MAX_CHUNK_BYTES))
            shape, dtype, begin = _npy_header(data, name)
        n_numbers = math.prod(shape)
        if dtype.kind not in "biuf" or len(shape) > 1:
            raise ValueError(f"its column {name} is no list of numbers")
        if begin + n_numbers * dtype.itemsize != len(data):
            raise ValueError(f"its column {name} declares {n_numbers} numbers and holds others")
        return np.frombuffer(data, dtype, n_numbers, begin).reshape(shape)


@contextmanager
def _damage_in_words() -> Iterator[None]:
    try:
        yield
    except Exception as error:  # A damaged archive fails in any way: zip, zlib, encryption, sizes, syntax.
        raise ValueError(f"it is no archive of events, or a damaged one: {error}") from None


def _npy_header(data: bytes, name: str) -> tuple[tuple[int, ...], np.dtype[Any], int]:
    """Read shape and type of an array, and where its numbers begin."""
    file = io.BytesIO(data)
    if not data.startswith(np.lib.format.MAGIC_PREFIX):
        raise ValueError(f"its column {name} is no array")
    version = np.lib.format.read_magic(file)
    if version == (1, 0):
        shape, _, dtype = np.lib.format.read_array_header_1_0(file)
    elif version == (2, 0):
        shape, _, dtype = np.lib.format.read_array_header_2_0(file)
    else:
        raise ValueError(f"its column {name} is of version {version}")
    return shape, dtype, file.tell()


def _times(columns: _Columns) -> NDArray[np.int64]:
    name = next((name for name in _TIMES if name in columns), None)
    if name is None:
        raise ValueError(f"it has no times (t_us); it has {columns}")
    times, scale = _list_of_numbers(columns, name), _TIMES[name]
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


def _pixels(columns: _Columns, name: str) -> NDArray[np.uint16]:
    found = _column(columns, name)
    if len(found) and not (found.min() >= 0 and found.max() <= np.iinfo(np.uint16).max):
        raise ValueError("its pixels are beyond any sensor")
    return found.astype(np.uint16)


def _column(columns: _Columns, name: str) -> NDArray[Any]:
    found = next((alias for alias in _ALIASES[name] if alias in columns), None)
    if found is None:
        raise ValueError(f"it has no column {name}; it has {columns}")
    return _list_of_numbers(columns, found)


def _list_of_numbers(columns: _Columns, name: str) -> NDArray[Any]:
    column = columns.read(name)
    if column.ndim != 1:
        raise ValueError(f"its column {name} is no list of numbers")
    return column


def _resolution(columns: _Columns) -> tuple[int, int] | None:
    if "resolution_px" not in columns:
        return None
    size = columns.read("resolution_px")
    if size.shape != (2,) or size.dtype.kind not in "iu":
        raise ValueError("its resolution_px is no width and height")
    return int(size[0]), int(size[1])


def _host_ns(columns: _Columns) -> int | None:
    host = columns.read("host_ns") if "host_ns" in columns else None
    if host is None or host.ndim or host.dtype.kind not in "iu" or abs(int(host)) >= limits.MAX_TIME_NS:
        return None
    return int(host)
