"""Finding, opening and setting up a DAVIS by dv-processing, of version 2 or 1.7.

References:
    https://dv-processing.inivation.com, https://docs.inivation.com (external camera sync)
    libcaer's davis.h (modules and parameters of the older interface)
"""

from collections.abc import Mapping
from dataclasses import dataclass
from datetime import timedelta
from difflib import get_close_matches
from importlib import import_module
from typing import Any

from lce_rig.core.errors import SourceError
from lce_rig.core.findings import Figure, Finding
from lce_rig.rig import CameraSettings

Value = bool | int | float | str
_CHECK = (
    "Check the USB 3 cable, `lsusb | grep 152a`, iniVation's udev rules (else only root may open it), and "
    "that no other program (DV, a ROS driver) holds it."
)
_INSTALL = "Run: pip install 'lce-rig[davis]' (dv-processing 2: Linux, Python 3.10 to 3.13)"
_US = timedelta(microseconds=1)
# Modules and parameters of libcaer's davis.h.
_APS, _EXTERNAL_INPUT = 2, 4
_OLD_APS_PARAMETERS = {"exposure_us": 12, "frame_interval_us": 13, "auto_exposure": 101}
_RUN_DETECTOR, _RISING, _FALLING, _PULSES = 0, 1, 2, 3


@dataclass(frozen=True)
class OpenedCamera:
    """A camera that is ready to be read.

    Attributes:
        input: dv-processing's object; its getNext* are asked.
        device: its model and serial number, and its firmware where it tells.
        notes: what it does otherwise than asked.
        serial: its serial number.
    """

    input: Any
    device: str
    notes: tuple[Finding, ...] = ()
    serial: str = ""


def open_davis(sensor: str, settings: CameraSettings) -> OpenedCamera:
    """Open the DAVIS that the profile names, or the only one; set it up and let it see trigger edges.

    Raises:
        SourceError: dv-processing is missing; the camera is absent, busy, or another model.
    """
    try:
        dv = import_module("dv_processing")
    except ImportError as error:
        raise SourceError(f"camera {sensor!r}: needs dv-processing: {error}", _INSTALL) from None
    wanted = (settings.driver.device or "").rpartition("_")[2]
    is_new = hasattr(dv.io, "camera")
    camera = _open_new(dv, sensor, wanted) if is_new else _open_old(dv, sensor, wanted)
    size = tuple(camera.getEventResolution() or ())
    if size != settings.resolution_px:
        given, needed = "x".join(map(str, size)), "x".join(map(str, settings.resolution_px))
        what = f"camera {sensor!r}: {camera.getCameraName()} has {given} px, the profile's {needed} px"
        raise SourceError(what, "Is it another model? Check driver.device and resolution_px.")
    set_up = _set_up_new if is_new else _set_up_old
    try:
        notes = set_up(camera, sensor, settings.driver.controls)
    except (RuntimeError, ValueError, IndexError) as error:
        what = f"camera {sensor!r}: {camera.getCameraName()} cannot be set up: {_first_line(error)}"
        raise SourceError(what, _CHECK) from None
    firmware = f", firmware {camera.getFirmwareVersion()}" if is_new else ""
    # The name is the model and the serial number, such as DAVIS346_00000499.
    name = str(camera.getCameraName())
    return OpenedCamera(camera, name + firmware, tuple(notes), name.rpartition("_")[2])


def _open_new(dv: Any, sensor: str, wanted: str) -> Any:
    attached = dv.io.camera.discover()
    found = {str(device.serialNumber): device for device in attached}
    listing = ", ".join(f"{device.cameraModel.name} {serial}" for serial, device in sorted(found.items()))
    davis = {s: d for s, d in found.items() if d.cameraModel.name.startswith("DAVIS")}
    if wanted in davis or (not wanted and len(davis) == 1):
        device = davis[wanted] if wanted else next(iter(davis.values()))
        try:
            return dv.io.camera.DAVIS(device)
        except (RuntimeError, IndexError) as error:
            what = f"camera {sensor!r}: the DAVIS cannot be opened: {_first_line(error)}"
            raise SourceError(what, _CHECK) from None
    raise _absent(sensor, wanted, listing, len(davis))


def _open_old(dv: Any, sensor: str, wanted: str) -> Any:
    names = [str(name) for name in dv.io.discoverDevices()]
    fitting = [name for name in names if name.startswith("DAVIS") and name.endswith(wanted)]
    if len(fitting) != 1:
        raise _absent(sensor, wanted, ", ".join(sorted(names)), len(fitting))
    try:
        return dv.io.CameraCapture(fitting[0])
    except RuntimeError as error:
        what = f"camera {sensor!r}: the DAVIS cannot be opened: {_first_line(error)}"
        raise SourceError(what, _CHECK) from None


