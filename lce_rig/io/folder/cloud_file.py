"""Point clouds from PCD and PLY files."""

import io
from collections.abc import Callable
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lce_rig.core.errors import reading
from lce_rig.core.pcd import decode_pcd

# Of PLY: by the names of its properties' types, and by its formats.
_KINDS = {
    **{"char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "i2", "int16": "i2"},
    **{"ushort": "u2", "uint16": "u2", "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4"},
    **{"float": "f4", "float32": "f4", "double": "f8", "float64": "f8", "int64": "i8", "uint64": "u8"},
}
_ORDERS = {"ascii": "=", "binary_little_endian": "<", "binary_big_endian": ">"}


def decode_ply(data: bytes) -> NDArray[Any]:
    """Decode the vertices of a PLY file: their scalar properties.

    Open3D's reader is not used: it drops rings of 16 bits, gives wrong coordinates where their types differ,
    and fills up a torn file with zeros.

    Args:
        data: the file's bytes.

    Returns:
        Structured (N,) with the vertices' properties.

    Raises:
        ValueError: it is damaged, or of an unknown kind.

    References:
        http://paulbourke.net/dataformats/ply/
    """
    file = io.BytesIO(data)
    encoding, sizes, columns = "", dict[str, int](), dict[str, list[tuple[str, str]]]()
    while words := file.readline().decode("ascii").split():
        if words[0] == "format":
            encoding = words[1]
        elif words[0] == "element":
            element = words[1]
            sizes[element], columns[element] = int(words[2]), []
        elif words[0] == "property" and (words[1] != "list" or "vertex" not in sizes or element == "vertex"):
            # Lists behind the vertices, such as corners of faces, are not read.
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


DECODERS: dict[str, Callable[[bytes], NDArray[Any]]] = {".pcd": decode_pcd, ".ply": decode_ply}


def read_cloud(path: Path) -> NDArray[Any]:
    """Read a PCD or PLY file unchanged.

    Returns:
        Structured (N,) with the file's own fields.

    Raises:
        SourceError: the file is missing, empty, truncated or damaged.
    """
    with reading(path):
        return DECODERS[path.suffix.lower()](path.read_bytes())
