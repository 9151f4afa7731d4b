"""The PCD point cloud format as bytes and back: any field order, type and count, three encodings.

References:
    https://pointclouds.org/documentation/tutorials/pcd_file_format.html
    LZF, the compression of binary_compressed: http://oldhome.schmorp.de/marc/liblzf.html
"""

import struct
from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lce_rig.core.limits import MAX_FIELDS, MAX_FILE_BYTES, check_points, check_size, describe
from lce_rig.core.text_table import read_table

MAX_HEADER_BYTES = 65536
_MAX_COMPRESSED_BYTES = 1 << 24
"""Unpacked: half a million points of 32 bytes. It takes seconds where nothing could be compressed well."""


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
        (c,). Fields of the same name (`_` in padded point clouds) get a running number behind it.

    Raises:
        ValueError: what is wrong with the file, in words.
    """
    if not data:
        raise ValueError("it is empty")
    header, start = _split_header(data)
    if header.encoding == "ascii":
        return _decode_ascii(data, start, header)
    body = memoryview(data)[start:]
    if header.encoding == "binary":
        n_whole = len(body) // header.dtype.itemsize
        if n_whole < header.n_points:
            raise ValueError(f"it is truncated: {n_whole} of {header.n_points} points are there")
        return np.frombuffer(body, dtype=header.dtype, count=header.n_points)
    return _decode_compressed(body, header)


def encode_pcd(cloud: NDArray[Any], comments: Iterable[str] = ()) -> bytes:
    """Encode a point cloud as binary PCD, `decode_pcd`'s inverse.

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


def _split_header(data: bytes) -> tuple[_Header, int]:
    """Read the header, and where the points begin."""
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
        raise ValueError(
            f"its encoding is {describe(encoding)}; known are ascii, binary and binary_compressed"
        )
    header = _Header(_parse_dtype(entries), check_points(_parse_size(entries)), encoding)
    check_size(header.n_points * header.dtype.itemsize, max_bytes=MAX_FILE_BYTES)
    return header, position


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
    n_values = 0
    for name, size, kind, count in zip(names, sizes, types, counts, strict=True):
        if f"{kind}{size}" not in {"F4", "F8", "U1", "U2", "U4", "U8", "I1", "I2", "I4", "I8"}:
            what = f"type {kind[:8]} of {size[:8]} bytes"
            raise ValueError(f"field {describe(name)} has {what}, which PCD does not know")
        if not count.isdigit() or len(count) > 9 or int(count) < 1:
            raise ValueError(f"field {describe(name)} has a COUNT of {describe(count)}")
        n_values += int(count)
        if n_values > MAX_FIELDS:
            raise ValueError(f"its points have more than {MAX_FIELDS} values each")
        unique = name if not used[name] and name != "_" else f"{name}{used[name]}"
        used[name] += 1
        columns.append((unique, f"<{kind.lower()}{size}", () if count == "1" else (int(count),)))
    try:
        return np.dtype(columns)
    except ValueError as error:
        raise ValueError(f"its field names are not unique: {error}") from None


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
    if not word.isdigit() or len(word) > 18:
        raise ValueError
    return int(word)


def _decode_ascii(data: bytes, start: int, header: _Header) -> NDArray[Any]:
    fields = [header.dtype[name] for name in header.dtype.names or ()]
    kinds = [field.base for field in fields for _ in range(int(np.prod(field.shape)))]
    flat = np.dtype([(f"c{k}", kind) for k, kind in enumerate(kinds)])
    return read_table(data, start, flat, header.n_points).view(header.dtype)


def _decode_compressed(body: memoryview, header: _Header) -> NDArray[Any]:
    if len(body) < 8:
        raise ValueError("it is truncated: the compressed part is not there")
    n_packed, n_raw = struct.unpack_from("<II", body)
    n_wanted = header.n_points * header.dtype.itemsize
    if n_raw != n_wanted:
        raise ValueError(
            f"its compressed part says {n_raw} bytes where {header.n_points} points need {n_wanted}"
        )
    check_size(n_raw, "its compressed part", _MAX_COMPRESSED_BYTES)
    if len(body) - 8 < n_packed:
        raise ValueError(f"it is truncated: {len(body) - 8} of {n_packed} compressed bytes are there")
    # LZF adds a byte to 32 where nothing can be compressed; more is not LZF, and takes long.
    if n_packed > n_raw + n_raw // 16 + 64:
        raise ValueError("its compressed part is damaged: it is larger than what it unpacks to")
    raw = _decompress_lzf(bytes(body[8 : 8 + n_packed]), n_raw)
    cloud = np.empty(header.n_points, dtype=header.dtype)
    position = 0
    for name in header.dtype.names or ():
        field = header.dtype[name]
        # Compressed point clouds are stored field by field, not point by point.
        column = np.frombuffer(raw, field.base, cloud[name].size, position)
        cloud[name] = column.reshape(cloud[name].shape)
        position += column.nbytes
    return cloud


def _decompress_lzf(packed: bytes, n_raw: int) -> bytes:
    raw = bytearray()
    i = n = 0
    end = len(packed)
    try:
        while i < end and n <= n_raw:
            control = packed[i]
            if control < 32:
                raw += packed[i + 1 : i + control + 2]
                i += control + 2
                n += control + 1
                continue
            length = (control >> 5) + 2
            if length == 9:
                i += 1
                length += packed[i]
            start = n - ((control & 31) << 8) - packed[i + 1] - 1
            i += 2
            if start < 0:
                raise ValueError("its compressed part is damaged")
            if start + length <= n:
                raw += raw[start : start + length]
            else:
                # A reference may reach into what it is itself about to write: the period then repeats.
                period = raw[start:]
                raw += (period * (length // len(period) + 1))[:length]
            n += length
    except IndexError:
        raise ValueError("its compressed part is damaged") from None
    if len(raw) != n_raw:
        raise ValueError("its compressed part is damaged")
    return bytes(raw)
