"""A V4L2 camera: images with the kernel's timestamps and sequence numbers, in UTC.

Drivers report CLOCK_MONOTONIC. Jetson's drivers also do, but use a counter that differs from it by seconds.
Therefore every clock is tested on the timestamps: on arrival, an image must be 0 to 0.2 s old.

References:
    https://docs.kernel.org/userspace-api/media/v4l/buffer.html (V4L2_BUF_FLAG_TIMESTAMP_*)
    https://github.com/tier4/ros2_v4l2_camera (the offset of Jetson's counter)
"""

import time
from collections.abc import Mapping
from contextlib import ExitStack
from pathlib import Path
from typing import Literal

from lce_rig.core.data import Image, LiveSample
from lce_rig.core.errors import SourceError
from lce_rig.core.findings import Finding
from lce_rig.core.phrasing import significant
from lce_rig.devices import findings
from lce_rig.devices import v4l2_abi as abi
from lce_rig.devices.pixel_formats import FORMATS, PixelDecoder, find_format
from lce_rig.devices.reading import CAMERA_SILENCE_S, READ_WAIT_S, LiveSource, SourceStatus
from lce_rig.devices.video_device import (
    VideoDevice,
    apply_controls,
    list_controls,
    read_exposure_us,
    serial_number,
    video_devices,
)
from lce_rig.rig import CameraSettings, DriverSettings, FrameTimingSettings

# Number of buffers: two drop images if the computer stalls for one, eight last for a quarter of a second.
N_BUFFERS = 8
_EXPOSURE_EVERY_S = 1.0
_SILENT_HINT = (
    "Check the camera's cable and power; a triggered camera sends nothing without pulses (sync board, FSYNC)."
)


Mark = Literal["start_of_exposure", "start_of_frame", "end_of_frame", "trigger"]
# Jetson's drivers set the end-of-frame flag, but their timestamp is the first row's arrival (vendor forums).
_JETSON_DRIVERS = ("tegra", "nv_", "vi5", "vi6")
_MAX_DELAY_NS = 200_000_000
# Largest delay once a clock is known: images come late from the queue after a computer stalls.
_MAX_STALL_NS = 2_000_000_000
# Clocks that agree within this are treated as one.
_HARMLESS_NS = 2_000_000
_N_BRACKETS = 3
_CLOCK_IDS = {
    "monotonic": time.CLOCK_MONOTONIC,
    "monotonic_raw": time.CLOCK_MONOTONIC_RAW,
    "boottime": time.CLOCK_BOOTTIME,
    "realtime": time.CLOCK_REALTIME,
}
_TSC_OFFSET = Path("/sys/devices/system/clocksource/clocksource0/offset_ns")
CLOCKS = ("monotonic", "monotonic_raw", "tsc", "tsc_minus", "boottime", "realtime")
"""Candidates, in the order in which equally good ones are taken."""


def to_mid_ns(mark: Mark, timing: FrameTimingSettings, n_rows: int, exposure_us: float | None) -> int:
    """Return the time from the timestamped moment to the middle of the image's exposure.

    A row of a rolling shutter is exposed and then read; the next one follows a line time later. With rows 0
    to H-1, exposure e and line time l (0 for a global shutter), the middle row m = (H-1)/2 is half exposed at

        t_start of exposure + m l + e/2                                                                    (1)
        t_start of frame    + m l - e/2          the first row is exposed, its reading begins              (2)
        t_end of frame      - (H-m) l - e/2      the last row is read                                      (3)
        t_trigger + delay   + m l + e/2                                                                    (4)

    Args:
        mark: the timestamped moment.
        timing: line time and delay.
        n_rows: H, number of rows of the image.
        exposure_us: exposure time of a row; None if unknown, which counts as 0.
    """
    half_us, line_us = 0.5 * (exposure_us or 0.0), timing.line_time_us
    rows_us = 0.5 * (n_rows - 1) * line_us
    after_us = {
        "start_of_exposure": rows_us + half_us,
        "start_of_frame": rows_us - half_us,
        "end_of_frame": rows_us - n_rows * line_us - half_us,
        "trigger": timing.trigger_delay_us + rows_us + half_us,
    }
    return round(1000 * after_us[mark])


def stamped_moment(settings: DriverSettings, flags: int, driver: str) -> Mark:
    """Find the moment that a timestamp marks: from the profile, else from a buffer's flags.

    Args:
        settings: settings of the camera.
        flags: the kernel's flags of a buffer.
        driver: name of the driver; Jetson's flags are wrong.
    """
    if settings.frame_timing.mark != "auto":
        return settings.frame_timing.mark
    if driver.lower().startswith(_JETSON_DRIVERS):
        return "start_of_frame"
    is_start = flags & abi.STAMP_SOURCE_MASK == abi.STAMP_SOURCE_SOE
    return "start_of_exposure" if is_start else "end_of_frame"


