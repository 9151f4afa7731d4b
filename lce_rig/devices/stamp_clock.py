"""Which of the computer's clocks timestamps a camera's images, and what UTC time such a timestamp is.

Drivers say CLOCK_MONOTONIC. Jetson's do too, and use a counter that is seconds away from it. So every clock
is tried on the timestamps: an image is younger than 0.2 s when it arrives, and never of the future.

References:
    https://docs.kernel.org/userspace-api/media/v4l/buffer.html (V4L2_BUF_FLAG_TIMESTAMP_*)
    https://github.com/tier4/ros2_v4l2_camera (the offset of Jetson's counter)
"""

import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, NamedTuple

from lce_rig.core.findings import Finding
from lce_rig.devices import findings
from lce_rig.devices import v4l2_abi as abi
from lce_rig.rig import DriverSettings

Mark = Literal["start_of_exposure", "start_of_frame", "end_of_frame", "trigger"]
# Their flags say end of frame; the timestamp is what the video input saw of the first row (devices' forums).
_JETSON_DRIVERS = ("tegra", "nv_", "vi5", "vi6")


@dataclass(frozen=True)
class FrameTiming:
    """How the rows of an image are exposed and read.

    A row of a rolling shutter is exposed and then read; the next one follows a line time later. With rows 0
    to H-1, exposure e and line time l (0 for a global shutter), the middle row m = (H-1)/2 is half exposed at

        t_start of exposure + m l + e/2                                                                    (1)
        t_start of frame    + m l - e/2          the first row is exposed, its reading begins              (2)
        t_end of frame      - (H-m) l - e/2      the last row is read                                      (3)
        t_trigger + delay   + m l + e/2                                                                    (4)

    Attributes:
        n_rows: of the image.
        exposure_ns: of a row; None where unknown.
        line_time_ns: from row to row.
        trigger_delay_ns: from the trigger's edge to the start of the first row's exposure.
    """

    n_rows: int
    exposure_ns: float | None
    line_time_ns: float = 0.0
    trigger_delay_ns: float = 0.0

    def to_mid_ns(self, mark: Mark) -> int:
        """Return the time from a timestamp's moment to the middle of the exposure, (1) to (4).

        An unknown exposure counts as none.
        """
        half_ns = 0.5 * (self.exposure_ns or 0.0)
        rows_ns = 0.5 * (self.n_rows - 1) * self.line_time_ns
        if mark == "start_of_exposure":
            return round(rows_ns + half_ns)
        if mark == "start_of_frame":
            return round(rows_ns - half_ns)
        if mark == "end_of_frame":
            return round(rows_ns - self.n_rows * self.line_time_ns - half_ns)
        return round(self.trigger_delay_ns + rows_ns + half_ns)


def frame_timing(settings: DriverSettings, n_rows: int, exposure_us: float | None = None) -> FrameTiming:
    """Take the timing from the profile; the exposure from the camera where the profile has none."""
    timing = settings.frame_timing
    exposure_us = timing.exposure_us or exposure_us
    return FrameTiming(
        n_rows,
        None if exposure_us is None else 1000 * exposure_us,
        1000 * timing.line_time_us,
        1000 * timing.trigger_delay_us,
    )


def stamped_moment(settings: DriverSettings, flags: int, driver: str) -> Mark:
    """Find which moment a timestamp marks: as the profile says, else as a buffer's flags do.

    Args:
        settings: the camera's.
        flags: the kernel's, of a buffer.
        driver: its name; Jetson's flags are wrong.
    """
    if settings.frame_timing.mark != "auto":
        return settings.frame_timing.mark
    if driver.lower().startswith(_JETSON_DRIVERS):
        return "start_of_frame"
    is_start = flags & abi.STAMP_SOURCE_MASK == abi.STAMP_SOURCE_SOE
    return "start_of_exposure" if is_start else "end_of_frame"


MAX_DELAY_NS = 200_000_000
# A computer that stalls takes images late from the queue: no reason to doubt a clock once it is known.
_MAX_STALL_NS = 2_000_000_000
# Two clocks that agree as well as this may stand for each other.
HARMLESS_NS = 2_000_000
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


class ClockChoice(NamedTuple):
    """The clock that a timestamp was made with.

    Attributes:
        clock: its name; None where no clock fits.
        delays_ns: by clock, how old the timestamp would be.
        spread_ns: by how much the fitting clocks disagree; 0 where one fits.
    """

    clock: str | None
    delays_ns: Mapping[str, int]
    spread_ns: int

    @property
    def is_ambiguous(self) -> bool:
        """Whether clocks fit that differ by more than is harmless."""
        return self.spread_ns > HARMLESS_NS


