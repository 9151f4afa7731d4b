"""Point point clouds from files."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from lce_rig.core.errors import SourceError
from lce_rig.core.limits import read_file
from lce_rig.core.pcd import decode_pcd
from lce_rig.sources.ply import decode_ply

DECODERS: dict[str, Callable[[bytes], NDArray[Any]]] = {".pcd": decode_pcd, ".ply": decode_ply}


def read_cloud(path: Path) -> NDArray[Any]:
    """Read a PCD or PLY file as it is.

    Returns:
        Structured (N,) with the file's own fields.

    Raises:
        SourceError: the file is missing, empty, truncated or damaged.
    """
    try:
        return DECODERS[path.suffix.lower()](read_file(path))
    except OSError as error:
        raise SourceError(f"{path}: cannot be read: {error.strerror}") from None
    except ValueError as error:
        raise SourceError(f"{path}: {error}") from None
