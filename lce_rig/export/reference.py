"""Reference extrinsics from a file, for reporting errors."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from lce_rig.core.errors import SessionError, reading
from lce_rig.core.files import read_json
from lce_rig.core.geometry import Array, parse_pose

# References are often printed with four digits.
_ROUNDING = 5e-3


@dataclass(frozen=True, eq=False)
class Reference:
    """T_cam_lidar (4, 4) by (camera, lidar), and a default for other pairs."""

    by_pair: Mapping[tuple[str, str], Array]
    default: Array | None

    def of(self, camera: str, lidar: str) -> Array | None:
        """Return the reference of a pair of sensors; None if the file has none."""
        return self.by_pair.get((camera, lidar), self.default)


def read_reference(path: Path | str) -> Reference:
    """Read truth.json, result.json or any JSON with a 4x4 `T_cam_lidar`, at the top or in a list `pairs`.

    Raises:
        SessionError: there is none, or it is not a rigid transform.
    """
    path = Path(path)
    with reading(path, SessionError):
        document = read_json(path)
    if not isinstance(document, dict):
        raise SessionError(f"{path}: holds no T_cam_lidar")
    pairs = document.get("pairs")
    by_pair = {
        (str(pair.get("camera")), str(pair.get("lidar"))): _pose(path, f"pairs[{i}].T_cam_lidar", pair)
        for i, pair in enumerate(pairs if isinstance(pairs, list) else [])
        if isinstance(pair, dict) and "T_cam_lidar" in pair
    }
    default = None if by_pair else _pose(path, "T_cam_lidar", document)
    return Reference(by_pair, default)


def _pose(path: Path, key: str, holder: Mapping[str, Any]) -> Array:
    try:
        return parse_pose(holder.get("T_cam_lidar"), _ROUNDING)
    except ValueError as error:
        raise SessionError(
            f"{path}: {key} {error}",
            "Give T_cam_lidar as a 4x4 rigid transform from the LiDAR to the camera.",
        ) from error
