"""Detections of the board by pair of sensors, and as flat arrays for a session's cache."""

import dataclasses
import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lce_rig.core.data import Image
from lce_rig.core.documents import parse_json
from lce_rig.core.findings import Refusal
from lce_rig.core.results import Calibration, EventQuality, ImageBoard, ImageQuality, LidarBoard, LidarQuality

# Types of the fields of a detection; an entry of a cache may be foreign or outdated.

_Sizes = dict[str, int]
_Check = Callable[[Any, _Sizes], bool]


def check_fields(kind: type, fields: Mapping[str, Any]) -> None:
    """Check that fields can be those of a detection.

    Args:
        kind: ImageBoard, LidarBoard, Refusal or Image.
        fields: by name; those that are missing have their defaults.

    Raises:
        ValueError: a field cannot; the message names it.
    """
    sizes: _Sizes = {}
    for name, value in fields.items():
        if not _CHECKS[kind][name](value, sizes):
            raise ValueError(f"{name} cannot be that of {kind.__name__}")


def _array(kinds: str, *shape: int | str, takes_inf: bool = False) -> _Check:
    """Check an array; a size that is a letter is the same wherever it stands in one detection."""

    def check(value: Any, sizes: _Sizes) -> bool:
        if not isinstance(value, np.ndarray) or value.dtype.kind not in kinds or value.ndim != len(shape):
            return False
        wanted = [
            sizes.setdefault(n, have) if isinstance(n, str) else n
            for n, have in zip(shape, value.shape, strict=True)
        ]
        if list(value.shape) != wanted:
            return False
        return value.dtype.kind != "f" or not bool(
            np.isnan(value).any() if takes_inf else not np.isfinite(value).all()
        )

    return check


def _pose(*shape: int | str) -> _Check:
    is_matrix = _array("f", *shape, 4, 4)

    def check(value: Any, sizes: _Sizes) -> bool:
        if not is_matrix(value, sizes) or not (np.abs(value) < 1e6).all():
            return False
        R = value[..., :3, :3]
        is_rotation = np.abs(R @ np.swapaxes(R, -1, -2) - np.eye(3)) < 1e-5
        return bool(
            is_rotation.all() and (np.linalg.det(R) > 0).all() and (value[..., 3, :] == [0, 0, 0, 1]).all()
        )

    return check


def _or_none(check: _Check) -> _Check:
    return lambda value, sizes: value is None or check(value, sizes)


def _figure(value: Any, _: _Sizes) -> bool:
    return isinstance(value, (int, float))


def _whole(value: Any, _: _Sizes) -> bool:
    return type(value) is int and abs(value) <= 1 << 62


def _text(value: Any, _: _Sizes) -> bool:
    return isinstance(value, str)


def _figures_of(record: type) -> _Check:
    def check(value: Any, sizes: _Sizes) -> bool:
        return isinstance(value, record) and all(_figure(each, sizes) for _, each in _fields(value))

    return check


def _plane(value: NDArray[Any], sizes: _Sizes) -> bool:
    return _array("f", 4)(value, sizes) and bool(abs(np.linalg.norm(value[:3]) - 1) < 1e-3)


def _rings(size: str) -> _Check:
    return lambda value, sizes: _array("i", size)(value, sizes) and not (value < 0).any()


def _pixels(value: Any, _: _Sizes) -> bool:
    return (
        isinstance(value, np.ndarray)
        and value.dtype == np.uint8
        and (value.ndim == 2 or value.shape[2:] == (3,))
    )


_CHECKS: dict[type, dict[str, _Check]] = {
    Refusal: {
        "code": _text,
        "severity": lambda value, _: value == "error",
        "subject": _text,
        "figures": lambda value, _: isinstance(value, dict),
        "action": _text,
    },
    Image: {
        "sensor": _text,
        "channel": _text,
        "stamp_ns": _or_none(_whole),
        "pixels": _pixels,
        "host_ns": _or_none(_whole),
        "count": _or_none(_whole),
    },
    ImageBoard: {
        "corners_px": _array("f", "corners", 2),
        "T_cam_board": _pose(),
        "cov": _array("f", 6, 6),
        "T_cam_board_alternative": _or_none(_pose()),
        "chi2_gap": _figure,
        "is_ambiguous": _figure,
        "reprojection_px": _figure,
        "sigma_px": _figure,
        "quality": _or_none(_figures_of(ImageQuality)),
        "events": _or_none(_figures_of(EventQuality)),
        "stamp_ns": _or_none(_whole),
        "track_ns": _or_none(_array("i", "tracked")),
        "track_T_cam_board": _or_none(_pose("tracked")),
        "track_cov": _or_none(_array("f", "tracked", 6, 6)),
    },
    LidarBoard: {
        "points": _array("f", "points", 3),
        "ring": _rings("points"),
        "edge_points": _array("f", "edges", 3),
        "edge_ring": _rings("edges"),
        "edge_side": _array("i", "edges"),
        "edge_behind_m": _array("f", "edges", takes_inf=True),
        "edge_echo": _array("f", "edges"),
        "azimuth_step_rad": _figure,
        "plane": _plane,
        "sigma_m": _figure,
        "T_lidar_board": _pose(),
        "offset_ns": _or_none(_array("i", "points")),
        "quality": _figures_of(LidarQuality),
        "stamp_ns": _or_none(_whole),
    },
}


