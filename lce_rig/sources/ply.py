"""The PLY format, as far as point clouds use it: the vertices' scalar properties.

References:
    http://paulbourke.net/dataformats/ply/
"""

import io
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

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
    encoding, elements, body = _split_header(data)
    order = _ORDERS[encoding]
    n_rows_before, n_bytes_before = 0, 0
    for element in elements:
        if element.has_list and "vertex" in (later.name for later in elements[elements.index(element) :]):
            raise ValueError(f"its element {element.name!r} has a list, which this program does not read")
        dtype = np.dtype([(name, order + kind) for name, kind in element.columns])
        if element.name == "vertex":
            if encoding == "ascii":
                return _decode_ascii(body, n_rows_before, element.count, dtype)
            n_whole = max(len(body) - n_bytes_before, 0) // max(dtype.itemsize, 1)
            if n_whole < element.count:
                raise ValueError(f"it is truncated: {n_whole} of {element.count} points are there")
            return np.frombuffer(body, dtype, element.count, n_bytes_before)
        n_rows_before += element.count
        n_bytes_before += element.count * dtype.itemsize
    raise ValueError("it has no vertices")


def _split_header(data: bytes) -> tuple[str, list[_Element], bytes]:
    end = data.find(b"end_header", 0, _MAX_HEADER_BYTES)
    line_end = data.find(b"\n", end)
    if not data.startswith(b"ply") or end < 0 or line_end < 0:
        raise ValueError("it has no PLY header")
    encoding = ""
    elements: list[_Element] = []
    for line in data[:end].decode("ascii", errors="replace").splitlines()[1:]:
        words = line.split()
        if words[:1] == ["format"] and len(words) > 1:
            encoding = words[1]
        elif words[:1] == ["element"] and len(words) == 3 and words[2].isdigit():
            elements.append(_Element(words[1], int(words[2])))
        elif words[:1] == ["property"] and elements:
            if words[1:2] == ["list"]:
                elements[-1].has_list = True
            else:
                elements[-1].columns.append(_parse_property(words))
    if encoding not in _ORDERS:
        raise ValueError(f"its format is {encoding or 'missing'!r}; known are {', '.join(_ORDERS)}")
    return encoding, elements, data[line_end + 1 :]


def _parse_property(words: list[str]) -> tuple[str, str]:
    if len(words) != 3 or words[1] not in _KINDS:
        raise ValueError(f"its header line {' '.join(words)!r} cannot be understood")
    return words[2], _KINDS[words[1]]


def _decode_ascii(body: bytes, n_before: int, n_points: int, dtype: np.dtype[Any]) -> NDArray[Any]:
    rows = [line for line in body.split(b"\n") if line.strip()][n_before : n_before + n_points]
    if len(rows) < n_points:
        raise ValueError(f"it is truncated: {len(rows)} of {n_points} points are there")
    if n_points == 0:
        return np.empty(0, dtype=dtype)
    try:
        return np.loadtxt(io.BytesIO(b"\n".join(rows)), dtype=dtype, ndmin=1, comments=None)
    except ValueError as error:
        raise ValueError(f"its text cannot be read as numbers: {error}") from None
