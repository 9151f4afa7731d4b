"""The sensors of a rig one by one: the driver that reads each, and its source, even if others fail."""

from lce_rig.core.errors import SourceError
from lce_rig.devices.opening import driver_type, open_live
from lce_rig.devices.reading import LiveSource
from lce_rig.rig import DriverSettings, Rig
from lce_rig.rig.sync_settings import BOARD

# What to add for each driver that needs the address of its sensor.
_LINES = {
    "v4l2": "driver: {type: v4l2, device: /dev/video0}",
    "ros2": "driver: {type: ros2}",
    "command": "driver: {type: command, command: [PROGRAM, ARGUMENT, ...]}",
}


def sensors(rig: Rig) -> list[str]:
    """Name the sensors: LiDARs, cameras, then the sync board."""
    return [*rig.lidars, *rig.cameras, *([BOARD] if rig.sync is not None else [])]


def driver_of(rig: Rig, sensor: str) -> str:
    """Name the driver that reads a sensor; "" where none is known."""
    if sensor in rig.lidars:
        kind, model, driver = "lidar", rig.lidars[sensor].model, rig.lidars[sensor].driver
    elif sensor in rig.cameras:
        kind, model, driver = "camera", rig.cameras[sensor].model, rig.cameras[sensor].driver
    else:
        return "sync_board"
    try:
        return driver_type(kind, sensor, model, driver)
    except SourceError:
        return ""


def uses_driver(rig: Rig, kind: str) -> bool:
    """Check whether a sensor of the rig is read by a driver."""
    return any(driver_of(rig, sensor) == kind for sensor in sensors(rig))


def source_of(rig: Rig, sensor: str) -> LiveSource:
    """Build the source of one sensor; it is not open yet.

    Raises:
        SourceError: its driver is unknown, or the profile does not say where it is; with what to add.
    """
    missing = _missing_lines(rig, sensor)
    if missing:
        raise SourceError("the profile does not say how it is reached", missing)
    alone = {
        "lidars": {name: lidar for name, lidar in rig.lidars.items() if name == sensor},
        "cameras": {name: camera for name, camera in rig.cameras.items() if name == sensor},
        "sync": rig.sync if sensor == BOARD else None,
    }
    return open_live(rig.model_copy(update=alone))[0]


def _missing_lines(rig: Rig, sensor: str) -> str:
    if sensor not in rig.cameras:
        return ""
    driver, kind = rig.cameras[sensor].driver, driver_of(rig, sensor)
    is_unknown = driver.device is None if kind == "v4l2" else kind == "command" and not driver.command
    if not is_unknown:
        return ""
    if driver == DriverSettings():
        choices = " or ".join((*_LINES.values(), "driver: {type: davis}"))
        return f"Add to cameras.{sensor}: {choices}"
    return f"Add to cameras.{sensor}.driver: {_LINES[kind].partition('{')[2].rstrip('}')}"
