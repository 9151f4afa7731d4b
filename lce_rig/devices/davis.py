"""A DAVIS346 read by dv-processing 2: events, frames and edges at its trigger input.

External pulses cannot trigger its frames. The camera timestamps their edges with its own clock, which can
thus be fitted to the clock of the sync board that sends them.

References:
    https://dv-processing.inivation.com, https://docs.inivation.com (external camera sync)
"""

import re
import time
from collections import deque
from collections.abc import Callable, Mapping
from datetime import timedelta
from importlib import import_module
from typing import Any, NamedTuple

import numpy as np

from lce_rig.core.data import Events, Image, LiveSample, Pulse
from lce_rig.core.errors import SourceError
from lce_rig.core.findings import Finding
from lce_rig.devices import findings
from lce_rig.devices.reading import CAMERA_SILENCE_S, LiveSource, RateMeter, SourceStatus
from lce_rig.io.events.event_recording import NS_PER_US
from lce_rig.rig import CameraSettings

# Capacity of the queue: batches of 10 ms from three streams for several seconds.
_N_SLOTS = 2048
_PAUSE_S = 0.002
_MAX_CLOCK_ERROR_MS = 500.0
_RISING = "EXTERNAL_SIGNAL_RISING_EDGE"
_US = timedelta(microseconds=1)
_SILENT_HINT = "Check the USB cable; unplug the camera for some seconds and start again."
_OTHER_MODEL = "Check driver.device and resolution_px: it may be another model."
_CHECK = (
    "Check the USB 3 cable, `lsusb | grep 152a`, iniVation's udev rules (else only root may open it), and "
    "that no other program (DV, a ROS driver) holds it."
)
_INSTALL = "Run: pip install 'lce-rig[davis]' (dv-processing 2: Linux, Python 3.10 to 3.13)"
Value = bool | int | float | str


class OpenedCamera(NamedTuple):
    """An opened camera, ready to read.

    Attributes:
        input: dv-processing's object, read by its getNext* methods.
        device: model, serial number and firmware of the camera.
        notes: settings that differ from those requested.
        serial: its serial number.
    """

    input: Any
    device: str
    notes: tuple[Finding, ...] = ()
    serial: str = ""


