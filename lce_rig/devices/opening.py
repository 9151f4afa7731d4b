"""The attached sensors of a rig: one line a driver, imported when wanted."""

from importlib import import_module
from typing import Any

from lce_rig.core import velodyne
from lce_rig.core.errors import SourceError
from lce_rig.devices.reading import LiveSource
from lce_rig.rig import DriverSettings, Rig
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


def open_live(rig: Rig) -> list[LiveSource]:
    """Build the source of every attached sensor: LiDARs, cameras, then the sync board.

    None is open yet: each opens with its `with` block.

    Args:
        rig: the profile.

    Raises:
        SourceError: a driver's type is unknown, or belongs to another kind of sensor.
    """
    sources = []
    for name, lidar in rig.lidars.items():
        kind = driver_type("lidar", name, lidar.model, lidar.driver)
        sources.append(_source(kind, name, lidar))
    for name, camera in rig.cameras.items():
        sources.append(_source(driver_type("camera", name, camera.model, camera.driver), name, camera))
    if rig.sync is not None:
        sources.append(_source("sync_board", rig.sync))
    return sources


def driver_type(kind: str, name: str, model: str, driver: DriverSettings) -> str:
    """Find which driver reads a sensor: the profile's, else the one that goes with its model.

    Args:
        kind: "lidar" or "camera".
        name: the sensor's, in the profile.
        model: the maker's name of the model.
        driver: its block of the profile.

    Raises:
        SourceError: there is none.
    """
    known = LIDAR_DRIVERS if kind == "lidar" else CAMERA_DRIVERS
    wanted = driver.type or _by_model(model)
    if wanted is None and kind == "camera":
        wanted = "command" if driver.command else "v4l2"
    if wanted is not None and wanted in known:
        return wanted
    if driver.type is not None:
        what = f"{kind} {name!r}: driver.type {driver.type!r} is unknown, or not for a {kind}"
        raise SourceError(what, f"It can be {', '.join(known)}.")
    what = f"{kind} {name!r}: no driver goes with model {model!r}"
    raise SourceError(what, f"Set driver.type to one of {', '.join(known)} if it talks like one of these.")


def edge_cameras(rig: Rig) -> list[str]:
    """Name the cameras that stamp a sync board's edges themselves.

    Raises:
        SourceError: a camera's driver is unknown.
    """
    kinds = {name: driver_type("camera", name, each.model, each.driver) for name, each in rig.cameras.items()}
    return [name for name, kind in kinds.items() if kind == "davis"]


def _by_model(model: str) -> str | None:
    if velodyne.product_of(model) is not None:
        return "vlp16"
    return "davis" if model.upper().startswith("DAVIS") else None


def _source(kind: str, *arguments: Any) -> LiveSource:
    module, name = LIVE[kind].split(":")
    source: LiveSource = getattr(import_module(module), name)(*arguments)
    return source
