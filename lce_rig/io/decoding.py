"""Images and point clouds from files, unchanged: no rotation by EXIF, no colour management."""

import io
import struct
from collections.abc import Callable
from importlib.util import find_spec
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lce_rig.core.bounds import MAX_BYTES, decoding
from lce_rig.core.errors import SourceError, reading
from lce_rig.core.files import decode_pixels
from lce_rig.core.pcd import decode_pcd

SUFFIXES = frozenset({".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".pgm", ".ppm", ".webp"})
_MAX_SAMPLED = 1 << 24
# LAS header: minor version, bytes of the header, offset of points, number of records, bytes and number of
# points; LAS 1.4: offset and number of extended records, number of points. Bytes of a record's head.
_LAS_HEADER, _LAS_14 = struct.Struct("<25xB68xHIIxHI"), struct.Struct("<235xQIQ")
_VLR_BYTES, _EVLR_BYTES = 54, 60
# PLY types by the names of its properties' types, and byte orders by its formats.
_KINDS = {
    **{"char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "i2", "int16": "i2"},
    **{"ushort": "u2", "uint16": "u2", "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4"},
    **{"float": "f4", "float32": "f4", "double": "f8", "float64": "f8", "int64": "i8", "uint64": "u8"},
}
_ORDERS = {"ascii": "=", "binary_little_endian": "<", "binary_big_endian": ">"}


def read_image(path: Path) -> NDArray[np.uint8]:
    """Read an image.

    Returns:
        (H, W) grey or (H, W, 3) BGR.

    Raises:
        SourceError: the file is missing, empty, truncated or no image.
    """
    with reading(path, most_bytes=MAX_BYTES), decoding():
        return decode_image(path.read_bytes())


def decode_image(data: bytes) -> NDArray[np.uint8]:
    """Decode a PNG, JPEG or other image file held in memory.

    Raises:
        ValueError: the data are damaged or not an image; the text states the reason.
    """
    import cv2

    flags = cv2.IMREAD_ANYCOLOR | cv2.IMREAD_ANYDEPTH | cv2.IMREAD_IGNORE_ORIENTATION
    return to_8_bit(decode_pixels(data, flags))


def is_plain_png(data: bytes) -> bool:
    """Return whether a file that was decoded is a PNG of 8-bit grey or colour, without transparency."""
    is_plain = data.startswith(b"\x89PNG") and data[24] == 8 and data[25] in (0, 2)
    return is_plain and b"tRNS" not in data[: data.find(b"IDAT")]


@np.errstate(invalid="ignore")  # of signalling NaN
def to_8_bit(pixels: NDArray[Any]) -> NDArray[np.uint8]:
    """Convert pixels to 8 bits; deeper images are stretched between their darkest and brightest percent.

    Twelve-bit sensors leave the upper bits of 16 empty: a plain shift would give black images.

    Raises:
        ValueError: pixels of a kind no camera delivers.
    """
    if pixels.dtype == np.uint8:
        return np.ascontiguousarray(pixels)
    if pixels.dtype not in (np.uint16, np.float32):
        raise ValueError(f"its pixels are {pixels.dtype}, not 8 or 16 bit")
    # Every k-th pixel has the same quantiles and needs no copy of a large image.
    sample = pixels.ravel()[:: 1 + pixels.size // _MAX_SAMPLED].astype(np.float64)
    sample = sample[np.isfinite(sample)]
    if not len(sample):
        raise ValueError("none of its pixels is finite")
    low, high = np.percentile(sample, (1, 99))
    stretched = np.empty(pixels.shape, dtype=np.uint8)
    for row, values in zip(stretched, pixels, strict=True):
        scaled = (values.astype(np.float64) - low) * (255.0 / max(float(high - low), 1e-6))
        row[...] = np.nan_to_num(np.clip(np.rint(scaled), 0, 255))
    return stretched


def decode_ply(data: bytes) -> NDArray[Any]:
    """Decode the vertices of a PLY file: their scalar properties.

    Open3D's reader is not used: it drops rings of 16 bits, gives wrong coordinates if their types differ,
    and pads torn files with zeros.

    Args:
        data: the file's bytes.

    Returns:
        Structured (N,) with the vertices' properties.

    Raises:
        ValueError: the file is damaged, or of an unknown kind.

    References:
        http://paulbourke.net/dataformats/ply/
    """
    file = io.BytesIO(data)
    encoding, element = "", ""
    sizes, columns = dict[str, int](), dict[str, list[tuple[str, str]]]()
    while words := file.readline().decode("ascii").split():
        if words[0] == "format":
            encoding = words[1]
        elif words[0] == "element":
            element = words[1]
            sizes[element], columns[element] = int(words[2]), []
        elif words[0] == "property" and (words[1] != "list" or "vertex" not in sizes or element == "vertex"):
            # Lists after the vertices, such as corners of faces, are not read.
            columns[element].append((words[2], _ORDERS[encoding] + _KINDS[words[1]]))
        elif words[0] == "end_header":
            break
    if encoding not in _ORDERS or "vertex" not in sizes:
        raise ValueError("it has no PLY header with vertices")
    for element, n_rows in sizes.items():
        dtype = np.dtype(columns[element])
        if encoding == "ascii":
            rows = np.loadtxt(islice(file, n_rows), dtype, ndmin=1) if n_rows else np.empty(0, dtype)
        else:
            rows = np.frombuffer(file.read(n_rows * dtype.itemsize), dtype)
        if len(rows) != n_rows:
            raise ValueError(f"it is truncated: {len(rows)} of {n_rows} points are there")
        if element == "vertex":
            break
    return rows


def decode_las(data: bytes) -> NDArray[Any]:
    """Decode the points of a LAS file: coordinates in metres, intensity and extra dimensions.

    Returns:
        Structured (N,), by lower-case names.

    Raises:
        SourceError: laspy is not installed.
        ValueError: the file is truncated.
    """
    require_las()
    import laspy

    _check_las(data)
    # Decompressors of LAZ abort the process on damaged files.
    cloud = laspy.read(io.BytesIO(data), laz_backend=())
    if len(cloud.points) != cloud.header.point_count:
        raise ValueError(
            f"it is truncated: {len(cloud.points)} of {cloud.header.point_count} points are there"
        )
    own = list(cloud.point_format.extra_dimension_names)
    columns = {name.lower(): np.asarray(cloud[name]) for name in ("x", "y", "z", "intensity", *own)}
    rows = np.empty(len(cloud.points), [(name, column.dtype) for name, column in columns.items()])
    for name, column in columns.items():
        rows[name] = column
    return rows


def _check_las(data: bytes) -> None:
    """Compare the counts in a header with the size of the file; laspy loops over them.

    Raises:
        ValueError: the file is smaller than its header states.

    References:
        ASPRS, LAS specification 1.4-R15, table 3.
    """
    if len(data) < _LAS_HEADER.size or not data.startswith(b"LASF"):
        raise ValueError("it has no LAS header")
    minor, header_bytes, points_at, n_vlrs, n_bytes, n_points = _LAS_HEADER.unpack_from(data)
    evlrs_at, n_evlrs = 0, 0
    if minor >= 4 and len(data) >= _LAS_14.size:
        evlrs_at, n_evlrs, n_all = _LAS_14.unpack_from(data)
        n_points = max(n_points, n_all)
    needed = max(
        header_bytes + _VLR_BYTES * n_vlrs,
        points_at + n_bytes * n_points,
        evlrs_at + _EVLR_BYTES * n_evlrs,
    )
    if needed > len(data):
        raise ValueError(f"it is truncated: {len(data)} of at least {needed} bytes are there")


def require_las() -> None:
    """Refuse LAS files where their reader is not installed.

    Raises:
        SourceError: laspy is not installed.
    """
    if find_spec("laspy") is None:
        raise SourceError("LAS files need laspy", "pip install 'lce-rig[las]'")


DECODERS: dict[str, Callable[[bytes], NDArray[Any]]] = {
    ".pcd": decode_pcd,
    ".ply": decode_ply,
    ".las": decode_las,
}


def read_cloud(path: Path) -> NDArray[Any]:
    """Read a PCD, PLY or LAS file unchanged.

    Returns:
        Structured (N,) with the file's own fields.

    Raises:
        SourceError: the file is missing, empty, truncated or damaged.
    """
    with reading(path, most_bytes=MAX_BYTES), decoding():
        return DECODERS[path.suffix.lower()](path.read_bytes())