class DavisSource(LiveSource):
    """A DAVIS; see `LiveSource`.

    Timestamps are the camera's, in Unix time; those of frames are moved from start to middle of the exposure.

    Args:
        sensor: the camera's name in the profile.
        settings: its block of the profile.
        open_camera: opens the camera, or another input of dv-processing (file, network).
    """

    def __init__(
        self,
        sensor: str,
        settings: CameraSettings,
        open_camera: Callable[[str, CameraSettings], OpenedCamera] | None = None,
    ) -> None:
        super().__init__(sensor, f"camera {sensor!r}", CAMERA_SILENCE_S, _SILENT_HINT, _N_SLOTS)
        self._settings = settings
        self._open_camera = open_camera or open_davis
        self._opened = OpenedCamera(None, "")
        self._channel = settings.first_channel("frames") or "frames"
        self._rates = {"events": RateMeter(), "frames": RateMeter()}
        self._delays_ns: deque[int] = deque(maxlen=100)
        self._n_pulses = self._n_frames_lost = 0
        interval_us = settings.driver.controls.get("frame_interval_us", 0)
        self._interval_us = float(interval_us) if isinstance(interval_us, int | float) else 0.0
        self._last_frame_us: int | None = None

    def open(self) -> None:
        """Open and set up the camera.

        Raises:
            SourceError: the camera is absent, busy, another model, or does not support the profile's
                settings.
        """
        self._opened = self._open_camera(self.sensor, self._settings)
        self._input: Any = self._opened.input
        self._has = {
            "events": self._input.isEventStreamAvailable(),
            "frames": self._input.isFrameStreamAvailable(),
            "pulses": self._input.isTriggerStreamAvailable(),
            "imu": self._input.isImuStreamAvailable(),
        }
        for name, channel in self._settings.channels.items():
            if not self._has[channel.kind]:
                what = f"{self._label}: {self._opened.device} has no {channel.kind} for channel {name!r}"
                raise SourceError(what, "Check driver.device and the model, or delete the channel.")

    def close(self) -> None:
        """Close the camera."""
        # dv-processing closes a device with its last reference.
        self._input = None
        self._opened = self._opened._replace(input=None)

    def describe(self) -> SourceStatus:
        """Report the state of the camera."""
        problems, clock = list(self._opened.notes), None
        if self._delays_ns:
            # Minimum age of the latest events on arrival.
            delay_ms = min(self._delays_ns.copy()) * 1e-6
            clock = findings.DAVIS_CLOCK(delay_ms=delay_ms)
            if abs(delay_ms) > _MAX_CLOCK_ERROR_MS:
                problems.append(findings.CLOCK_DIFFERS(difference_s=abs(delay_ms) / 1000))
        return SourceStatus(
            self.sensor,
            n_lost=self._n_frames_lost,
            clock=clock,
            problems=tuple(problems),
            device=self._opened.device,
            serial=self._opened.serial,
            rates_hz={kind: meter.rate_hz for kind, meter in self._rates.items()},
        )

    def read(self) -> list[LiveSample]:
        """Read every stream once; samples of different streams are not in time order."""
        host_ns = time.time_ns()
        samples: list[LiveSample] = []
        store = self._input.getNextEventBatch() if self._has["events"] else None
        if store is not None and len(store) > 0:
            samples.append(self._to_events(store, host_ns))
        frame = self._input.getNextFrame() if self._has["frames"] else None
        if frame is not None:
            samples.append(self._to_image(frame, host_ns))
        for trigger in (self._input.getNextTriggerBatch() or ()) if self._has["pulses"] else ():
            if trigger.type.name == _RISING:  # The camera generates others itself.
                samples.append(Pulse(self.sensor, trigger.timestamp * NS_PER_US, self._n_pulses, host_ns))
                self._n_pulses += 1
        if self._has["imu"]:
            self._input.getNextImuBatch()  # Not used, but its queue must not grow.
        if not samples:
            # A file has ended when its last stream has, a camera is gone when any is.
            is_running = getattr(self._input, "isRunningAny", self._input.isRunning)
            if not is_running():
                hint = "Check cable and power; then start again."
                raise SourceError(f"{self._label}: {self._opened.device} is gone", hint)
            time.sleep(_PAUSE_S)
        return samples

    def _to_events(self, store: Any, host_ns: int) -> Events:
        columns = store.numpy()
        x, y = columns["x"].astype(np.uint16), columns["y"].astype(np.uint16)
        width, height = self._settings.resolution_px
        if x.max() >= width or y.max() >= height:
            raise self._wrong_size(f"events up to column {x.max()}, row {y.max()}")
        t_ns = columns["timestamp"] * NS_PER_US
        self._rates["events"].add(len(x))
        self._delays_ns.append(host_ns - int(t_ns[-1]))
        return Events(self.sensor, t_ns, x, y, columns["polarity"] != 0, width, height, host_ns)

    def _to_image(self, frame: Any, host_ns: int) -> Image:
        pixels = np.array(frame.image, dtype=np.uint8)
        if pixels.shape[1::-1] != self._settings.resolution_px:
            raise self._wrong_size(f"frames of {pixels.shape[1]}x{pixels.shape[0]} px")
        self._rates["frames"].add(1)
        exposure_us = frame.exposure // _US
        if self._last_frame_us is not None and self._interval_us > 0:
            n_intervals = round((frame.timestamp - self._last_frame_us) / self._interval_us)
            self._n_frames_lost += max(0, n_intervals - 1)
        self._last_frame_us = frame.timestamp
        stamp_ns = frame.timestamp * NS_PER_US + exposure_us * NS_PER_US // 2
        return Image(self.sensor, self._channel, stamp_ns, pixels, host_ns)

    def _wrong_size(self, what: str) -> SourceError:
        width, height = self._settings.resolution_px
        return SourceError(f"{self._label} sends {what}; the profile's has {width}x{height} px", _OTHER_MODEL)


