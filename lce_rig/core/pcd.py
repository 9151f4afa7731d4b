"""Point clouds as PCD files from any writer.

Headers are read as PCL reads them: any white space separates fields, and COUNT and POINTS may be missing.
pypcd4 refuses such files, and allocates memory for as many points as a header states.

References:
    https://pointclouds.org/documentation/tutorials/pcd_file_format.html
"""

import io
import struct
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

_KINDS = {"F": (4, 8), "I": (1, 2, 4, 8), "U": (1, 2, 4, 8)}
_MAX_HEADER_BYTES = 1 << 16
# Maximum number of values per point: megabytes per point cloud are common, more fields than this are an
# error.
_MAX_VALUES = 1024
# LZF writes at most 264 bytes for 3.
_MAX_EXPANSION = 88
_PADDING = "_"


@dataclass(frozen=True)
class _Header:
    """The header of a PCD file.

    Attributes:
        dtype: dtype of a point in the file, padding and repeated names included.
        kept: names of the fields that are read, with their names in `dtype`.
        n_points: number of points stated in the header.
        encoding: "ascii", "binary" or "binary_compressed".
    """

    dtype: np.dtype[Any]
    kept: dict[str, str]
    n_points: int
    encoding: str


def decode_pcd(data: bytes) -> NDArray[Any]:
    """Decode a whole PCD file in any of its three encodings.

    Args:
        data: the file's bytes.

    Returns:
        Structured (N,) with the fields as named in the header; one of count c > 1 as c fields. The first of
        several fields of one name is read.

    Raises:
        ValueError: not a PCD file, damaged, or with fewer points than the header states.
    """
    if not data:
        raise ValueError("it is empty")
    entries, body = _split(data.removeprefix(b"\xef\xbb\xbf"))
    header = _parse(entries)
    read = {"ascii": _read_ascii, "binary": _read_binary, "binary_compressed": _read_compressed}
    rows = read[header.encoding](body, header)
    if list(header.kept) == list(header.dtype.names or ()):
        return rows
    kept = np.empty(len(rows), [(name, header.dtype[own]) for name, own in header.kept.items()])
    for name, own in header.kept.items():
        kept[name] = rows[own]
    return kept


def _split(data: bytes) -> tuple[dict[str, list[str]], bytes]:
    """Split a file into its header's entries and the bytes after the DATA line."""
    file, entries = io.BytesIO(data), dict[str, list[str]]()
    while file.tell() < _MAX_HEADER_BYTES and (line := file.readline(_MAX_HEADER_BYTES)):
        # Comments need not be UTF-8; MATLAB's hold a trade mark sign.
        words = line.decode("ascii", errors="replace").split()
        if not words or words[0].startswith("#"):
            continue
        entries.setdefault(words[0].upper(), words[1:])
        if words[0].upper() == "DATA":
            return entries, data[file.tell() :]
    raise ValueError("it has no PCD header: no line DATA")


def _parse(entries: dict[str, list[str]]) -> _Header:
    fields = entries.get("FIELDS") or entries.get("COLUMNS") or []
    sizes, types = (_numbers(entries, "SIZE", len(fields)), entries.get("TYPE", []))
    counts = _numbers(entries, "COUNT", len(fields)) if "COUNT" in entries else [1] * len(fields)
    if not fields or len(types) != len(fields):
        raise ValueError(f"its header has {len(fields)} FIELDS and {len(types)} entries in TYPE")
    columns: list[tuple[str, str]] = []
    kept: dict[str, str] = {}
    for field, size, letter, count in zip(fields, sizes, types, counts, strict=True):
        kind = letter.upper()
        if size not in _KINDS.get(kind, ()):
            raise ValueError(f"its field {field} is of the unknown type {letter} with {size} bytes")
        if len(columns) + count > _MAX_VALUES:
            raise ValueError(f"its header has more than {_MAX_VALUES} values per point")
        for k in range(count):
            name, own = (field if count == 1 else f"{field}__{k:04d}"), f"_{len(columns)}"
            if field != _PADDING:
                own = own if name in kept else name
                kept.setdefault(name, own)
            columns.append((own, f"<{kind.lower()}{size}"))
    if not kept:
        raise ValueError("its header names no field")
    if "POINTS" in entries:
        (n_points,) = _numbers(entries, "POINTS", 1)
    else:
        n_points = _numbers(entries, "WIDTH", 1)[0]
        n_points *= _numbers(entries, "HEIGHT", 1)[0] if "HEIGHT" in entries else 1
    encoding = " ".join(entries["DATA"][:1]).lower()
    if encoding not in ("ascii", "binary", "binary_compressed"):
        raise ValueError(f"its DATA is {encoding!r}, not ascii, binary or binary_compressed")
    return _Header(np.dtype(columns), kept, n_points, encoding)


