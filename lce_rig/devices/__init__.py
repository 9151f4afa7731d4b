"""The attached sensors of a rig behind one protocol: one module per driver, imported on use."""

from importlib import import_module
from typing import Any

from lce_rig.core import velodyne
from lce_rig.core.errors import SourceError
from lce_rig.devices.reading import LiveSource
from lce_rig.rig import Rig
from lce_rig.rig.profile import BOARD
from lce_rig.rig.sensors import CAMERA_DRIVERS, LIDAR_DRIVERS

LIVE = {
    "vlp16": "lce_rig.devices.vlp16:Vlp16Source",
    "v4l2": "lce_rig.devices.v4l2:V4l2Source",
    "command": "lce_rig.devices.pipe:ImagePipeSource",
    "davis": "lce_rig.devices.davis:DavisSource",
    "ros2": "lce_rig.devices.ros2:Ros2Source",
    "sync_board": "lce_rig.devices.sync_board:SyncBoard",
}
"""Source by type of driver."""


def sensors(rig: Rig) -> list[str]:
    """Name the sensors of a rig: LiDARs, cameras, then the sync board."""
    return [*rig.lidars, *rig.cameras, *([BOARD] if rig.sync is not None else [])]


def open_live(rig: Rig) -> list[LiveSource]:
    """Build the source of every attached sensor; each opens with its `with` block.

    Args:
        rig: the profile.

    Raises:
        SourceError: see `source_of`.
    """
    return [source_of(rig, sensor) for sensor in sensors(rig)]


def source_of(rig: Rig, sensor: str) -> LiveSource:
    """Build the source of one sensor; it opens with its `with` block.

    Raises:
        SourceError: the driver's type belongs to another kind of sensor.
    """
    module, name = LIVE[driver_of(rig, sensor)].split(":")
    make: Any = getattr(import_module(module), name)
    source: LiveSource = make(rig.sync) if sensor == BOARD else make(sensor, _settings(rig, sensor))
    return source


def driver_of(rig: Rig, sensor: str) -> str:
    """Name the driver that reads a sensor: the profile's, else the default of its model.

    Raises:
        SourceError: no driver fits the model.
    """
    if sensor == BOARD:
        return "sync_board"
    settings = _settings(rig, sensor)
    kind, known = ("lidar", LIDAR_DRIVERS) if sensor in rig.lidars else ("camera", CAMERA_DRIVERS)
    model, driver = settings.model, settings.driver
    wanted = driver.type
    if wanted is None and velodyne.product_of(model) is not None:
        wanted = "vlp16"
    elif wanted is None and model.upper().startswith("DAVIS"):
        wanted = "davis"
    elif wanted is None and kind == "camera":
        wanted = "command" if driver.command else "v4l2"
    if wanted in known:
        return str(wanted)
    if driver.type is not None:
        what = f"{kind} {sensor!r}: driver.type {driver.type!r} is not for a {kind}"
        raise SourceError(what, f"It can be {', '.join(known)}.")
    what = f"{kind} {sensor!r}: no driver goes with model {model!r}"
    raise SourceError(what, f"Set driver.type to one of {', '.join(known)} if the device is compatible.")


def edge_cameras(rig: Rig) -> list[str]:
    """Name the cameras that timestamp a sync board's edges themselves.

    Raises:
        SourceError: a camera's driver is unknown.
    """
    return [name for name in rig.cameras if driver_of(rig, name) == "davis"]


def _settings(rig: Rig, sensor: str) -> Any:
    return rig.lidars[sensor] if sensor in rig.lidars else rig.cameras[sensor]
