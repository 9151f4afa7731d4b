"""Lidar packets of an Ouster: their layout by profile, and the sensor's metadata that they need.

References:
    Ouster Sensor Docs, "Lidar Data Packet Format" and "Coordinate Frames and XYZ Calculation",
    https://static.ouster.dev/sensor-docs.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lce_rig.core.documents import read_json
from lce_rig.core.errors import SourceError
from lce_rig.core.geometry import Array

_MAX_PIXELS, _MAX_COLUMNS = 512, 4096


@dataclass(frozen=True)
class Profile:
    """How a profile lays out packets.

    Attributes:
        pixel: one return.
        unit_m: of its range.
        range_mask: of the bits that hold the range.
        has_heads: whether packets have a head and a foot, and a column's status is in its head.
    """

    pixel: np.dtype[Any]
    unit_m: float
    range_mask: int
    has_heads: bool = True


def _pixel(reflectivity_at: int, reflectivity: str, size: int, range_type: str = "<u4") -> np.dtype[Any]:
    return np.dtype(
        {
            "names": ["range", "reflectivity"],
            "formats": [range_type, reflectivity],
            "offsets": [0, reflectivity_at],
            "itemsize": size,
        }
    )


PROFILES = {
    "LEGACY": Profile(_pixel(4, "<u2", 12), 1e-3, (1 << 20) - 1, has_heads=False),
    "RNG19_RFL8_SIG16_NIR16": Profile(_pixel(4, "u1", 12), 1e-3, (1 << 19) - 1),
    "RNG15_RFL8_NIR8": Profile(_pixel(2, "u1", 4, "<u2"), 8e-3, (1 << 15) - 1),
}
"""The profiles of one return that are read."""


@dataclass(frozen=True, eq=False)
class OusterMetadata:
    """What the sensor's metadata say, as far as its packets need it.

    Attributes:
        name: of its profile.
        n_columns: columns of a revolution.
        columns_per_packet: of one packet.
        altitude_rad, azimuth_rad: (L,) of each beam, from the top.
        origin_m: (2,) distance of the beams' origins from the axis, and their height.
        T_sensor_lidar: (4, 4), m.
    """

    name: str
    n_columns: int
    columns_per_packet: int
    altitude_rad: Array
    azimuth_rad: Array
    origin_m: tuple[float, float]
    T_sensor_lidar: Array

    @property
    def packet(self) -> np.dtype[Any]:
        """The layout of a packet."""
        profile, n = PROFILES[self.name], len(self.altitude_rad)
        head: list[Any] = [("ns", "<u8"), ("column", "<u2")]
        head += [("status", "<u2")] if profile.has_heads else [("frame", "<u2"), ("encoder", "<u4")]
        tail: list[Any] = [] if profile.has_heads else [("status", "<u4")]
        columns = np.dtype([*head, ("pixels", profile.pixel, (n,)), *tail])
        fields: list[Any] = [("columns", columns, (self.columns_per_packet,))]
        if profile.has_heads:
            fields = [("type", "<u2"), ("frame", "<u2"), ("head", "V28"), *fields, ("foot", "V32")]
        return np.dtype(fields)

    def to_points(self, column: NDArray[np.int64], range_m: Array) -> NDArray[np.float32]:
        """Compute points (C, L, 3), m, of columns (C,) with ranges (C, L), in the sensor's frame.

        Cartesian coordinates of the beams, whose origins turn with the rotor.
        """
        encoder = 2 * np.pi * (1 - column / self.n_columns)[:, None]
        azimuth = encoder - self.azimuth_rad
        radius_m, height_m = self.origin_m
        # Ranges count from the axis, through the origin of the beam.
        along_m = np.where(range_m > 0, range_m - np.hypot(radius_m, height_m), 0.0)
        level_m = along_m * np.cos(self.altitude_rad)
        lidar = np.stack(
            [
                level_m * np.cos(azimuth) + radius_m * np.cos(encoder),
                level_m * np.sin(azimuth) + radius_m * np.sin(encoder),
                along_m * np.sin(self.altitude_rad) + height_m,
            ],
            axis=-1,
        )
        return np.asarray(lidar @ self.T_sensor_lidar[:3, :3].T + self.T_sensor_lidar[:3, 3], np.float32)


def read_metadata(path: Path) -> OusterMetadata:
    """Read the JSON file that Ouster's tools write beside a recording.

    Raises:
        SourceError: it cannot be read, is not one, or its packets' profile is not read.
    """
    try:
        document = _flat(read_json(path))
        layout = document["data_format"] if "data_format" in document else document["lidar_data_format"]
        name = str(layout.get("udp_profile_lidar", "LEGACY"))
        n, n_columns = int(layout["pixels_per_column"]), int(layout["columns_per_frame"])
        altitude, azimuth = (
            np.radians(np.array(document[key], np.float64))
            for key in ("beam_altitude_angles", "beam_azimuth_angles")
        )
        if not altitude.shape == azimuth.shape == (n,) or not 1 <= n <= _MAX_PIXELS:
            raise ValueError(f"angles of {altitude.shape} beams for {n} pixels of a column")
        if not 1 <= n_columns <= _MAX_COLUMNS or not 1 <= int(layout["columns_per_packet"]) <= n_columns:
            raise ValueError(f"{n_columns} columns of a frame")
        T_sensor_lidar = _matrix(document.get("lidar_to_sensor_transform", np.diag([-1, -1, 1, 1])))
        if "beam_to_lidar_transform" in document:
            T = _matrix(document["beam_to_lidar_transform"])
            origin_m = float(T[0, 3]), float(T[2, 3])
        else:
            origin_m = 1e-3 * float(document.get("lidar_origin_to_beam_origin_mm", 0.0)), 0.0
    except (OSError, KeyError, TypeError, ValueError, AttributeError) as error:
        what = f"{path}: is not the metadata of an Ouster: {str(error) or type(error).__name__}"
        raise SourceError(what, "Give the JSON file that the sensor or ouster-cli wrote.") from None
    if name not in PROFILES:
        hint = f"Read are {', '.join(PROFILES)}; convert it to point clouds with Ouster's own tools."
        raise SourceError(f"{path}: packets of profile {name} are not read", hint)
    columns_per_packet = int(layout["columns_per_packet"])
    return OusterMetadata(name, n_columns, columns_per_packet, altitude, azimuth, origin_m, T_sensor_lidar)


def _flat(document: Any) -> Mapping[str, Any]:
    """Lay the groups of newer metadata (beam_intrinsics, lidar_intrinsics, ...) out side by side."""
    flat: dict[str, Any] = dict(document)
    for key in ("beam_intrinsics", "lidar_intrinsics", "config_params"):
        flat |= {k: v for k, v in document.get(key, {}).items() if k not in flat}
    return flat


def _matrix(values: Any) -> Array:
    """Read a transform (4, 4) with its translation in mm."""
    T = np.array(values, np.float64).reshape(4, 4)
    if not np.isfinite(T).all():
        raise ValueError("a transform is not finite")
    T[:3, 3] *= 1e-3
    return T
