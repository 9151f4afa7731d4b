"""Detections of the board by pair of sensors, and as flat arrays for a session's cache."""

import dataclasses
import json
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lce_rig.core.board import Board
from lce_rig.core.calibration import Calibration
from lce_rig.core.data import Image
from lce_rig.core.findings import Refusal
from lce_rig.core.results import (
    BoardPose,
    BoardSurface,
    EventQuality,
    ImageBoard,
    ImageQuality,
    LidarBoard,
    LidarQuality,
    Observation,
    PatternBoard,
)

Arrays = dict[str, NDArray[Any]]
LidarDetection = list[LidarBoard] | Refusal
ImageDetection = ImageBoard | Refusal
Detection = ImageDetection | LidarDetection
PoseDetection = BoardPose | Refusal
SurfaceDetection = Sequence[BoardSurface] | Refusal

_RECORDS: dict[type, dict[str, type]] = {
    ImageBoard: {"quality": ImageQuality, "events": EventQuality},
    LidarBoard: {"quality": LidarQuality},
}
_KINDS: dict[str, Any] = {kind.__name__: kind for kind in (Image, ImageBoard, LidarBoard, Refusal)}


def to_arrays(detection: Detection | Image) -> Arrays:
    """Flatten a detection into named arrays; figures and names are stored as one JSON text.

    Args:
        detection: one image board, the LiDAR candidates of a scan, a refusal, or the image of one.
    """
    items = detection if isinstance(detection, list) else [detection]
    arrays: Arrays = {}
    heads = []
    for index, item in enumerate(items):
        head: dict[str, Any] = {"kind": type(item).__name__}
        for entry in dataclasses.fields(item):
            name, value = entry.name, getattr(item, entry.name)
            if isinstance(value, np.ndarray):
                arrays[f"{index}.{name}"] = value
            elif dataclasses.is_dataclass(value) and not isinstance(value, type):
                head[name] = dataclasses.asdict(value)
            else:
                head[name] = dict(value) if isinstance(value, Mapping) else value
        heads.append(head)
    text = json.dumps({"is_list": isinstance(detection, list), "items": heads}, default=float)
    arrays["head"] = np.frombuffer(text.encode(), dtype=np.uint8)
    return arrays


def from_arrays(arrays: Mapping[str, NDArray[Any]]) -> Detection | Image:
    """Rebuild the detection or image from the arrays of `to_arrays`.

    Raises:
        ValueError: the arrays are not a detection.
    """
    try:
        document = json.loads(arrays["head"].tobytes())
        items = []
        for index, head in enumerate(document["items"]):
            kind, prefix = _KINDS[head.pop("kind")], f"{index}."
            for name, record in _RECORDS.get(kind, {}).items():
                head[name] = None if head[name] is None else record(**head[name])
            parts = {key.removeprefix(prefix): part for key, part in arrays.items() if key.startswith(prefix)}
            items.append(kind(**head, **parts))
        return items if document["is_list"] else items[0]
    except (KeyError, TypeError, IndexError, AttributeError, ValueError) as error:
        raise ValueError(f"not a detection: {error!r}") from error


@dataclass(frozen=True)
class Pair:
    """One camera channel and one LiDAR of a rig; or two sensors of one kind.

    Attributes:
        camera: a camera; the first of two LiDARs.
        channel: channel of the camera; "" for a LiDAR.
        lidar: a LiDAR; the second of two cameras.
        lidar_channel: channel of the second camera; "" for a LiDAR.
    """

    camera: str
    channel: str
    lidar: str
    lidar_channel: str = ""

    @classmethod
    def of(cls, calibration: Calibration) -> "Pair":
        """Return the pair of sensors of a calibration."""
        return cls(calibration.camera, calibration.channel, calibration.lidar, calibration.lidar_channel)

    @property
    def folder_name(self) -> str:
        """Folder name for this pair's files if there are several pairs."""
        return ".".join(filter(None, (self.camera, self.channel, self.lidar, self.lidar_channel)))

    def __str__(self) -> str:
        first, second = (
            ".".join(filter(None, names))
            for names in ((self.camera, self.channel), (self.lidar, self.lidar_channel))
        )
        return f"{first} and {second}"


