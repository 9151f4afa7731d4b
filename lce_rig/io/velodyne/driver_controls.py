"""The `driver.controls` of a VLP-16."""

import math
from dataclasses import dataclass

from lce_rig.core import velodyne
from lce_rig.core.errors import SourceError
from lce_rig.rig import LidarSettings

_KEYS = ("position_port", "cut_deg")


@dataclass(frozen=True)
class Vlp16Controls:
    """Settings for receiving packets and cutting them into scans.

    Attributes:
        position_port: UDP port of position packets.
        cut_azimuth_rad: direction of the seam between two scans, from the lidar frame's x axis towards y;
            behind the sensor by default, where no camera looks.
    """

    position_port: int = velodyne.POSITION_PORT
    cut_azimuth_rad: float = math.pi


def read_controls(sensor: str, settings: LidarSettings) -> Vlp16Controls:
    """Read and check them.

    Args:
        sensor: the LiDAR's name in the profile, for messages.
        settings: its block of the profile.

    Raises:
        SourceError: a key is unknown, or its value cannot be meant.
    """
    controls = settings.driver.controls
    where = f"lidars.{sensor}.driver.controls"
    unknown = sorted(set(controls) - set(_KEYS))
    if unknown:
        raise SourceError(f"{where}: a VLP-16 has no {unknown[0]!r}; it has {', '.join(_KEYS)}")
    port = controls.get("position_port", velodyne.POSITION_PORT)
    if not isinstance(port, int) or not 1 <= port <= 65535:
        raise SourceError(f"{where}.position_port is {port!r}, not a port from 1 to 65535")
    cut_deg = controls.get("cut_deg", 180.0)
    if isinstance(cut_deg, bool | str) or not -360 <= cut_deg <= 360:
        raise SourceError(f"{where}.cut_deg is {cut_deg!r}, not an angle from -360 to 360 degrees")
    return Vlp16Controls(port, math.radians(cut_deg))
