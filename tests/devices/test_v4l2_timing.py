"""Mid exposure from any mark, against rows exposed one by one; and which clock made a timestamp."""

import time

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lce_rig.devices.v4l2 import CLOCKS, StampClock, choose_clock, read_clocks, stamped_moment, to_mid_ns
from lce_rig.rig import DriverSettings, FrameTimingSettings

ROWS = st.integers(2, 1080)
TIMES = st.integers(0, 40_000)


@given(n_rows=ROWS, exposure_ns=TIMES, line_time_ns=TIMES, delay_ns=TIMES)
def test_every_timestamp_moment_converts_to_mid_exposure(n_rows, exposure_ns, line_time_ns, delay_ns):
    starts = delay_ns + line_time_ns * np.arange(n_rows)  # after the trigger at 0
    reads = starts + exposure_ns
    middle = np.mean(starts + exposure_ns / 2)
    marks = {
        "trigger": 0,
        "start_of_exposure": starts[0],
        "start_of_frame": reads[0],
        "end_of_frame": reads[-1] + line_time_ns,
    }
    frame = FrameTimingSettings(line_time_us=line_time_ns / 1000, trigger_delay_us=delay_ns / 1000)
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
def test_timestamp_moment_uses_profile_flags_and_driver(mark, flags, driver, moment):
    settings = DriverSettings(frame_timing=FrameTimingSettings(mark=mark))  # type: ignore[arg-type]
    assert stamped_moment(settings, flags, driver) == moment


MS = 1_000_000
# As read on a rig: UTC, time since boot with a night of suspend, and Jetson's counter 29 s ahead of raw time.
NOW = {
    "monotonic": 8_000_000 * MS,
    "monotonic_raw": 8_000_450 * MS,
    "tsc": 8_029_450 * MS,
    "tsc_minus": 7_971_450 * MS,
    "boottime": 36_000_000 * MS,
    "realtime": 1_763_733_600_000 * MS,
}


@pytest.mark.parametrize("clock", CLOCKS)
@pytest.mark.parametrize("age_ms", [0, 12, 199])
def test_clock_of_timestamps_is_found(clock, age_ms):
    assert choose_clock(NOW[clock] - age_ms * MS, NOW) == (clock, 0)


@pytest.mark.parametrize(
    ("age_ms", "apart_ms", "chosen"),
    [(age_ms, 0, (None, 0)) for age_ms in (-1, 201, 5000, -29_000)]
    + [(20, 1, ("monotonic", MS)), (20, 40, ("monotonic", 40 * MS))],
)
def test_ambiguous_clocks_are_distinguished_from_none(age_ms, apart_ms, chosen):
    now = NOW | ({"monotonic_raw": NOW["monotonic"] + apart_ms * MS} if apart_ms else {})
    assert choose_clock(NOW["monotonic"] - age_ms * MS, now) == chosen


@pytest.mark.parametrize("clock", ["monotonic", "realtime"])
def test_host_clock_timestamp_becomes_utc(clock):
    before_ns, stamp_ns, after_ns = time.time_ns(), read_clocks()[clock], time.time_ns()
    stamps = StampClock()
    utc_ns = stamps.to_utc_ns(stamp_ns)
    assert utc_ns is not None
    # The clocks are read one after the other: 50 us cover what that takes on a busy computer.
    assert before_ns - 50_000 <= utc_ns <= after_ns + 50_000
    assert stamps.problems() == []


def test_timestamps_of_unknown_clock_are_a_problem():
    stamps = StampClock()
    assert stamps.to_utc_ns(read_clocks()["monotonic"] + 3600 * 1000 * MS) is None
    (problem,) = stamps.problems()
    assert problem.code == "clock.none_fits"
    assert "monotonic -3600000 ms" in str(problem.figures["ages"])


def test_timestamp_clock_change_is_followed():
    stamps = StampClock()
    stamps.to_utc_ns(read_clocks()["monotonic"])
    stamps.to_utc_ns(read_clocks()["realtime"])
    assert stamps.used == "realtime" and stamps.problems() == []


@pytest.mark.parametrize("clock", ["realtime", "tsc"])
def test_v4l2_wrong_clock_is_not_used(clock):
    stamps = StampClock(clock)
    assert stamps.to_utc_ns(read_clocks()["monotonic"] - 40_000 * MS) is None
    assert stamps.used is None
    (problem,) = stamps.problems()
    assert problem.code == "clock.none_fits"
