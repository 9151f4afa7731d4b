"""The PCD point cloud format as bytes and back: any field order, type and count, three encodings.

References:
    https://pointclouds.org/documentation/tutorials/pcd_file_format.html
    LZF, the compression of binary_compressed: http://oldhome.schmorp.de/marc/liblzf.html
"""

import io
import struct
from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

MAX_HEADER_BYTES = 65536


@dataclass(frozen=True)
class _Header:
    dtype: np.dtype[Any]
    n_points: int
    encoding: str


def decode_pcd(data: bytes) -> NDArray[Any]:
    """Decode a whole PCD file.

    Args:
        data: the file's bytes.

    Returns:
        Structured (N,) with the fields as named in the header; a field of count c > 1 has shape
        (c,). Fields of the same name (`_` in padded clouds) get a running number behind it.

    Raises:
        ValueError: what is wrong with the file, in words.
    """
    if not data:
        raise ValueError("it is empty")
    header, body = _split_header(data)
    if header.encoding == "ascii":
        return _decode_ascii(body, header)
    if header.encoding == "binary":
        n_whole = len(body) // header.dtype.itemsize
        if n_whole < header.n_points:
            raise ValueError(f"it is truncated: {n_whole} of {header.n_points} points are there")
        return np.frombuffer(body, dtype=header.dtype, count=header.n_points)
    return _decode_compressed(body, header)


