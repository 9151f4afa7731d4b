"""What the fields of a detection hold: an entry of a cache may come from somebody else, or be of old."""

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lce_rig.core.data import Image
from lce_rig.core.results import ImageBoard, LidarBoard, Refusal

_Sizes = dict[str, int]
_Check = Callable[[Any, _Sizes], bool]


def check_fields(kind: type, fields: Mapping[str, Any]) -> None:
    """Make sure that fields can be those of a detection.

    Args:
        kind: ImageBoard, LidarBoard, Refusal or Image.
        fields: by name; those that are missing have their defaults.

    Raises:
        ValueError: one cannot, and which.
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


def _figures(value: Any, sizes: _Sizes) -> bool:
    return isinstance(value, dict) and all(_figure(each, sizes) for each in value.values())


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
        "quality": _figures,
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
        "quality": _figures,
        "stamp_ns": _or_none(_whole),
    },
}
