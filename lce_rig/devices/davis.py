"""A DAVIS346 by dv-processing 2: events, frames and the edges at its trigger input.

External pulses cannot trigger its frames; the camera stamps their edges with its own clock, so that this
clock can be fitted to that of the sync board which sends them.

References:
    https://dv-processing.inivation.com, https://docs.inivation.com (external camera sync)
"""

import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from datetime import timedelta
from difflib import get_close_matches
from importlib import import_module
from typing import Any, NamedTuple

import numpy as np

from lce_rig.core.data import Events, Image, LiveSample, Pulse
from lce_rig.core.errors import SourceError
from lce_rig.core.findings import Finding
from lce_rig.devices import findings
from lce_rig.devices.protocol import ClockState, SourceStatus
from lce_rig.devices.reading import LiveSource, RateMeter
from lce_rig.io.events.event_recording import NS_PER_US
from lce_rig.rig import CameraSettings

# A batch of events lasts 10 ms: ten seconds of a taker's absence at three streams.
_N_SLOTS = 2048
_PAUSE_S = 0.002
_MAX_CLOCK_ERROR_MS = 500.0
_RISING, _RESET = "EXTERNAL_SIGNAL_RISING_EDGE", "TIMESTAMP_RESET"
_US_S = 1e6
_US = timedelta(microseconds=1)
_SILENT_HINT = "Check the USB cable; unplug the camera for some seconds and start again."
_CHECK = (
    "Check the USB 3 cable, `lsusb | grep 152a`, iniVation's udev rules (else only root may open it), and "
    "that no other program (DV, a ROS driver) holds it."
)
_INSTALL = "Run: pip install 'lce-rig[davis]' (dv-processing 2: Linux, Python 3.10 to 3.13)"
Value = bool | int | float | str


class DavisSamples:
    """Turns dv-processing's objects into samples and counts them.

    Stamps are the camera's, Unix time in us; a frame's is moved from the start to the middle of its exposure.

    Args:
        sensor: the camera's name in the profile.
        settings: its block of the profile.

    Attributes:
        n_events, n_frames, n_pulses: how many came.
        n_frames_lost: frames missing by their timestamps, where the profile sets controls.frame_interval_us.
        n_resets: how often the camera's clock restarted.
    """

    def __init__(self, sensor: str, settings: CameraSettings) -> None:
        self.n_events = self.n_frames = self.n_pulses = self.n_frames_lost = self.n_resets = 0
        self._sensor = sensor
        self._size = settings.resolution_px
        self._channel = settings.first_channel("frames") or "frames"
        interval_us = settings.driver.controls.get("frame_interval_us", 0)
        self._interval_us = float(interval_us) if isinstance(interval_us, int | float) else 0.0
        self._last_frame_us: int | None = None

    def to_events(self, store: Any, host_ns: int) -> Events:
        """Convert a store of events.

        Raises:
            SourceError: events lie off the sensor.
        """
        columns = store.numpy()
        x, y = columns["x"].astype(np.uint16), columns["y"].astype(np.uint16)
        width, height = self._size
        if len(x) and (x.max() >= width or y.max() >= height):
            raise self._wrong_size(f"events up to column {x.max()}, row {y.max()}")
        self.n_events += len(x)
        polarity = columns["polarity"] != 0
        return Events(self._sensor, columns["timestamp"] * NS_PER_US, x, y, polarity, width, height, host_ns)

    def to_image(self, frame: Any, host_ns: int) -> Image:
        """Convert a frame.

        Raises:
            SourceError: it has another size than the sensor.
        """
        pixels = np.array(frame.image, dtype=np.uint8)
        if pixels.shape[1::-1] != self._size:
            raise self._wrong_size(f"frames of {pixels.shape[1]}x{pixels.shape[0]} px")
        exposure_us = round(frame.exposure.total_seconds() * _US_S)
        stamp_ns = frame.timestamp * NS_PER_US + exposure_us * NS_PER_US // 2
        if self._last_frame_us is not None and self._interval_us > 0:
            n_intervals = round((frame.timestamp - self._last_frame_us) / self._interval_us)
            self.n_frames_lost += max(0, n_intervals - 1)
        self._last_frame_us = frame.timestamp
        self.n_frames += 1
        return Image(self._sensor, self._channel, stamp_ns, pixels, host_ns)

    def to_pulses(self, triggers: Any, host_ns: int) -> Iterator[Pulse]:
        """Convert the rising edges among triggers; the others are of the camera's own making."""
        for trigger in triggers:
            if trigger.type.name == _RESET:
                self.n_resets += 1
            if trigger.type.name == _RISING:
                yield Pulse(self._sensor, trigger.timestamp * NS_PER_US, self.n_pulses, host_ns)
                self.n_pulses += 1

    def _wrong_size(self, what: str) -> SourceError:
        width, height = self._size
        return SourceError(
            f"camera {self._sensor!r} sends {what}; the profile's has {width}x{height} px",
            "Is it another camera? Check driver.device and resolution_px.",
        )