def read_clocks() -> dict[str, int]:
    """Read every candidate clock now, ns; Jetson's counter only if the kernel reports its offset."""
    readings = {name: time.clock_gettime_ns(number) for name, number in _CLOCK_IDS.items()}
    try:
        offset_ns = int(_TSC_OFFSET.read_text())
    except (OSError, ValueError):
        return readings
    raw_ns = readings["monotonic_raw"]
    return readings | {"tsc": raw_ns + offset_ns, "tsc_minus": raw_ns - offset_ns}


def choose_clock(stamp_ns: int, now_ns: Mapping[str, int]) -> tuple[str | None, int]:
    """Choose the clock with 0 <= now - stamp <= 0.2 s; None if no clock fits.

    Args:
        stamp_ns: timestamp of an image.
        now_ns: readings of the candidates when it arrived.

    Returns:
        The clock's name, and the largest disagreement of the fitting clocks, ns; 0 for one.
    """
    delays = {name: now_ns[name] - stamp_ns for name in CLOCKS if name in now_ns}
    fitting = {name: delay_ns for name, delay_ns in delays.items() if 0 <= delay_ns <= _MAX_DELAY_NS}
    if not fitting:
        return None, 0
    return next(iter(fitting)), max(fitting.values()) - min(fitting.values())


class StampClock:
    """Converts a driver's timestamps to UTC, using the clock that matches them.

    The computer's UTC clock may be stepped during a run, so its offset from the driver's clock is measured
    again for every image.

    Args:
        clock: name of the driver's clock; "auto" tries the candidates on the timestamps.

    Attributes:
        used: name of the clock of the last timestamp; None if it fitted no clock.
        delay_ns: age of the last image on arrival, by that clock.
    """

    def __init__(self, clock: str = "auto") -> None:
        self.used: str | None = None
        self.delay_ns = 0
        self._wanted = clock
        self._delays_ns: dict[str, int] = {}
        self._spread_ns = 0

    def to_utc_ns(self, stamp_ns: int) -> int | None:
        """Convert the timestamp of an image that has just arrived; None if no clock fits."""
        # Between two readings of UTC; the closest of a few tries, without interruption.
        brackets = []
        for _ in range(_N_BRACKETS):
            before_ns = time.time_ns()
            readings = read_clocks()
            brackets.append((time.time_ns() - before_ns, before_ns, readings))
        # A negative width: UTC was set back meanwhile.
        width_ns, before_ns, now_ns = min(brackets, key=lambda bracket: (bracket[0] < 0, bracket[0]))
        self._delays_ns = {name: reading_ns - stamp_ns for name, reading_ns in now_ns.items()}
        if self._wanted != "auto":
            self.used = self._wanted
        if not 0 <= self._delays_ns.get(self.used or "", -1) <= _MAX_STALL_NS:
            is_free = self._wanted == "auto"
            self.used, self._spread_ns = choose_clock(stamp_ns, now_ns) if is_free else (None, 0)
        if self.used is None:
            return None
        self.delay_ns = self._delays_ns[self.used]
        return before_ns + width_ns // 2 - self.delay_ns

    def problems(self) -> list[Finding]:
        """List the problems of the timestamps."""
        if self._delays_ns and (self.used is None or self._spread_ns > _HARMLESS_NS):
            ages = ", ".join(
                f"{name} {significant(delay_ns / 1e6, 3)} ms" for name, delay_ns in self._delays_ns.items()
            )
            return [findings.NO_CLOCK_FITS(ages=ages)]
        return []


