"""Arrays and figures kept between runs; a damaged entry is one that is not there."""

import io
import json
import zipfile
import zlib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lce_rig.session.durable import replace_file

_VALUES = "values_json"


@dataclass(frozen=True, eq=False)
class Cached:
    """What was stored under one key: arrays by name, and values of JSON types."""

    arrays: dict[str, NDArray[Any]]
    values: dict[str, Any]


def store(path: Path, arrays: Mapping[str, NDArray[Any]], values: Mapping[str, Any]) -> bool:
    """Write one entry without pickle; the same content gives the same bytes.

    Returns:
        Whether it could be written (a full or read-only disk is no reason to stop).
    """
    if _VALUES in arrays:
        raise ValueError(f"{_VALUES} is no name for an array")
    text = json.dumps(dict(values), sort_keys=True).encode()
    buffer = io.BytesIO()
    np.savez_compressed(
        buffer, allow_pickle=False, **{_VALUES: np.frombuffer(text, np.uint8)}, **dict(sorted(arrays.items()))
    )
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        replace_file(path, buffer.getvalue())
    except OSError:
        return False
    return True


def load(path: Path) -> Cached | None:
    """Read one entry; None where there is none or it is damaged."""
    try:
        # From memory: numpy leaves a file that turns out to be no zip open.
        with np.load(io.BytesIO(path.read_bytes()), allow_pickle=False) as file:
            arrays = {name: file[name] for name in file.files}
        values = json.loads(arrays.pop(_VALUES).tobytes())
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile, zlib.error, AttributeError):
        return None
    return Cached(arrays, values) if isinstance(values, dict) else None