class OpenedCamera(NamedTuple):
    """A camera that is ready to be read.

    Attributes:
        input: dv-processing's object; its getNext* are asked.
        device: its model, serial number and firmware.
        notes: what it does otherwise than asked.
        serial: its serial number.
    """

    input: Any
    device: str
    notes: tuple[Finding, ...] = ()
    serial: str = ""


class DavisSource(LiveSource):
    """A DAVIS; see `LiveSource`.

    Args:
        sensor: the camera's name in the profile.
        settings: its block of the profile.
        open_camera: opens it; another input of dv-processing (file, network) does as well.
        silence_s: so long without a sample is an error.
    """

    def __init__(
        self,
        sensor: str,
        settings: CameraSettings,
        open_camera: Callable[[str, CameraSettings], OpenedCamera] | None = None,
        silence_s: float = 5.0,
    ) -> None:
        super().__init__(sensor, f"camera {sensor!r}", _N_SLOTS, silence_s, _SILENT_HINT)
        self._settings = settings
        self._open_camera = open_camera or open_davis
        self._samples = DavisSamples(sensor, settings)
        self._opened = OpenedCamera(None, "")
        self._rates = {"events": RateMeter(), "frames": RateMeter(), "pulses": RateMeter()}
        self._delays_ns: deque[int] = deque(maxlen=100)

    def open(self) -> None:
        """Open and set up the camera.

        Raises:
            SourceError: it is absent, busy, another model, or cannot do what the profile wants.
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
                device = self._opened.device
                what = f"camera {self.sensor!r}: {device} has no {channel.kind} for channel {name!r}"
                raise SourceError(what, "Is it another model? Check driver.device, or delete the channel.")

    def close(self) -> None:
        """Close the camera."""
        # dv-processing closes a device with its last reference.
        self._input = None
        self._opened = self._opened._replace(input=None)

    def describe(self) -> SourceStatus:
        """Report the state of the camera."""
        samples = self._samples
        figures = {
            "pulses_hz": self._rates["pulses"].rate_hz,
            "n_events": float(samples.n_events),
            "n_frames": float(samples.n_frames),
            "n_pulses": float(samples.n_pulses),
        }
        problems = list(self._opened.notes)
        # How old the freshest of the last events were on arrival.
        delay_ns = min(self._delays_ns.copy(), default=None)
        delay_ms = None if delay_ns is None else delay_ns * 1e-6
        if delay_ms is not None and abs(delay_ms) > _MAX_CLOCK_ERROR_MS:
            problems.append(findings.CLOCK_DIFFERS(difference_s=abs(delay_ms) / 1000))
        if samples.n_resets:
            problems.append(findings.CLOCK_RESTARTED(n=samples.n_resets))
        return SourceStatus(
            self.sensor,
            n_lost=samples.n_frames_lost,
            clock=ClockState(findings.DAVIS_CLOCK(delay_ms=delay_ms)),
            problems=tuple(problems),
            figures=figures,
            device=self._opened.device,
            serial=self._opened.serial,
            rates_hz={kind: self._rates[kind].rate_hz for kind in ("events", "frames")},
        )

    def read(self) -> list[LiveSample]:
        """Ask every stream once: between them there is no order of time."""
        host_ns = time.time_ns()
        samples: list[LiveSample] = []
        store = self._input.getNextEventBatch() if self._has["events"] else None
        if store is not None and len(store) > 0:
            events = self._samples.to_events(store, host_ns)
            self._rates["events"].add(len(events))
            self._delays_ns.append(host_ns - int(events.t_ns[-1]))
            samples.append(events)
        frame = self._input.getNextFrame() if self._has["frames"] else None
        if frame is not None:
            self._rates["frames"].add(1)
            samples.append(self._samples.to_image(frame, host_ns))
        if self._has["pulses"]:
            pulses = list(self._samples.to_pulses(self._input.getNextTriggerBatch() or (), host_ns))
            if pulses:
                self._rates["pulses"].add(len(pulses))
            samples += pulses
        if self._has["imu"]:
            self._input.getNextImuBatch()  # Not used, but its queue must not grow.
        if not samples:
            # A file has ended when its last stream has, a camera is gone when any is.
            is_running = getattr(self._input, "isRunningAny", self._input.isRunning)
            if not is_running():
                hint = "Was it unplugged? Check cable and power; then start again."
                raise SourceError(f"camera {self.sensor!r}: {self._opened.device} is gone", hint)
            time.sleep(_PAUSE_S)
        return samples


def open_davis(sensor: str, settings: CameraSettings) -> OpenedCamera:
    """Open the DAVIS that the profile names, or the only one; set it up and let it see trigger edges.

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
        if len(davis) > 1 and not wanted:
            what = f"camera {sensor!r}: {len(davis)} DAVIS cameras are attached"
            raise SourceError(what, f"Set driver.device to a serial number; attached: {listing}.")
        what = f"camera {sensor!r}: no {f'DAVIS {wanted}' if wanted else 'DAVIS'} is attached"
        raise SourceError(f"{what}; attached: {listing}" if listing else what, _CHECK)
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
        raise SourceError(what, "Is it another model? Check driver.device and resolution_px.")
    try:
        notes = _set_up(camera, sensor, settings.driver.controls)
    except (RuntimeError, ValueError, IndexError) as error:
        what = f"camera {sensor!r}: {name} cannot be set up: {_first_line(error)}"
        raise SourceError(what, _CHECK) from None
    device = f"{name}, firmware {camera.getFirmwareVersion()}"
    return OpenedCamera(camera, device, tuple(notes), name.rpartition("_")[2])