Arrays = dict[str, NDArray[Any]]
LidarDetection = list[LidarBoard] | Refusal
ImageDetection = ImageBoard | Refusal

_RECORDS: dict[type, dict[str, type]] = {
    ImageBoard: {"quality": ImageQuality, "events": EventQuality},
    LidarBoard: {"quality": LidarQuality},
}
_KINDS: dict[str, Any] = {kind.__name__: kind for kind in (Image, ImageBoard, LidarBoard, Refusal)}


def to_arrays(detection: ImageDetection | LidarDetection | Image) -> Arrays:
    """Flatten a detection into named arrays; figures and names travel as one JSON text.

    Args:
        detection: one image board, the LiDAR candidates of a scan, a refusal, or the image of one.
    """
    items = detection if isinstance(detection, list) else [detection]
    arrays: Arrays = {}
    heads = []
    for index, item in enumerate(items):
        head: dict[str, Any] = {"kind": type(item).__name__}
        for name, value in _fields(item):
            if isinstance(value, np.ndarray):
                arrays[f"{index}.{name}"] = value
            else:
                head[name] = _plain(value)
        heads.append(head)
    text = json.dumps({"is_list": isinstance(detection, list), "items": heads}, default=float)
    arrays["head"] = np.frombuffer(text.encode(), dtype=np.uint8)
    return arrays


def from_arrays(arrays: Mapping[str, NDArray[Any]]) -> ImageDetection | LidarDetection | Image:
    """Rebuild what `to_arrays` flattened.

    Raises:
        ValueError: the arrays are not a detection.
    """
    try:
        document = parse_json(arrays["head"].tobytes(), is_finite=False)
        items = [_rebuild(index, head, arrays) for index, head in enumerate(document["items"])]
        return items if document["is_list"] else items[0]
    except (KeyError, TypeError, IndexError, AttributeError, ValueError) as error:
        raise ValueError(f"not a detection: {error!r}") from error


def _plain(value: Any) -> Any:
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return dataclasses.asdict(value)
    return dict(value) if isinstance(value, Mapping) else value


def _fields(item: Any) -> Sequence[tuple[str, Any]]:
    return [(field.name, getattr(item, field.name)) for field in dataclasses.fields(item)]


def _rebuild(index: int, head: dict[str, Any], arrays: Mapping[str, NDArray[Any]]) -> Any:
    kind = _KINDS[head.pop("kind")]
    for name, record in _RECORDS.get(kind, {}).items():
        head[name] = None if head[name] is None else record(**head[name])
    prefix = f"{index}."
    own = {key[len(prefix) :]: value for key, value in arrays.items() if key.startswith(prefix)}
    check_fields(kind, {**head, **own})
    return kind(**head, **own)


@dataclass(frozen=True)
class Pair:
    """One camera channel and one LiDAR of a rig."""

    camera: str
    channel: str
    lidar: str

    @classmethod
    def of(cls, calibration: Calibration) -> "Pair":
        """Return the sensors of a calibration."""
        return cls(calibration.camera, calibration.channel, calibration.lidar)

    @property
    def folder_name(self) -> str:
        """Name of the folder of this pair's files if there are several pairs."""
        return f"{self.camera}.{self.channel}.{self.lidar}"

    def __str__(self) -> str:
        return f"{self.camera}.{self.channel} and {self.lidar}"


@dataclass(frozen=True)
class Detections:
    """The detections of every sensor in every capture with a sample of it.

    Attributes:
        images: (camera, channel) -> capture -> detection.
        lidars: LiDAR -> capture -> detection.
        session_of: capture -> its session, where they are of several.
    """

    images: Mapping[tuple[str, str], Mapping[str, ImageDetection]]
    lidars: Mapping[str, Mapping[str, LidarDetection]]
    session_of: Mapping[str, str] = field(default_factory=dict)

    @property
    def pairs(self) -> list[Pair]:
        """Every camera channel with every LiDAR that share captures, sorted."""
        return [
            Pair(camera, channel, lidar)
            for (camera, channel), images in sorted(self.images.items())
            for lidar, scans in sorted(self.lidars.items())
            if images.keys() & scans.keys()
        ]

    def captures(self, pair: Pair) -> list[str]:
        """Name the captures in which both sensors of a pair have a sample, sorted."""
        return sorted(self.images[pair.camera, pair.channel].keys() & self.lidars[pair.lidar].keys())

    def of(self, pair: Pair, capture: str) -> tuple[ImageDetection, LidarDetection]:
        """Return the detections of both sensors of a pair in one capture."""
        return self.images[pair.camera, pair.channel][capture], self.lidars[pair.lidar][capture]
