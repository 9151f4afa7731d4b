"""Mid exposure from any mark: against rows exposed one by one."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lce_rig.devices.v4l2 import stamped_moment, to_mid_ns
from lce_rig.rig import DriverSettings, FrameTimingSettings

ROWS = st.integers(2, 1080)
TIMES = st.integers(0, 40_000)


@given(n_rows=ROWS, exposure_ns=TIMES, line_time_ns=TIMES, delay_ns=TIMES)
def test_every_mark_leads_to_the_middle_of_the_middle_row(
    n_rows: int, exposure_ns: int, line_time_ns: int, delay_ns: int
) -> None:
    starts = delay_ns + line_time_ns * np.arange(n_rows)  # after the trigger at 0
    reads = starts + exposure_ns
    middle = np.mean(starts + exposure_ns / 2)
    marks = {
        "trigger": 0,
        "start_of_exposure": starts[0],
        "start_of_frame": reads[0],
        "end_of_frame": reads[-1] + line_time_ns,
    }
    frame = FrameTimingSettings(
        line_time_us=line_time_ns / 1000,
        trigger_delay_us=delay_ns / 1000,
    )
    for mark, stamp in marks.items():
        assert abs(stamp + to_mid_ns(mark, frame, n_rows, exposure_ns / 1000) - middle) <= 1  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("mark", "flags", "driver", "moment"),
    [
        ("auto", 0x2000, "uvcvideo", "end_of_frame"),
        ("auto", 0x12000, "uvcvideo", "start_of_exposure"),
        ("auto", 0x2000, "tegra-video", "start_of_frame"),
        ("trigger", 0x12000, "tegra-video", "trigger"),
    ],
)
def test_the_mark_comes_from_profile_flags_and_driver(
    mark: str, flags: int, driver: str, moment: str
) -> None:
    settings = DriverSettings(frame_timing=FrameTimingSettings(mark=mark))  # type: ignore[arg-type]
    assert stamped_moment(settings, flags, driver) == moment