def _set_up(camera: Any, sensor: str, controls: Mapping[str, Value]) -> list[Finding]:
    """Set exposure, frame interval and biases as the profile says, and switch the trigger input on."""
    biases = {f"bias_{name.lower()}": bias for name, bias in camera.Davis346BiasCF.__members__.items()}
    durations = {
        "exposure_us": (camera.setExposureDuration, camera.getExposureDuration),
        "frame_interval_us": (camera.setFrameInterval, camera.getFrameInterval),
    }
    known = [*durations, "auto_exposure", *biases]
    for name in controls:
        if name not in known:
            nearest = get_close_matches(name, known, 1, 0.5)
            guess = f"Did you mean {nearest[0]}? " if nearest else ""
            what = f"camera {sensor!r}: driver.controls.{name}: a DAVIS has no such setting"
            raise SourceError(what, f"{guess}It has: {', '.join(known)}.")
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
    """Take a control as a positive number.

    Raises:
        SourceError: it is none.
    """
    if isinstance(value, bool | str) or value <= 0:
        what = f"camera {sensor!r}: driver.controls.{name}: {value!r} is not a positive number"
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
    what = f"camera {sensor!r}: driver.controls.{name}: {value!r} is not a bias"
    raise SourceError(what, 'Give coarse (0 to 7) and fine (0 to 255) as text: "4,39".')


def _first_line(error: Exception) -> str:
    """Take the library's message without its stack trace."""
    lines = [line for line in str(error).splitlines() if line.strip()]
    cause = next((line for line in lines if line.startswith(("RuntimeError:", "IOError:"))), "")
    return cause.partition(": ")[2] or (lines[0] if lines else type(error).__name__)
