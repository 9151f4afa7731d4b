"""How far two sets of files differ: sensors in degrees and millimetres, texts line by line."""

import difflib
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from lce_rig.core.calibration import read_result
from lce_rig.core.errors import LceRigError
from lce_rig.core.geometry import Array, difference, tangent_sizes
from lce_rig.core.limits import MAX_DOCUMENT_BYTES, read_file

RESULT = "result.json"
# Whose lines people read; others only differ or not.
_TEXTS = (".json", ".yaml", ".yml", ".urdf", ".xml", ".txt", ".py", ".cfg", ".ini")


@dataclass(frozen=True)
class SensorChange:
    """The extrinsics of a camera and a LiDAR, before and after.

    Attributes:
        camera, lidar: the sensors.
        moved: by how many deg and m they differ; None if one of both has no such extrinsics.
        is_new: whether only the new set has them; if `moved` is None, else the old one alone has.
    """

    camera: str
    lidar: str
    moved: tuple[float, float] | None
    is_new: bool = False


def sensor_changes(earlier: Path, new: Path) -> list[SensorChange]:
    """Compare the extrinsics of two sets by their result.json; one that cannot be read has none."""
    before, after = _extrinsics(earlier), _extrinsics(new)
    found = []
    for key in [*after, *(key for key in before if key not in after)]:
        both = key in before and key in after
        moved = tangent_sizes(difference(after[key], before[key])) if both else None
        found.append(SensorChange(*key, moved, key in after))
    return found


def text_changes(earlier: Path, new: Path, changed: Mapping[str, str]) -> list[str]:
    """Give the lines in which texts differ, as `diff -u` does; new, removed and other files by name.

    Args:
        earlier, new: folders of the sets.
        changed: names of the files, as `releases.differences` gives them.
    """
    lines: list[str] = []
    for name, how in changed.items():
        texts = [_lines(folder / name) if how == "changed" else None for folder in (earlier, new)]
        if texts[0] is None or texts[1] is None:
            lines.append(f"{name}: {'new' if how == 'added' else 'removed' if how == 'missing' else how}")
        else:
            sides = f"deployed/{name}", f"new/{name}"
            lines += difflib.unified_diff(texts[0], texts[1], sides[0], sides[1], lineterm="")
    return lines


def _extrinsics(folder: Path) -> dict[tuple[str, str], Array]:
    with suppress(LceRigError):
        return {(c.camera, c.lidar): c.T_cam_lidar for c in read_result(folder / RESULT).pairs}
    return {}


def _lines(path: Path) -> Sequence[str] | None:
    """Read the lines of a text; None if it is no text that people read."""
    if path.suffix not in _TEXTS:
        return None
    with suppress(OSError, ValueError):
        return read_file(path, MAX_DOCUMENT_BYTES).decode().splitlines()
    return None