@dataclass(frozen=True)
class Detections:
    """The detections by sensor and capture.

    Attributes:
        images: (camera, channel) -> capture -> detection.
        lidars: LiDAR -> capture -> detection.
    """

    images: Mapping[tuple[str, str], Mapping[str, ImageDetection]]
    lidars: Mapping[str, Mapping[str, LidarDetection]]

    @property
    def pairs(self) -> list[Pair]:
        """All pairs of camera channel and LiDAR with common captures, sorted."""
        return [
            Pair(camera, channel, lidar)
            for (camera, channel), images in sorted(self.images.items())
            for lidar, scans in sorted(self.lidars.items())
            if images.keys() & scans.keys()
        ]

    def lidar_pairs(self, lidars: Iterable[str]) -> list[Pair]:
        """List all pairs of the named LiDARs with common captures, in their order."""
        return [
            Pair(first, "", second)
            for first, second in combinations(lidars, 2)
            if self.lidars.get(first, {}).keys() & self.lidars.get(second, {}).keys()
        ]

    def camera_pairs(self) -> list[Pair]:
        """List all pairs of cameras with common captures, each on its channel with the most boards."""
        best: dict[str, tuple[str, set[str]]] = {}
        for (camera, channel), images in sorted(self.images.items()):
            found = {name for name, image in images.items() if isinstance(image, ImageBoard)}
            if camera not in best or len(found) > len(best[camera][1]):
                best[camera] = channel, found
        return [
            Pair(first, best[first][0], second, best[second][0])
            for first, second in combinations(sorted(best), 2)
            if best[first][1] & best[second][1]
        ]

    def peers(self, lidars: Iterable[str], with_lidar: Collection[str] | None = None) -> list[Pair]:
        """List all pairs of the named LiDARs, and of cameras if one of them has no LiDAR.

        Args:
            lidars: names of the LiDARs.
            with_lidar: cameras with a LiDAR; by default those that share captures with one.
        """
        related = {pair.camera for pair in self.pairs} if with_lidar is None else set(with_lidar)
        of_cameras = [p for p in self.camera_pairs() if not {p.camera, p.lidar} <= related]
        return [*self.lidar_pairs(lidars), *of_cameras]

    def between(self, pair: Pair, board: Board) -> dict[str, tuple[PoseDetection, SurfaceDetection]]:
        """List the detections of both sensors of a pair in their common captures, sorted.

        Args:
            pair: the sensors.
            board: board whose corners are the points seen by the second of two cameras.

        Returns:
            By capture the first one's poses of the board, and the second one's surfaces.
        """
        first, second = self._pair(pair)
        return {
            name: (_as_pose(first[name]), _as_surfaces(second[name], board)) for name in self.captures(pair)
        }

    def candidates(self, pair: Pair, board: Board) -> tuple[list[Observation], dict[str, Refusal]]:
        """List the captures in which both sensors detect the board, and the reasons for the others."""
        candidates, refused = [], {}
        for name, (pose, surfaces) in self.between(pair, board).items():
            if isinstance(pose, Refusal):
                refused[name] = pose
            elif isinstance(surfaces, Refusal):
                refused[name] = surfaces
            else:
                candidates.append(Observation.of(name, pose, surfaces))
        return candidates, refused

    def captures(self, pair: Pair) -> list[str]:
        """Name the captures in which both sensors of a pair have a sample, sorted."""
        first, second = self._pair(pair)
        return sorted(first.keys() & second.keys())

    def _pair(self, pair: Pair) -> tuple[Mapping[str, Detection], Mapping[str, Detection]]:
        """Return the detections of both sensors, by capture."""
        first, second = (
            self.images.get((name, channel), {}) if channel else self.lidars.get(name, {})
            for name, channel in ((pair.camera, pair.channel), (pair.lidar, pair.lidar_channel))
        )
        return first, second

    def of(self, pair: Pair, capture: str) -> tuple[ImageDetection, LidarDetection]:
        """Return the detections of a camera and a LiDAR in one capture."""
        return self.images[pair.camera, pair.channel][capture], self.lidars[pair.lidar][capture]


def _as_surfaces(found: Detection, board: Board) -> SurfaceDetection:
    """Place the corners at the poses compatible with the image; boards from a scan are returned unchanged."""
    return PatternBoard.candidates(found, board.corners()) if isinstance(found, ImageBoard) else found


def _as_pose(found: Detection) -> PoseDetection:
    """Return the poses of the two likeliest boards in a scan; poses from an image are returned unchanged."""
    if not isinstance(found, list):
        return found
    T, other = found[0].T_lidar_board, found[1].T_lidar_board if len(found) > 1 else None
    return BoardPose(T, np.zeros((6, 6)), other, float("inf") if other is None else 0.0)
