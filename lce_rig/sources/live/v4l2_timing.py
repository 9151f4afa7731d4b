"""From the moment a driver stamps to the middle of the exposure, for the middle row of a picture.

A row of a rolling shutter is exposed and then read; the next one follows a line time later. With rows 0 to
H-1, exposure e and line time l, the middle row m = (H-1)/2 is half exposed at

    t_start of exposure + m l + e/2                                                                        (1)
    t_start of frame    + m l - e/2          the first row is exposed, its reading begins                  (2)
    t_end of frame      - (H-m) l - e/2      the last row is read                                          (3)
    t_trigger + delay   + m l + e/2                                                                        (4)

A global shutter has l = 0.
"""

from dataclasses import dataclass
from typing import Literal

from lce_rig.rig import DriverSettings
from lce_rig.sources.live import v4l2_abi as abi

Mark = Literal["start_of_exposure", "start_of_frame", "end_of_frame", "trigger"]
# Their flags say end of frame; the stamp is what the video input saw of the first row (devices' forums).
_JETSON_DRIVERS = ("tegra", "nv_", "vi5", "vi6")


@dataclass(frozen=True)
class FrameTiming:
    """How the rows of a picture are exposed and read.

    Attributes:
        n_rows: of the picture.
        exposure_ns: of a row; None where unknown.
        line_time_ns: from row to row; 0 for a global shutter.
        trigger_delay_ns: from the trigger's edge to the start of the first row's exposure.
    """

    n_rows: int
    exposure_ns: float | None
    line_time_ns: float = 0.0
    trigger_delay_ns: float = 0.0

    def to_mid_ns(self, mark: Mark) -> int:
        """Give what to add to a stamp of a kind to come to the middle of the exposure, (1) to (4).

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
    given = settings.frame_timing
    exposure_us = given.exposure_us or exposure_us
    return FrameTiming(
        n_rows,
        None if exposure_us is None else 1000 * exposure_us,
        1000 * given.line_time_us,
        1000 * given.trigger_delay_us,
    )


def stamped_moment(settings: DriverSettings, flags: int, driver: str) -> Mark:
    """Find which moment a stamp marks: as the profile says, else as a buffer's flags do.

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
