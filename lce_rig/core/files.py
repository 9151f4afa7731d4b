"""Encode and decode the contents of files: JSON, images, events (a NumPy archive)."""

import io
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pydantic_core
from numpy.typing import NDArray

from lce_rig.core.data import Events

_EVENTS_VERSION = 1
_NS_PER_US = 1000
# Fixed time in the archive, so that the same events give the same bytes.
_ZIP_EPOCH = (1980, 1, 1, 0, 0, 0)


def read_json(path: Path) -> Any:
    """Read a JSON document from a file; see `parse_json`.

    Raises:
        OSError: the file is missing, or cannot be read.
        ValueError: the file is not JSON.
    """
    return parse_json(path.read_bytes())


def parse_json(data: bytes) -> Any:
    """Parse a JSON document in UTF-8; NaN and Infinity are not JSON.

    Raises:
        ValueError: the data are not such a document.
    """
    return pydantic_core.from_json(data.removeprefix(b"\xef\xbb\xbf"), allow_inf_nan=False)


def decode_pixels(data: bytes, flags: int) -> NDArray[Any]:
    """Decode a PNG, JPEG, BMP, TIFF, PNM or WebP image.

    OpenCV refuses images of more than OPENCV_IO_MAX_IMAGE_PIXELS, which the command line sets.

    Args:
        data: the file's bytes.
        flags: OpenCV's, of `imdecode`.

    Returns:
        (H, W) or (H, W, C), as OpenCV decodes it.

    Raises:
        ValueError: the data are truncated, damaged, or not an image.
    """
    import cv2

    if not data:
        raise ValueError("it is empty")
    # Older OpenCV fills the missing part of a torn JPEG or PNG with grey, without an error.
    if data.startswith(b"\x89PNG") and b"IEND" not in data[-64:]:
        raise ValueError("it is a truncated PNG image")
    if data.startswith(b"\xff\xd8") and b"\xff\xd9" not in data[-1024:]:
        raise ValueError("it is a truncated JPEG image")
    try:
        pixels = cv2.imdecode(np.frombuffer(data, dtype=np.uint8), flags)
    except cv2.error:
        pixels = None
    if pixels is None:
        raise ValueError("it is damaged, too large, or in an unsupported image format")
    return np.asarray(pixels)


def encode_events(events: Events) -> bytes:
    """Encode events as a compressed archive; the same events give the same bytes.

    Timestamps are stored in microseconds (t_us) if all are whole ones, else in nanoseconds (t_ns).

    Returns:
        The bytes of an .npz file, to be written in one step.
    """
    is_whole = not np.any(events.t_ns % _NS_PER_US)
    columns: dict[str, NDArray[Any]] = {
        "format_version": np.array(_EVENTS_VERSION),
        "resolution_px": np.array([events.width_px, events.height_px]),
        "t_us" if is_whole else "t_ns": events.t_ns // _NS_PER_US if is_whole else events.t_ns,
        "x": events.x,
        "y": events.y,
        "polarity": events.polarity,
    }
    if events.host_ns is not None:
        columns["host_ns"] = np.array(events.host_ns)
    buffer = io.BytesIO()
    # Captures must be written fast: NumPy's own compression is seven times slower and only 5 % smaller.
    # Compressing the pixel columns takes most of the time and hardly reduces them.
    with zipfile.ZipFile(buffer, "w") as archive:
        for name, column in columns.items():
            plain = io.BytesIO()
            np.lib.format.write_array(plain, np.asarray(column), allow_pickle=False)
            entry = zipfile.ZipInfo(f"{name}.npy", _ZIP_EPOCH)
            how = zipfile.ZIP_STORED if name in ("x", "y") else zipfile.ZIP_DEFLATED
            archive.writestr(entry, plain.getvalue(), how, compresslevel=1)
    return buffer.getvalue()


def decode_events(data: bytes, sensor: str) -> Events:
    """Read an archive that `encode_events` wrote.

    Raises:
        Exception: raised by NumPy or zipfile for damaged archives.
    """
    with np.load(io.BytesIO(data), allow_pickle=False) as archive:
        columns = {name: np.asarray(archive[name]) for name in archive.files}
    time, scale = ("t_us", _NS_PER_US) if "t_us" in columns else ("t_ns", 1)
    width, height = map(int, columns["resolution_px"])
    host_ns = int(columns["host_ns"]) if "host_ns" in columns else None
    return Events(
        sensor,
        columns[time].astype(np.int64) * scale,
        columns["x"],
        columns["y"],
        columns["polarity"],
        width,
        height,
        host_ns,
    )
