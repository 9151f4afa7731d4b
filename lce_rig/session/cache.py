"""Arrays and figures cached between runs; a damaged entry counts as missing."""

import hashlib
import io
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from lce_rig.session.durable import replace_file

_VALUES = "values_json"
# Behind the archive, where NumPy and other programs ignore it: a flipped bit in a zip may go unnoticed.
_SEAL = b"sha256:"
_SEAL_BYTES = len(_SEAL) + 64


class Cached(NamedTuple):
    """One entry: arrays by name, and values of JSON types."""

    arrays: dict[str, NDArray[Any]]
    values: dict[str, Any]


def store(path: Path, arrays: Mapping[str, NDArray[Any]], values: Mapping[str, Any]) -> bool:
    """Write one entry without pickle; the same content gives the same bytes.

    Returns:
        Whether it could be written (a full or read-only disk is not an error).
    """
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
        data = path.read_bytes()
        archive = data[:-_SEAL_BYTES]
        if data[-_SEAL_BYTES:] != _seal(path, archive):
            return None
        with np.load(io.BytesIO(archive), allow_pickle=False) as file:
            arrays = {name: file[name] for name in file.files}
        return Cached(arrays, json.loads(arrays.pop(_VALUES).tobytes()))
    except Exception:  # An entry of another version can fail in any way.
        return None


def _seal(path: Path, archive: bytes) -> bytes:
    """Fingerprint an entry with its key, so that a copy under another key counts as missing."""
    place = "/".join(path.parts[-2:]).encode()
    return _SEAL + hashlib.sha256(place + b"\0" + archive).hexdigest().encode()