class V4l2Source(LiveSource):
    """A camera at /dev/video*; see `LiveSource`.

    Timestamps are mid exposure in the computer's UTC: the driver's, corrected by (1) to (4) and converted
    from the clock that they fit. Without such a clock they are times of arrival, as the status reports.

    Args:
        sensor: the camera's name in the profile.
        settings: its block of the profile.
        silence_s: time without an image that is an error.
    """

    def __init__(self, sensor: str, settings: CameraSettings, silence_s: float = CAMERA_SILENCE_S) -> None:
        super().__init__(sensor, f"camera {sensor!r}", silence_s, _SILENT_HINT)
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
        self._exposure_us = settings.driver.frame_timing.exposure_us

    def open(self) -> None:
        """Open, set up and start the camera.

        Raises:
            SourceError: the camera is absent, busy, or does not support the profile's settings.
        """
        driver = self._settings.driver
        if driver.device is None:
            devices = ", ".join(video_devices()) or "none"
            line = "driver: {type: v4l2, device: /dev/video0}"
            hint = f"Add to cameras.{self.sensor}: {line}\nVideo devices of this computer: {devices}."
            raise SourceError(f"{self.sensor}: the profile does not say how it is reached", hint)
        self._last_sequence = None
        self._device = VideoDevice(driver.device, self.sensor)
        self._stack.callback(self._device.close)
        self._serial = serial_number(Path(driver.device).resolve().name)
        self._decoder = self._set_up_images()
        self._device_in_words = (
            f"{self._device.card} at {self._device.path} ({self._device.driver}, {self._device.bus}), "
            f"{self._decoder.code.strip()}"
        )
        self._known = list_controls(self._device)
        self._notes = apply_controls(self._device, self.sensor, driver.controls)
        if driver.frame_rate_hz is not None:
            self._device.set_rate(driver.frame_rate_hz)
        self._read_exposure()
        self._device.start(N_BUFFERS)

    def close(self) -> None:
        """Stop and close the camera."""
        self._stack.close()

    def describe(self) -> SourceStatus:
        """Report the state of the camera."""
        problems = self._notes + self._clock.problems()
        if self._n_damaged:
            problems.append(findings.DAMAGED_IMAGES(n=self._n_damaged))
        clock = None
        if self._has_sent and self._clock.used is None:
            clock = findings.ARRIVAL()
        elif self._has_sent:
            delay_ms = self._clock.delay_ns * 1e-6
            clock = findings.MID_EXPOSURE(clock=self._clock.used, mark=self._mark, delay_ms=delay_ms)
            if self._exposure_us is None:
                problems.append(findings.EXPOSURE_UNKNOWN())
        return SourceStatus(
            self.sensor,
            n_lost=self._n_lost,
            clock=clock,
            problems=tuple(problems),
            device=self._device_in_words,
            serial=self._serial,
        )

    def _set_up_images(self) -> PixelDecoder:
        """Negotiate the format of the images.

        Raises:
            SourceError: the size differs from the intrinsics', or no pixel format is supported.
        """
        device, (width, height) = self._device, self._settings.resolution_px
        where = f"camera {self.sensor!r}: {device.path} ({device.card})"
        offered = device.formats()
        wanted = self._settings.driver.pixel_format
        code = find_format(wanted) if wanted else next((c for c in offered if c in FORMATS), None)
        if code is None or (offered and code not in offered):
            what = f"does not offer pixel format {wanted}" if wanted else "offers no supported pixel format"
            listing = ", ".join(c.strip() for c in offered) or "none"
            raise SourceError(
                f"{where} {what}",
                f"It offers {listing}; read are {', '.join(FORMATS)}. Others: driver.type command.",
            )
        granted, stride = device.set_layout(code, width, height)
        if granted != (code, width, height):
            form = "{1}x{2} px in {0}".format
            what = f"{where} sends {form(*granted)}, the profile wants {form(code, width, height)}"
            hint = (
                "Choose one of its formats (`v4l2-ctl --list-formats-ext`); measure intrinsics at its size."
            )
            raise SourceError(what, hint)
        return PixelDecoder(code, width, height, stride)

    def read(self) -> list[LiveSample]:
        """Return the received image; see `LiveSource`."""
        try:
            came = self._device.read(READ_WAIT_S)
        except OSError:
            # The kernel calls it temporary; if it persists, the silence timeout ends it.
            self._n_damaged += 1
            time.sleep(READ_WAIT_S)
            return []
        if came is None:
            return []
        data, frame = came
        host_ns = time.time_ns()
        utc_ns = self._clock.to_utc_ns(
            1000 * (1_000_000 * frame.timestamp.seconds + frame.timestamp.microseconds)
        )
        if self._last_sequence is not None and frame.sequence > self._last_sequence:
            self._n_lost += frame.sequence - self._last_sequence - 1
        self._last_sequence = frame.sequence
        self._has_sent = True
        try:
            if frame.flags & abi.BUFFER_ERROR:
                raise ValueError("the driver says so")
            pixels = self._decoder.decode(data)
        except ValueError:
            self._n_damaged += 1
            return []
        if time.monotonic() - self._exposure_read_s > _EXPOSURE_EVERY_S:
            self._read_exposure()
        self._mark = stamped_moment(self._settings.driver, frame.flags, self._device.driver)
        timing, n_rows = self._settings.driver.frame_timing, self._settings.resolution_px[1]
        mid_ns = to_mid_ns(self._mark, timing, n_rows, self._exposure_us)
        stamp_ns = host_ns if utc_ns is None else utc_ns + mid_ns
        return [Image(self.sensor, self._channel, stamp_ns, pixels, host_ns, frame.sequence)]

    def _read_exposure(self) -> None:
        """Read the exposure, which automatic modes may change at any time."""
        self._exposure_read_s = time.monotonic()
        wanted_us = self._settings.driver.frame_timing.exposure_us
        self._exposure_us = read_exposure_us(self._device, self._known) if wanted_us is None else wanted_us
