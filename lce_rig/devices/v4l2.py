"""A camera of the kernel's video interface: images with the kernel's timestamps, counted, in UTC."""

import time
from contextlib import ExitStack
from pathlib import Path

from lce_rig.core.data import Image, LiveSample
from lce_rig.core.errors import SourceError
from lce_rig.core.findings import Finding
from lce_rig.devices import findings
from lce_rig.devices.pixel_formats import FORMATS, PixelDecoder, find_format
from lce_rig.devices.protocol import ClockState, SourceStatus
from lce_rig.devices.reading import LiveSource
from lce_rig.devices.stamp_clock import FrameTiming, Mark, StampClock, frame_timing, stamped_moment
from lce_rig.devices.video_device import (
    VideoDevice,
    apply_controls,
    list_controls,
    read_exposure_us,
    serial_number,
    video_devices,
)
from lce_rig.rig import CameraSettings

# Two buffers drop images as soon as the computer stalls for one; eight ride out a quarter of a second.
N_BUFFERS = 8
_N_SLOTS = 16
_WAIT_S = 0.25
_EXPOSURE_EVERY_S = 1.0
_SILENT_HINT = (
    "Check the camera's cable and power; a triggered camera sends nothing without pulses (sync board, FSYNC)."
)


class V4l2Source(LiveSource):
    """A camera at /dev/video*; see `LiveSource`.

    Timestamps are mid exposure in the computer's UTC: the driver's, moved by the rules of `kernel_clock`
    and read by the clock that they fit. Where none fits it is the arrival, and the status says so.

    Args:
        sensor: the camera's name in the profile.
        settings: its block of the profile.
        silence_s: so long without an image is an error.
    """

    def __init__(self, sensor: str, settings: CameraSettings, silence_s: float = 5.0) -> None:
        super().__init__(sensor, f"camera {sensor!r}", _N_SLOTS, silence_s, _SILENT_HINT)
        self._settings = settings
        self._channel = settings.first_channel("frames") or "frames"
        self._clock = StampClock(settings.driver.frame_timing.clock)
        self._has_sent = False
        self._stack = ExitStack()
        self._last_sequence: int | None = None
        self._n_lost = 0
        self._n_damaged = 0
        self._notes: list[Finding] = []
        self._device_in_words = self._serial = ""
        self._mark: Mark = "start_of_frame"
        self._timing = FrameTiming(settings.resolution_px[1], None)

    def open(self) -> None:
        """Open, set up and start the camera.

        Raises:
            SourceError: it is absent, busy, or cannot do what the profile wants.
        """
        driver = self._settings.driver
        if driver.device is None:
            devices = ", ".join(video_devices()) or "none"
            line = "driver: {type: v4l2, device: /dev/video0}"
            hint = f"Add to cameras.{self.sensor}: {line}\nVideo devices of this computer: {devices}."
            raise SourceError(f"{self.sensor}: the profile does not say how it is reached", hint)
        self._last_sequence = None
        with ExitStack() as stack:
            self._device = VideoDevice(driver.device, self.sensor)
            stack.callback(self._device.close)
            self._serial = serial_number(Path(driver.device).resolve().name)
            self._decoder = self._set_up_images()
            self._device_in_words = (
                f"{self._device.card} at {self._device.path} ({self._device.driver}, {self._device.bus}), "
                f"{self._decoder.code.strip()}"
            )
            self._known = list_controls(self._device)
            self._notes = apply_controls(self._device, self.sensor, driver.controls)
            if driver.frame_rate_hz is not None:
                rate_hz = self._device.set_rate(driver.frame_rate_hz)
                if rate_hz is not None and abs(rate_hz / driver.frame_rate_hz - 1) > 0.01:
                    self._notes.append(
                        findings.RATE_REFUSED(rate_hz=rate_hz, expected_hz=driver.frame_rate_hz)
                    )
            self._read_exposure()
            n_buffers = self._device.start(N_BUFFERS)
            if n_buffers < N_BUFFERS:
                self._notes.append(findings.FEW_BUFFERS(n=n_buffers, expected=N_BUFFERS))
            self._stack = stack.pop_all()

    def close(self) -> None:
        """Stop and close the camera."""
        self._stack.close()

    def describe(self) -> SourceStatus:
        """Report the state of the camera."""
        figures = {
            "n_damaged": float(self._n_damaged),
            "stamp_to_mid_exposure_ms": self._timing.to_mid_ns(self._mark) * 1e-6,
            "trigger_to_mid_exposure_ms": self._timing.to_mid_ns("trigger") * 1e-6,
        }
        if self._timing.exposure_ns is not None:
            figures["exposure_ms"] = self._timing.exposure_ns * 1e-6
        problems = self._notes + self._clock.problems()
        if self._n_damaged:
            problems.append(findings.DAMAGED_IMAGES(n=self._n_damaged))
        clock = None
        if self._has_sent and self._clock.used is None:
            clock = ClockState(findings.ARRIVAL())
        elif self._has_sent:
            delay_ms = self._clock.delay_ns * 1e-6
            moved = findings.MID_EXPOSURE(clock=self._clock.used, mark=self._mark, delay_ms=delay_ms)
            clock = ClockState(moved)
            if self._timing.exposure_ns is None:
                problems.append(findings.EXPOSURE_UNKNOWN())
        return SourceStatus(
            self.sensor,
            n_lost=self._n_lost,
            clock=clock,
            problems=tuple(problems),
            figures=figures,
            device=self._device_in_words,
            serial=self._serial,
        )

    def _set_up_images(self) -> PixelDecoder:
        """Agree on the form of the images.

        Raises:
            SourceError: another size than the intrinsics', or no pixel format that is read here.
        """
        device, (width, height) = self._device, self._settings.resolution_px
        where = f"camera {self.sensor!r}: {device.path} ({device.card})"
        offered = device.formats()
        wanted = self._settings.driver.pixel_format
        code = find_format(wanted) if wanted else next((c for c in offered if c in FORMATS), None)
        if code is None or (offered and code not in offered):
            what = f"does not offer pixel format {wanted}" if wanted else "offers no pixel format read here"
            listing = ", ".join(c.strip() for c in offered) or "none"
            raise SourceError(
                f"{where} {what}", f"It offers {listing}: set driver.pixel_format to one of them."
            )
        layout = device.set_layout(code, width, height)
        if (layout.width, layout.height) != (width, height):
            raise SourceError(
                f"{where} sends {layout.width}x{layout.height} px in {code.strip()}, "
                f"the intrinsics belong to {width}x{height} px",
                "Choose one of its sizes (`v4l2-ctl --list-formats-ext`), or measure the intrinsics again.",
            )
        if layout.code != code:
            raise SourceError(
                f"{where} sends {layout.code.strip()}, not {code.strip()} as it was asked for",
                f"Set driver.pixel_format to {layout.code.strip()}.",
            )
        return PixelDecoder(code, width, height, layout.stride)

    def read(self) -> list[LiveSample]:
        """Return the image that came; see `LiveSource`."""
        try:
            frame = self._device.read(_WAIT_S)
        except OSError:
            # The kernel calls it temporary; should it last, the silence ends it.
            self._n_damaged += 1
            time.sleep(_WAIT_S)
            return []
        if frame is None:
            return []
        host_ns = time.time_ns()
        utc_ns = self._clock.to_utc_ns(frame.stamp_ns)
        if self._last_sequence is not None and frame.sequence > self._last_sequence:
            self._n_lost += frame.sequence - self._last_sequence - 1
        self._last_sequence = frame.sequence
        self._has_sent = True
        try:
            if frame.is_damaged:
                raise ValueError("the driver says so")
            pixels = self._decoder.decode(frame.data)
        except ValueError:
            self._n_damaged += 1
            return []
        if time.monotonic() - self._exposure_read_s > _EXPOSURE_EVERY_S:
            self._read_exposure()
        self._mark = stamped_moment(self._settings.driver, frame.flags, self._device.driver)
        stamp_ns = host_ns if utc_ns is None else utc_ns + self._timing.to_mid_ns(self._mark)
        return [Image(self.sensor, self._channel, stamp_ns, pixels, host_ns, frame.sequence)]

    def _read_exposure(self) -> None:
        """Ask for the exposure, which automatics may change at any time."""
        self._exposure_read_s = time.monotonic()
        is_given = self._settings.driver.frame_timing.exposure_us is not None
        exposure_us = None if is_given else read_exposure_us(self._device, self._known)
        self._timing = frame_timing(self._settings.driver, self._settings.resolution_px[1], exposure_us)