def _absent(sensor: str, wanted: str, listing: str, n_davis: int) -> SourceError:
    if n_davis > 1 and not wanted:
        what = f"camera {sensor!r}: {n_davis} DAVIS cameras are attached"
        return SourceError(what, f"Set driver.device to a serial number; attached: {listing}.")
    name = f"DAVIS {wanted}" if wanted else "DAVIS"
    what = f"camera {sensor!r}: no {name} is attached"
    return SourceError(f"{what}; attached: {listing}" if listing else what, _CHECK)


def _set_up_new(camera: Any, sensor: str, controls: Mapping[str, Value]) -> list[Finding]:
    biases = {f"bias_{name.lower()}": bias for name, bias in camera.Davis346BiasCF.__members__.items()}
    _check_names(sensor, controls, [*_OLD_APS_PARAMETERS, *biases])
    notes = []
    if "exposure_us" in controls or "auto_exposure" in controls:
        camera.setAutoExposure(bool(controls.get("auto_exposure", False)))
    durations = {
        "exposure_us": (camera.setExposureDuration, camera.getExposureDuration),
        "frame_interval_us": (camera.setFrameInterval, camera.getFrameInterval),
    }
    for name, (put, read) in durations.items():
        if name in controls:
            value = number_of(sensor, name, controls[name])
            put(value * _US)
            notes += _deviation(name, value, read() / _US)
    for name, bias in biases.items():
        if name in controls:
            camera.setDavis346BiasCoarseFine(bias, *bias_of(sensor, name, controls[name]))
    # The trigger input is off by default.
    camera.setDetectorRisingEdges(True)
    camera.setDetectorFallingEdges(False)
    camera.setDetectorRunning(True)
    if not (camera.isDetectorRunning() and camera.getDetectorRisingEdges()):
        notes.append(Finding("clock.trigger_input_off", "warning"))
    if not camera.isMaster():
        notes.append(Finding("clock.follows_other_camera", "warning"))
    return notes


def _set_up_old(camera: Any, sensor: str, controls: Mapping[str, Value]) -> list[Finding]:
    _check_names(sensor, controls, list(_OLD_APS_PARAMETERS))
    given = dict(controls)
    if "exposure_us" in given:
        given.setdefault("auto_exposure", False)
    for name, value in given.items():
        number = int(value) if isinstance(value, bool) else round(number_of(sensor, name, value))
        camera.deviceConfigSet(_APS, _OLD_APS_PARAMETERS[name], number)
    for parameter, value in ((_RISING, 1), (_FALLING, 0), (_PULSES, 0), (_RUN_DETECTOR, 1)):
        camera.deviceConfigSet(_EXTERNAL_INPUT, parameter, value)
    return []


def number_of(sensor: str, name: str, value: Value) -> float:
    """Take a control as a positive number.

    Raises:
        SourceError: it is none.
    """
    if isinstance(value, bool | str) or value <= 0:
        what = f"camera {sensor!r}: driver.controls.{name}: {value!r} is no positive number"
        raise SourceError(what, "Give microseconds.")
    return float(value)


def bias_of(sensor: str, name: str, value: Value) -> tuple[int, int]:
    """Take a control as a bias, coarse (0 to 7) and fine (0 to 255): "4,39".

    Raises:
        SourceError: it is none.
    """
    parts = str(value).replace(" ", "").split(",")
    if len(parts) == 2 and all(part.isdigit() for part in parts):
        coarse, fine = int(parts[0]), int(parts[1])
        if coarse <= 7 and fine <= 255:
            return coarse, fine
    what = f"camera {sensor!r}: driver.controls.{name}: {value!r} is no bias"
    raise SourceError(what, 'Give coarse (0 to 7) and fine (0 to 255) as text: "4,39".')


def _check_names(sensor: str, controls: Mapping[str, Value], known: list[str]) -> None:
    for name in controls:
        if name not in known:
            nearest = get_close_matches(name, known, 1, 0.5)
            guess = f"Did you mean {nearest[0]}? " if nearest else ""
            what = f"camera {sensor!r}: driver.controls.{name}: a DAVIS has no such setting"
            raise SourceError(what, f"{guess}It has: {', '.join(known)}.")


def _deviation(name: str, wanted: float, given: float) -> list[Finding]:
    if abs(given - wanted) <= 0.01 * wanted:
        return []
    figures: dict[str, Figure] = {"control": name, "given": given, "expected": wanted}
    return [Finding("device.control_differs", "warning", figures=figures)]


def _first_line(error: Exception) -> str:
    """Take the library's message without its stack trace."""
    lines = [line for line in str(error).splitlines() if line.strip()]
    told = next((line for line in lines if line.startswith(("RuntimeError:", "IOError:"))), "")
    return told.partition(": ")[2] or (lines[0] if lines else type(error).__name__)
