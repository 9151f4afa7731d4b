"""Point clouds from files."""

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lce_rig.core.errors import SourceError, reading
from lce_rig.core.limits import MAX_FIELDS, MAX_FILE_BYTES, check_points, check_size, describe, read_file
from lce_rig.core.pcd import decode_pcd
from lce_rig.core.text_table import read_table

# The PLY format, as far as point clouds use it: the vertices' scalar properties.
#
# References:
#     http://paulbourke.net/dataformats/ply/

_KINDS = {
    **{"char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "i2", "int16": "i2"},
    **{"ushort": "u2", "uint16": "u2", "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4"},
    **{"float": "f4", "float32": "f4", "double": "f8", "float64": "f8", "int64": "i8", "uint64": "u8"},
}
_ORDERS = {"ascii": "=", "binary_little_endian": "<", "binary_big_endian": ">"}
_MAX_HEADER_BYTES = 65536


@dataclass
class _Element:
    name: str
    count: int
    columns: list[tuple[str, str]] = field(default_factory=list)
    has_list: bool = False


def decode_ply(data: bytes) -> NDArray[Any]:
    """Decode the vertices of a PLY file.

    Args:
        data: the file's bytes.

    Returns:
        Structured (N,) with the vertices' properties.

    Raises:
        ValueError: what is wrong with the file, in words.
    """
    if not data:
        raise ValueError("it is empty")
    encoding, elements, first = _split_header(data)
    names = [element.name for element in elements]
    if "vertex" not in names:
        raise ValueError("it has no vertices")
    n_rows_before, start = 0, first
    for element in elements[: names.index("vertex") + 1]:
        if element.has_list:
            raise ValueError(f"its element {describe(element.name)} has a list, which is not supported")
        dtype = _dtype(element, _ORDERS[encoding])
        if element.name != "vertex":
            n_rows_before += element.count
            start += element.count * dtype.itemsize
    n_points = check_points(element.count)
    check_size(n_points * dtype.itemsize, max_bytes=MAX_FILE_BYTES)
    if encoding == "ascii":
        return read_table(data, first, dtype, n_points, n_rows_before)
    n_whole = max(len(data) - start, 0) // dtype.itemsize
    if n_whole < n_points:
        raise ValueError(f"it is truncated: {n_whole} of {n_points} points are there")
    return np.frombuffer(data, dtype, n_points, min(start, len(data)))


def _dtype(element: _Element, order: str) -> np.dtype[Any]:
    if not 1 <= len(element.columns) <= MAX_FIELDS:
        n = len(element.columns)
        raise ValueError(
            f"its element {describe(element.name)} has {n} properties, 1 to {MAX_FIELDS} are read"
        )
    try:
        return np.dtype([(name, order + kind) for name, kind in element.columns])
    except ValueError as error:
        raise ValueError(f"its properties are ambiguous: {error}") from None


def _split_header(data: bytes) -> tuple[str, list[_Element], int]:
    """Read the format and the elements, and where the first of them begins."""
    end = data.find(b"end_header", 0, _MAX_HEADER_BYTES)
    line_end = data.find(b"\n", end, end + 100)
    if not data.startswith(b"ply") or end < 0 or line_end < 0:
        raise ValueError("it has no PLY header")
    encoding = ""
    elements: list[_Element] = []
    for line in data[:end].decode("ascii", errors="replace").splitlines()[1:]:
        words = line.split()
        if words[:1] == ["format"] and len(words) > 1:
            encoding = words[1]
        elif words[:1] == ["element"] and len(words) == 3 and _is_count(words[2]):
            elements.append(_Element(words[1], int(words[2])))
        elif words[:1] == ["property"] and elements:
            if words[1:2] == ["list"]:
                elements[-1].has_list = True
            else:
                elements[-1].columns.append(_parse_property(words))
    if encoding not in _ORDERS:
        raise ValueError(f"its format is {describe(encoding or 'missing')}; known are {', '.join(_ORDERS)}")
    return encoding, elements, line_end + 1


def _is_count(word: str) -> bool:
    return word.isdigit() and len(word) <= 18


def _parse_property(words: list[str]) -> tuple[str, str]:
    if len(words) != 3 or words[1] not in _KINDS:
        raise ValueError(f"its header line {describe(' '.join(words))} is not understood")
    return words[2], _KINDS[words[1]]


DECODERS: dict[str, Callable[[bytes], NDArray[Any]]] = {".pcd": decode_pcd, ".ply": decode_ply}


def read_cloud(path: Path) -> NDArray[Any]:
    """Read a PCD or PLY file as it is.

    Returns:
        Structured (N,) with the file's own fields.

    Raises:
        SourceError: the file is missing, empty, truncated or damaged.
    """
    with reading(path, SourceError):
        return DECODERS[path.suffix.lower()](read_file(path))