def encode_pcd(cloud: NDArray[Any], comments: Iterable[str] = ()) -> bytes:
    """Encode a cloud as binary PCD, `decode_pcd`'s inverse.

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


def _split_header(data: bytes) -> tuple[_Header, bytes]:
    entries: dict[str, list[str]] = {}
    position = 0
    while "DATA" not in entries:
        end = data.find(b"\n", position, MAX_HEADER_BYTES)
        if end < 0:
            raise ValueError("it has no PCD header that ends in a DATA line")
        words = data[position:end].decode("ascii", errors="replace").split()
        position = end + 1
        if words and not words[0].startswith("#"):
            entries[words[0].upper()] = words[1:]
    encoding = (entries["DATA"] or ["nothing"])[0].lower()
    if encoding not in ("ascii", "binary", "binary_compressed"):
        raise ValueError(f"its encoding is {encoding!r}; known are ascii, binary and binary_compressed")
    return _Header(_parse_dtype(entries), _parse_size(entries), encoding), data[position:]


def _parse_dtype(entries: dict[str, list[str]]) -> np.dtype[Any]:
    names = entries.get("FIELDS") or entries.get("COLUMNS") or []
    sizes, types = entries.get("SIZE", []), entries.get("TYPE", [])
    counts = entries.get("COUNT", ["1"] * len(names))
    if not names or not len(names) == len(sizes) == len(types) == len(counts):
        raise ValueError(
            f"its header has {len(names)} FIELDS but {len(sizes)} entries of SIZE, "
            f"{len(types)} of TYPE and {len(counts)} of COUNT"
        )
    used: Counter[str] = Counter()
    columns: list[tuple[str, str, tuple[int, ...]]] = []
    for name, size, kind, count in zip(names, sizes, types, counts, strict=True):
        if f"{kind}{size}" not in {"F4", "F8", "U1", "U2", "U4", "U8", "I1", "I2", "I4", "I8"}:
            raise ValueError(f"field {name!r} has type {kind} of {size} bytes, which PCD does not know")
        if not count.isdigit() or not 1 <= int(count) <= 65536:
            raise ValueError(f"field {name!r} has a COUNT of {count!r}")
        unique = name if not used[name] and name != "_" else f"{name}{used[name]}"
        used[name] += 1
        columns.append((unique, f"<{kind.lower()}{size}", () if count == "1" else (int(count),)))
    try:
        return np.dtype(columns)
    except ValueError as error:
        raise ValueError(f"its fields cannot be told apart: {error}") from None


def _parse_size(entries: dict[str, list[str]]) -> int:
    try:
        if "POINTS" in entries:
            return _natural(entries["POINTS"][0])
        return _natural(entries["WIDTH"][0]) * _natural(entries.get("HEIGHT", ["1"])[0])
    except (KeyError, IndexError, ValueError):
        raise ValueError(
            "its header does not say how many points it has (POINTS, or WIDTH and HEIGHT)"
        ) from None


def _natural(word: str) -> int:
    value = int(word)
    if value < 0:
        raise ValueError
    return value


def _decode_ascii(body: bytes, header: _Header) -> NDArray[Any]:
    rows = [line for line in body.split(b"\n") if line.strip()]
    if len(rows) < header.n_points:
        raise ValueError(f"it is truncated: {len(rows)} of {header.n_points} points are there")
    if header.n_points == 0:
        return np.empty(0, dtype=header.dtype)
    # Rows are read as the header's own types first: float64 would round 64-bit stamps. Some writers put
    # "nan" or "3.0" into integer columns; then float64 and a cast must do.
    cloud = np.empty(header.n_points, dtype=header.dtype)
    columns = [column for name in header.dtype.names or () for column in _columns(cloud[name])]
    flat = np.dtype([(f"c{k}", column.dtype) for k, column in enumerate(columns)])
    text = io.BytesIO(b"\n".join(rows[: header.n_points]).replace(b",", b" "))
    try:
        table = np.loadtxt(text, dtype=flat, ndmin=1, comments=None)
    except ValueError:
        text.seek(0)
        table = _read_as_floats(text, flat)
    for k, column in enumerate(columns):
        column[...] = table[f"c{k}"]
    return cloud


def _columns(field: NDArray[Any]) -> list[NDArray[Any]]:
    """View a field (N,) or (N, c) as columns (N,)."""
    return [field] if field.ndim == 1 else [field[:, i] for i in range(field.shape[1])]


def _read_as_floats(text: io.BytesIO, flat: np.dtype[Any]) -> NDArray[Any]:
    try:
        values = np.loadtxt(text, dtype=np.float64, ndmin=2, comments=None)
    except ValueError as error:
        raise ValueError(f"its text cannot be read as numbers: {error}") from None
    names = flat.names or ()
    if values.shape[1] != len(names):
        raise ValueError(f"its rows have {values.shape[1]} numbers where the header has {len(names)}")
    table = np.empty(len(values), dtype=flat)
    for k, name in enumerate(names):
        is_float = flat[name].kind == "f"
        with np.errstate(invalid="ignore", over="ignore"):
            table[name] = values[:, k] if is_float else np.nan_to_num(values[:, k], posinf=0.0, neginf=0.0)
    return table


def _decode_compressed(body: bytes, header: _Header) -> NDArray[Any]:
    if len(body) < 8:
        raise ValueError("it is truncated: the compressed part is not there")
    n_packed, n_raw = struct.unpack_from("<II", body)
    n_wanted = header.n_points * header.dtype.itemsize
    if n_raw != n_wanted:
        raise ValueError(
            f"its compressed part says {n_raw} bytes where {header.n_points} points need {n_wanted}"
        )
    if len(body) - 8 < n_packed:
        raise ValueError(f"it is truncated: {len(body) - 8} of {n_packed} compressed bytes are there")
    raw = _decompress_lzf(body[8 : 8 + n_packed], n_raw)
    cloud = np.empty(header.n_points, dtype=header.dtype)
    position = 0
    for name in header.dtype.names or ():
        field = header.dtype[name]
        # Compressed clouds are stored field by field, not point by point.
        column = np.frombuffer(raw, field.base, cloud[name].size, position)
        cloud[name] = column.reshape(cloud[name].shape)
        position += column.nbytes
    return cloud


def _decompress_lzf(packed: bytes, n_raw: int) -> bytes:
    raw = bytearray()
    i = 0
    try:
        while i < len(packed) and len(raw) <= n_raw:
            control = packed[i]
            i += 1
            if control < 32:
                raw += packed[i : i + control + 1]
                i += control + 1
                continue
            length = (control >> 5) + 2
            if length == 9:
                length += packed[i]
                i += 1
            start = len(raw) - ((control & 31) << 8) - packed[i] - 1
            i += 1
            if start < 0:
                raise ValueError("its compressed part is damaged")
            period = raw[start : start + length]
            # A reference may reach into what it is itself about to write: the period then repeats.
            raw += (period * (length // len(period) + 1))[:length]
    except IndexError:
        raise ValueError("its compressed part is damaged") from None
    if len(raw) != n_raw:
        raise ValueError("its compressed part is damaged")
    return bytes(raw)
