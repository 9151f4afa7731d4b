"""Arrays and figures cached between runs; a damaged entry counts as missing."""

import hashlib
import io
import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lce_rig.core import unpacking
from lce_rig.core.documents import parse_json
from lce_rig.core.limits import MAX_CHUNK_BYTES, read_file
from lce_rig.session.durable import replace_file

_VALUES = "values_json"
_MAX_MEMBERS = 4096
# Behind the archive, where NumPy and other programs ignore it: a flipped bit in a zip may go unnoticed.
_SEAL = b"sha256:"
_SEAL_BYTES = len(_SEAL) + 64


@dataclass(frozen=True, eq=False)
class Cached:
    """One entry: arrays by name, and values of JSON types."""

    arrays: dict[str, NDArray[Any]]
    values: dict[str, Any]


def store(path: Path, arrays: Mapping[str, NDArray[Any]], values: Mapping[str, Any]) -> bool:
    """Write one entry without pickle; the same content gives the same bytes.

    Returns:
        Whether it could be written (a full or read-only disk is not an error).
    """
    if _VALUES in arrays:
        raise ValueError(f"{_VALUES} is not allowed as the name of an array")
    text = json.dumps(dict(values), sort_keys=True).encode()
    buffer = io.BytesIO()
    np.savez_compressed(
        buffer, allow_pickle=False, **{_VALUES: np.frombuffer(text, np.uint8)}, **dict(sorted(arrays.items()))
    )
    archive = buffer.getvalue()
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        replace_file(path, archive + _seal(path, archive))
    except OSError:
        return False
    return True


def load(path: Path) -> Cached | None:
    """Read one entry; None if there is none or it is damaged."""
    try:
        data = read_file(path, MAX_CHUNK_BYTES)
    except (OSError, ValueError):
        return None
    archive, seal = data[:-_SEAL_BYTES], data[-_SEAL_BYTES:]
    if seal != _seal(path, archive):
        return None
    try:
        arrays = _unpack(archive)
        values = parse_json(arrays.pop(_VALUES).tobytes())
    except Exception:  # A foreign file can fail in any way: zip, zlib, encryption, sizes, syntax.
        return None
    return Cached(arrays, values) if isinstance(values, dict) else None


def _seal(path: Path, archive: bytes) -> bytes:
    """Fingerprint an entry with its key, so that a copy under another key counts as missing."""
    place = "/".join(path.parts[-2:]).encode()
    return _SEAL + hashlib.sha256(place + b"\0" + archive).hexdigest().encode()


def _unpack(archive: bytes) -> dict[str, NDArray[Any]]:
    arrays = {}
    n_left = MAX_CHUNK_BYTES
    with unpacking.open_archive(io.BytesIO(archive)) as file:
        if len(file.infolist()) > _MAX_MEMBERS:
            raise ValueError(f"it has more than {_MAX_MEMBERS} members")
        for member in file.infolist():
            data = unpacking.read_member(file, member, n_left)
            n_left -= len(data)
            array = np.lib.format.read_array(io.BytesIO(data), allow_pickle=False)
            arrays[member.filename.removesuffix(".npy")] = array
    return arrays
