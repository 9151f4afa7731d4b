"""Events as one plain file and back: a NumPy archive of columns t_us, x, y, polarity."""

import io
import zipfile
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lce_rig.core.data import Events

FORMAT_VERSION = 1
_NS_PER_US = 1000
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
    """Read an archive of this program or another's: t|ts, x|xs, y|ys, p|ps|pol, in any order of time.

    Times of other programs are seconds where they are fractions, else microseconds.

    Args:
        data: the file's bytes.
        sensor: name of the camera.
        resolution_px: (width, height) where the archive does not say; None takes the events' extent.

    Raises:
        ValueError: what is wrong with the file, in words.
    """
    try:
        with np.load(io.BytesIO(data), allow_pickle=False) as archive:
            columns = {name: archive[name] for name in archive.files}
    except Exception as error:  # A damaged archive fails in any way: zip, zlib, encryption, sizes, syntax.
        raise ValueError(f"it is no archive of events, or a damaged one: {error}") from None
    t_ns = _times(columns)
    x, y, polarity = (_column(columns, name) for name in _ALIASES)
    lengths = {len(column) for column in (t_ns, x, y, polarity)}
    if len(lengths) != 1:
        raise ValueError(f"its columns are of unequal length: {sorted(lengths)}")
    if len(x) and (min(x.min(), y.min()) < 0 or max(x.max(), y.max()) > np.iinfo(np.uint16).max):
        raise ValueError("its pixels are beyond any sensor")
    size = columns.get("resolution_px")
    if size is not None:
        if size.shape != (2,) or size.dtype.kind not in "iu":
            raise ValueError("its resolution_px is no width and height")
        resolution_px = int(size[0]), int(size[1])
    width, height = resolution_px or ((int(x.max()) + 1, int(y.max()) + 1) if len(x) else (0, 0))
    host = columns.get("host_ns")
    host_ns = None if host is None or host.ndim or host.dtype.kind not in "iu" else int(host)
    x, y = x.astype(np.uint16), y.astype(np.uint16)
    return Events(sensor, t_ns, x, y, polarity > 0, width, height, host_ns)


def _times(columns: dict[str, NDArray[Any]]) -> NDArray[np.int64]:
    name = next((name for name in _TIMES if name in columns), None)
    if name is None:
        raise ValueError(f"it has no times (t_us); it has {', '.join(sorted(columns)) or 'nothing'}")
    times, scale = _list_of_numbers(columns[name], name), _TIMES[name]
    if scale is None and times.dtype.kind == "f":
        return np.asarray(np.rint(times * 1e6), dtype=np.int64) * _NS_PER_US
    return times.astype(np.int64) * (scale or _NS_PER_US)


def _column(columns: dict[str, NDArray[Any]], name: str) -> NDArray[Any]:
    found = next((columns[alias] for alias in _ALIASES[name] if alias in columns), None)
    if found is None:
        raise ValueError(f"it has no column {name}; it has {', '.join(sorted(columns))}")
    return _list_of_numbers(found, name)


def _list_of_numbers(column: NDArray[Any], name: str) -> NDArray[Any]:
    if column.ndim != 1 or column.dtype.kind not in "biuf":
        raise ValueError(f"its column {name} is no list of numbers")
    return column