def open_davis(sensor: str, settings: CameraSettings) -> OpenedCamera:
    """Open the DAVIS named in the profile, or the only one; set it up and enable trigger edges.

    Raises:
        SourceError: dv-processing is missing; the camera is absent, busy, or another model.
    """
    try:
        dv = import_module("dv_processing")
    except ImportError as error:
        raise SourceError(f"camera {sensor!r}: needs dv-processing: {error}", _INSTALL) from None
    if not hasattr(dv.io, "camera"):
        raise SourceError(f"camera {sensor!r}: dv-processing is older than 2", _INSTALL)
    wanted = (settings.driver.device or "").rpartition("_")[2]
    attached = {str(device.serialNumber): device for device in dv.io.camera.discover()}
    davis = {serial: d for serial, d in attached.items() if d.cameraModel.name.startswith("DAVIS")}
    if not (wanted in davis or (not wanted and len(davis) == 1)):
        listing = ", ".join(f"{d.cameraModel.name} {serial}" for serial, d in sorted(attached.items()))
        n = len(davis) if davis and not wanted else "no"
        what = (
            f"camera {sensor!r}: {n} DAVIS {wanted}".rstrip()
            + f" is attached{listing and f'; attached: {listing}'}"
        )
        raise SourceError(what, f"Set driver.device to a serial number. {_CHECK}")
    try:
        camera = dv.io.camera.DAVIS(davis[wanted] if wanted else next(iter(davis.values())))
    except (RuntimeError, IndexError) as error:
        what = f"camera {sensor!r}: the DAVIS cannot be opened: {_first_line(error)}"
        raise SourceError(what, _CHECK) from None
    size = tuple(camera.getEventResolution() or ())
    # The name is the model and the serial number, such as DAVIS346_00000499.
    name = str(camera.getCameraName())
    if size != settings.resolution_px:
        has, needs = "x".join(map(str, size)), "x".join(map(str, settings.resolution_px))
        what = f"camera {sensor!r}: {name} has {has} px, the profile's {needs} px"
        raise SourceError(what, _OTHER_MODEL)
    try:
        notes = _set_up(camera, sensor, settings.driver.controls)
    except (RuntimeError, ValueError, IndexError) as error:
        what = f"camera {sensor!r}: {name} cannot be set up: {_first_line(error)}"
        raise SourceError(what, _CHECK) from None
    device = f"{name}, firmware {camera.getFirmwareVersion()}"
    return OpenedCamera(camera, device, tuple(notes), name.rpartition("_")[2])


def _set_up(camera: Any, sensor: str, controls: Mapping[str, Value]) -> list[Finding]:
    """Apply the profile's exposure, frame interval and biases, and enable the trigger input."""
    biases = {f"bias_{name.lower()}": bias for name, bias in camera.Davis346BiasCF.__members__.items()}
    durations = {
        "exposure_us": (camera.setExposureDuration, camera.getExposureDuration),
        "frame_interval_us": (camera.setFrameInterval, camera.getFrameInterval),
    }
    known = [*durations, "auto_exposure", *biases]
    for name in controls:
        if name not in known:
            what = f"camera {sensor!r}: driver.controls.{name}: a DAVIS has no such setting"
            raise SourceError(what, f"It has: {', '.join(known)}.")
    notes = []
    if "exposure_us" in controls or "auto_exposure" in controls:
        camera.setAutoExposure(bool(controls.get("auto_exposure", False)))
    for name, (put, read) in durations.items():
        if name in controls:
            value = number_of(sensor, name, controls[name])
            put(value * _US)
            granted = read() / _US
            if abs(granted - value) > 0.01 * value:
                notes.append(findings.CONTROL_DIFFERS(control=name, given=granted, expected=value))
    for name, bias in biases.items():
        if name in controls:
            camera.setDavis346BiasCoarseFine(bias, *bias_of(sensor, name, controls[name]))
    # The trigger input is off by default.
    camera.setDetectorRisingEdges(True)
    camera.setDetectorFallingEdges(False)
    camera.setDetectorRunning(True)
    if not (camera.isDetectorRunning() and camera.getDetectorRisingEdges()):
        notes.append(findings.TRIGGER_INPUT_OFF())
    if not camera.isMaster():
        notes.append(findings.FOLLOWS_OTHER_CAMERA())
    return notes


def number_of(sensor: str, name: str, value: Value) -> float:
    """Parse a control as a positive number.

    Raises:
        SourceError: not a positive number.
    """
    if isinstance(value, bool | str) or value <= 0:
        what = f"camera {sensor!r}: driver.controls.{name}: {value!r} is not a positive number"
        raise SourceError(what, "Give microseconds.")
    return float(value)


def bias_of(sensor: str, name: str, value: Value) -> tuple[int, int]:
    """Parse a control as a bias, coarse (0 to 7) and fine (0 to 255): "4,39".

    Raises:
        SourceError: not a bias.
    """
    bias = re.fullmatch(r"\s*([0-7])\s*,\s*([0-9]{1,3})\s*", str(value))
    if bias is None or int(bias[2]) > 255:
        what = f"camera {sensor!r}: driver.controls.{name}: {value!r} is not a bias"
        raise SourceError(what, 'Give coarse (0 to 7) and fine (0 to 255) as text: "4,39".')
    return int(bias[1]), int(bias[2])


def _first_line(error: Exception) -> str:
    """Return the library's message without its stack trace."""
    lines = [line for line in str(error).splitlines() if line.strip()]
    cause = next((line for line in lines if line.startswith(("RuntimeError:", "IOError:"))), "")
    return cause.partition(": ")[2] or (lines[0] if lines else type(error).__name__)
