"""Settings of a video device by the names that v4l2-ctl shows: set from the profile, read back, compared."""

import errno
import re
from collections.abc import Mapping
from ctypes import pointer
from dataclasses import dataclass, field
from difflib import get_close_matches

from lce_rig.core.errors import SourceError
from lce_rig.core.findings import Figure, Finding
from lce_rig.devices.v4l2 import abi
from lce_rig.devices.v4l2.video_device import VideoDevice

Value = bool | int | float | str
_NUMBERS = (abi.INTEGER, abi.BOOLEAN, abi.MENU, abi.INTEGER64, abi.BITMASK, abi.INTEGER_MENU)
_MENUS = (abi.MENU, abi.INTEGER_MENU)
_EXPOSURE_UNIT_US = 100


@dataclass(frozen=True)
class ControlInfo:
    """One setting of a device.

    Attributes:
        id: its number.
        type: its kind, see `v4l2_abi`.
        minimum, maximum: its range.
        flags: see `v4l2_abi`.
        choices: names by value, of a menu.
    """

    id: int
    type: int
    minimum: int
    maximum: int
    flags: int
    choices: Mapping[int, str] = field(default_factory=dict)


def list_controls(device: VideoDevice) -> dict[str, ControlInfo]:
    """List the settings that hold one number, by name."""
    found = {}
    ask = abi.ControlQuery(id=abi.NEXT_CONTROL)
    while device.grants(abi.QUERY_CONTROL, ask):
        if ask.type in _NUMBERS and not ask.flags & abi.CONTROL_DISABLED and ask.nr_of_dims == 0:
            name = _plain_name(ask.name.decode("utf-8", "replace"))
            choices = _choices(device, ask) if ask.type in _MENUS else {}
            found[name] = ControlInfo(ask.id, ask.type, ask.minimum, ask.maximum, ask.flags, choices)
        ask.id |= abi.NEXT_CONTROL
    return found


def apply_controls(device: VideoDevice, sensor: str, wanted: Mapping[str, Value]) -> list[Finding]:
    """Set what the profile wants: choices first, since automatic modes lock other settings.

    Returns:
        What the device set otherwise than asked.

    Raises:
        SourceError: it has no such setting, or cannot take the value.
    """
    known = list_controls(device)
    for name in wanted:
        if name not in known:
            raise SourceError(
                f"{_where(sensor, name)}: {device.card} has no such setting", _nearest(name, known)
            )
    deviations = []
    for name in sorted(wanted, key=lambda name: known[name].type in (abi.INTEGER, abi.INTEGER64)):
        info = known[name]
        value = _to_number(sensor, name, info, wanted[name])
        _set(device, sensor, name, info, value)
        given = read_control(device, info)
        if given is not None and given != value:
            figures: dict[str, Figure] = {"control": name, "given": given, "expected": value}
            deviations.append(Finding("device.control_differs", "warning", figures=figures))
    return deviations


def read_control(device: VideoDevice, info: ControlInfo) -> int | None:
    """Read one setting; None where the device does not say."""
    control = abi.V4l2Control(id=info.id)
    if not device.grants(abi.GET_CONTROLS, abi.V4l2Controls(count=1, controls=pointer(control))):
        return None
    return int(control.value.value64 if info.type == abi.INTEGER64 else control.value.value)


def read_exposure_us(device: VideoDevice, known: Mapping[str, ControlInfo]) -> float | None:
    """Read how long a row is exposed; None where no setting says so in a known unit.

    V4L2_CID_EXPOSURE counts in units of the driver's choice; Jetson's 64-bit setting of that name in us.
    """
    for name, info in known.items():
        if info.id == abi.EXPOSURE_ABSOLUTE_ID:
            value = read_control(device, info)
            return None if value is None else float(value * _EXPOSURE_UNIT_US)
        if name == "exposure" and info.type == abi.INTEGER64:
            value = read_control(device, info)
            return None if value is None else float(value)
    return None


def _set(device: VideoDevice, sensor: str, name: str, info: ControlInfo, value: int) -> None:
    control = abi.V4l2Control(id=info.id)
    if info.type == abi.INTEGER64:
        control.value.value64 = value
    else:
        control.value.value = value
    try:
        device.ioctl(abi.SET_CONTROLS, abi.V4l2Controls(count=1, controls=pointer(control)))
    except OSError as error:
        hint = "Remove it from driver.controls, or see `v4l2-ctl --list-ctrls-menus`."
        if info.flags & abi.CONTROL_READ_ONLY:
            hint = "It can only be read: remove it from driver.controls."
        elif info.flags & abi.CONTROL_INACTIVE or error.errno in (errno.EACCES, errno.EBUSY):
            hint = (
                "An automatic mode or a running stream locks it: turn the automatic off in driver.controls."
            )
        raise SourceError(f"{_where(sensor, name)}: {value} is refused: {error.strerror}", hint) from None


def _to_number(sensor: str, name: str, info: ControlInfo, value: Value) -> int:
    where = _where(sensor, name)
    if isinstance(value, str):
        by_name = {_plain_name(choice): number for number, choice in info.choices.items()}
        if _plain_name(value) not in by_name:
            choices = ", ".join(f"{number} ({choice})" for number, choice in info.choices.items())
            raise SourceError(f"{where}: {value!r} is no choice", f"Choices: {choices or 'numbers'}.")
        return by_name[_plain_name(value)]
    if value != int(value):
        raise SourceError(f"{where}: {value:g} is no whole number", "The camera takes whole numbers.")
    if info.type in _MENUS and int(value) not in info.choices:
        choices = ", ".join(f"{number} ({choice})" for number, choice in info.choices.items())
        raise SourceError(f"{where}: {int(value)} is no choice", f"Choices: {choices}.")
    if info.type != abi.BITMASK and not info.minimum <= value <= info.maximum:
        hint = f"It takes {info.minimum} to {info.maximum}."
        raise SourceError(f"{where}: {int(value)} is out of range", hint)
    return int(value)


def _choices(device: VideoDevice, control: abi.ControlQuery) -> dict[int, str]:
    choices = {}
    for index in range(control.minimum, control.maximum + 1):
        ask = abi.MenuQuery(id=control.id, index=index)
        if device.grants(abi.QUERY_MENU, ask):
            is_name = control.type == abi.MENU
            choices[index] = ask.item.name.decode("utf-8", "replace") if is_name else str(ask.item.value)
    return choices


def _plain_name(name: str) -> str:
    """Write a name as v4l2-ctl does: "Exposure Time, Absolute" is exposure_time_absolute."""
    return re.sub(r"[^a-z0-9]+", "_", name.lower()).strip("_")


def _nearest(name: str, known: Mapping[str, ControlInfo]) -> str:
    nearest = get_close_matches(name, known, 1, 0.5)
    listing = f"It has: {', '.join(sorted(known)) or 'none'}."
    return f"Did you mean {nearest[0]}? {listing}" if nearest else listing


def _where(sensor: str, name: str) -> str:
    return f"camera {sensor!r}: driver.controls.{name}"
