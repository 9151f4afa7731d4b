"""Events as one plain file and back: a NumPy archive of columns t_us, x, y, polarity."""

import io
import zipfile
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lce_rig.core.data import MAX_TIME_NS, Events

FORMAT_VERSION = 1
_NS_PER_US = 1000
# The same events, the same bytes: no time of writing goes into the archive.
_ZIP_EPOCH = (1980, 1, 1, 0, 0, 0)


def encode_events(events: Events) -> bytes:
    """Write events as a compressed archive; the same events give the same bytes.

    Timestamps are stored as whole microseconds (t_us) where they are that, else as nanoseconds (t_ns).

    Returns:
        The bytes of an .npz file, for its owner to put in place in one step.
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
    """Read an archive as `encode_events` writes it, in any order of time.

    Raises:
        ValueError: it holds other columns, or values that no sensor sends.
        Exception: as NumPy and zipfile raise it about damaged archives.
    """
    with np.load(io.BytesIO(data), allow_pickle=False) as archive:
        columns = {name: np.asarray(archive[name]) for name in archive.files}
    time, scale = ("t_us", _NS_PER_US) if "t_us" in columns else ("t_ns", 1)
    names = (time, "x", "y", "polarity")
    if missing := [name for name in names if name not in columns]:
        raise ValueError(f"it has no column {missing[0]}; it has {', '.join(columns) or 'nothing'}")
    t, x, y, polarity = (columns[name] for name in names)
    if {column.shape for column in (t, x, y, polarity)} != {(len(t),)}:
        raise ValueError("its columns are not lists of equal length")
    if {t.dtype.kind, x.dtype.kind, y.dtype.kind} - {"i", "u"} or polarity.dtype.kind not in "biu":
        raise ValueError("its columns are not whole numbers")
    if len(t) and not (min(x.min(), y.min()) >= 0 and max(x.max(), y.max()) < 1 << 16):
        raise ValueError("its pixels are beyond any sensor")
    if len(t) and not max(abs(int(t.min())), abs(int(t.max()))) * scale < MAX_TIME_NS:
        raise ValueError(f"its column {time} holds times beyond any clock")
    width, height = map(int, columns["resolution_px"])
    host_ns = int(columns["host_ns"]) if "host_ns" in columns else None
    return Events(
        sensor,
        t.astype(np.int64) * scale,
        x.astype(np.uint16),
        y.astype(np.uint16),
        polarity > 0,
        width,
        height,
        host_ns,
    )