def read_clocks() -> dict[str, int]:
    """Read every candidate clock now, ns; Jetson's counter only where the kernel gives its offset."""
    readings = {name: time.clock_gettime_ns(number) for name, number in _CLOCK_IDS.items()}
    try:
        offset_ns = int(_TSC_OFFSET.read_text())
    except (OSError, ValueError):
        return readings
    raw_ns = readings["monotonic_raw"]
    return readings | {"tsc": raw_ns + offset_ns, "tsc_minus": raw_ns - offset_ns}


def choose_clock(stamp_ns: int, now_ns: Mapping[str, int]) -> ClockChoice:
    """Choose the clock with 0 <= now - stamp <= 0.2 s.

    Args:
        stamp_ns: of an image.
        now_ns: readings of the candidates when it arrived.
    """
    delays = {name: now_ns[name] - stamp_ns for name in CLOCKS if name in now_ns}
    fitting = [name for name, delay_ns in delays.items() if 0 <= delay_ns <= MAX_DELAY_NS]
    if not fitting:
        return ClockChoice(None, delays, 0)
    ages = [delays[name] for name in fitting]
    return ClockChoice(fitting[0], delays, max(ages) - min(ages))


class StampClock:
    """Turns a driver's timestamps into UTC, by the clock they fit.

    The computer's UTC clock may be stepped while we run; its distance from the driver's clock is measured
    again for every image.

    Args:
        clock: name of the driver's clock; "auto" tries the candidates on the timestamps.
    """

    def __init__(self, clock: str = "auto") -> None:
        self.clock: str | None = None if clock == "auto" else clock
        self.choice: ClockChoice | None = None
        self.n_changes = 0
        self.delay_ns = 0
        self._is_fixed = clock != "auto"
        self._is_missing = False

    def to_utc_ns(self, stamp_ns: int) -> int | None:
        """Convert the timestamp of an image that has just arrived; None where no clock fits."""
        # Between two readings of UTC; the closest of a few tries, without interruption.
        brackets = []
        for _ in range(_N_BRACKETS):
            before_ns = time.time_ns()
            readings = read_clocks()
            brackets.append((time.time_ns() - before_ns, before_ns, readings))
        # A negative width: UTC was set back meanwhile.
        width_ns, before_ns, now_ns = min(brackets, key=lambda bracket: (bracket[0] < 0, bracket[0]))
        utc_ns = before_ns + width_ns // 2
        delay_ns = now_ns[self.clock] - stamp_ns if self.clock in now_ns else -1
        if not self._is_fixed and not 0 <= delay_ns <= _MAX_STALL_NS:
            self.n_changes += self.clock is not None
            self.choice = choose_clock(stamp_ns, now_ns)
            self.clock = self.choice.clock
        self._is_missing = self.clock is not None and self.clock not in now_ns
        if self.clock is None or self._is_missing:
            return None
        self.delay_ns = now_ns[self.clock] - stamp_ns
        return utc_ns - self.delay_ns

    @property
    def used(self) -> str | None:
        """Name of the clock behind the last timestamp; None where arrival had to be taken."""
        return None if self._is_missing else self.clock

    def problems(self) -> list[Finding]:
        """List the problems of the timestamps."""
        if self._is_missing:
            return [findings.CLOCK_MISSING(clock=self.clock)]
        if self._is_fixed:
            is_right = 0 <= self.delay_ns <= _MAX_STALL_NS
            wrong = findings.CLOCK_DOES_NOT_FIT(clock=self.clock, delay_ms=self.delay_ns * 1e-6)
            return [] if is_right else [wrong]
        problems: list[Finding] = []
        if self.choice is not None:
            delays_ms = tuple((name, delay_ns * 1e-6) for name, delay_ns in self.choice.delays_ns.items())
            if self.choice.clock is None:
                problems.append(findings.NO_CLOCK_FITS(delays_ms=delays_ms))
            elif self.choice.is_ambiguous:
                spread_ms = self.choice.spread_ns * 1e-6
                problems.append(findings.CLOCK_AMBIGUOUS(spread_ms=spread_ms, delays_ms=delays_ms))
        if self.n_changes:
            problems.append(findings.CLOCK_CHANGED(n=self.n_changes))
        return problems