def _numbers(entries: dict[str, list[str]], key: str, n: int) -> list[int]:
    """Read the integers of an entry.

    Raises:
        ValueError: the entry is missing, or does not have n integers.
    """
    words = entries.get(key, [])
    if len(words) != n or not all(word.isdecimal() and len(word) < 16 for word in words):
        raise ValueError(f"its header needs {n} numbers in {key}, and has {' '.join(words)[:40] or 'none'}")
    return [int(word) for word in words]


def _require(n_there: int, n_points: int) -> None:
    if n_there < n_points:
        raise ValueError(f"it is truncated: {n_there} of {n_points} points are there")


def _read_ascii(body: bytes, header: _Header) -> NDArray[Any]:
    n_values = len(header.dtype.names or ())
    # A value takes at least a digit and a separator; the last one may lack the latter.
    _require((len(body) + 1) // (2 * n_values), header.n_points)
    if not header.n_points:
        return np.empty(0, header.dtype)
    try:
        rows = _load_rows(body, header.dtype, n_values, header.n_points)
    except ValueError:
        # Some writers print integers with a decimal point.
        try:
            values = _load_rows(body, np.dtype(np.float64), n_values, header.n_points)
        except ValueError:
            raise ValueError(f"its points are not rows of {n_values} numbers") from None
        rows = np.empty(len(values), header.dtype)
        for name, column in zip(header.dtype.names or (), values.T, strict=True):
            of_kind = header.dtype[name]
            if of_kind.kind != "f":
                bounds = np.iinfo(of_kind)
                column = np.clip(np.nan_to_num(column), bounds.min, bounds.max)
            rows[name] = column.astype(of_kind)
    _require(len(rows), header.n_points)
    return rows


def _load_rows(body: bytes, dtype: np.dtype[Any], n_values: int, n_rows: int) -> NDArray[Any]:
    """Load up to n rows of numbers; like PCL, ignore values beyond a row's fields."""
    lines = (line for line in io.StringIO(body.decode("ascii", errors="replace")) if not line.isspace())
    ndmin: Literal[1, 2] = 1 if dtype.names else 2
    return np.asarray(np.loadtxt(lines, dtype, ndmin=ndmin, usecols=range(n_values), max_rows=n_rows))


def _read_binary(body: bytes, header: _Header) -> NDArray[Any]:
    _require(len(body) // header.dtype.itemsize, header.n_points)
    return np.frombuffer(body, header.dtype, header.n_points)


def _read_compressed(body: bytes, header: _Header) -> NDArray[Any]:
    if not header.n_points:
        return np.empty(0, header.dtype)
    if len(body) < 8:
        raise ValueError("it is truncated: no points are there")
    import lzf  # Import here: commands without point clouds need not wait for it.

    n_packed, n_bytes = struct.unpack_from("<II", body)
    there, n_needed = body[8 : 8 + n_packed], header.n_points * header.dtype.itemsize
    if len(there) < n_packed:
        raise ValueError(f"it is truncated: {len(there)} of {n_packed} compressed bytes are there")
    if n_bytes < n_needed or n_bytes > _MAX_EXPANSION * len(there):
        n_there = min(n_bytes, _MAX_EXPANSION * len(there)) // header.dtype.itemsize
        raise ValueError(f"it is truncated: {n_there} of {header.n_points} points are there")
    try:
        plain = lzf.decompress(there, n_needed if n_bytes == n_needed else n_bytes)
    except ValueError:
        plain = None
    if plain is None or len(plain) < n_needed:
        raise ValueError("its compressed points are damaged")
    rows, at = np.empty(header.n_points, header.dtype), 0
    for name in header.dtype.names or ():
        column = np.frombuffer(plain, header.dtype[name], header.n_points, at)
        rows[name], at = column, at + column.nbytes
    return rows


def encode_pcd(cloud: NDArray[Any], comments: Iterable[str] = ()) -> bytes:
    """Encode a point cloud as binary PCD, the inverse of `decode_pcd`.

    Args:
        cloud: structured (N,) of scalar fields.
        comments: lines for the head of the file.
    """
    names = cloud.dtype.names or ()
    dtypes = [cloud.dtype[name] for name in names]
    packed = np.empty(
        len(cloud), dtype=[(n, d.newbyteorder("<")) for n, d in zip(names, dtypes, strict=True)]
    )
    for name in names:
        packed[name] = cloud[name]
    lines = [
        "# .PCD v0.7 - Point Cloud Data file format",
        *(f"# {comment}" for comment in comments),
        "VERSION 0.7",
        "FIELDS " + " ".join(names),
        "SIZE " + " ".join(str(d.itemsize) for d in dtypes),
        "TYPE " + " ".join(d.kind.upper() for d in dtypes),
        "COUNT " + " ".join("1" for _ in dtypes),
        f"WIDTH {len(cloud)}",
        "HEIGHT 1",
        "VIEWPOINT 0 0 0 1 0 0 0",
        f"POINTS {len(cloud)}",
        "DATA binary",
    ]
    return ("\n".join(lines) + "\n").encode("ascii") + packed.tobytes()
