"""Made-up observations of sensors, as input of the checks."""

import numpy as np

from lce_rig.core.data import Image, Pulse, Scan
from lce_rig.core.findings import Figure, Finding
from lce_rig.devices.reading import SourceStatus
from lce_rig.doctor.checks import Check
from lce_rig.doctor.observing import Examination, ObservedSensor
from lce_rig.rig import Rig
from lce_rig.timing.clock import ClockModel

S = 1_000_000_000
START_NS = 1_753_000_000 * S
UTC_FIGURES: dict[str, Figure] = {"pps": "locked", "is_fix": True, "nmea_past_hour_s": 754, "ahead_s": 0.0003}
LOCKED = Finding("clock.lidar_utc", "note", figures=UTC_FIGURES)
UNLOCKED = Finding("clock.pps_not_locked", "warning", figures={"pps": "absent"})
BOARD_NS = 5 * S
"""What the board's clock shows at START_NS."""


def make_rig(**changes):
    """A VLP-16 and a camera without distortion at a pipe, triggered at 20 Hz."""
    camera = {
        "resolution_px": (346, 260),
        "intrinsics": {"fx_px": 300.0, "fy_px": 300.0, "cx_px": 172.5, "cy_px": 129.5},
        "channels": {"frames": {"timestamps": {"reference": "mid_exposure", "sync": "hardware"}}},
        "driver": {"type": "command", "command": ("true",)},
    }
    profile = {
        "format_version": 1,
        "name": "attached",
        "board": {"inner_corners": (9, 6), "square_m": 0.068, "width_m": 0.8, "height_m": 0.6},
        "lidars": {
            "lidar": {"timestamps": {"clock": "utc", "reference": "first_firing", "sync": "hardware"}}
        },
        "cameras": {"cam": camera},
        "sync": {
            "device": "/dev/null",
            "triggers": {"cam": {"channel": 0, "rate_hz": 20.0, "max_delay_s": 0.04}},
        },
    }
    return Rig.model_validate({**profile, **changes})


def examination(*seen, rig=None):
    return Examination(rig or make_rig(), seen={each.sensor: each for each in seen})


def look(check, *arguments):
    """Make the line of a check; None where it finds nothing."""
    line = Check(arguments[1] if len(arguments) > 1 else "line", "check", tuple(check(*arguments)))
    return line if line.findings else None


def codes(line):
    """List the codes of the findings in one line of `doctor`."""
    return [found.code for found in line.findings]


def lidar(rate_hz=10.0, duration_s=5.0, **status):
    """A LiDAR whose scans arrive on time."""
    seen = ObservedSensor("lidar", SourceStatus("lidar", **status), watched_s=duration_s)
    seen.ended_ns = START_NS + round(duration_s * S)
    nothing = np.zeros(0, np.float32)
    for stamp_ns in range(START_NS, seen.ended_ns, round(S / rate_hz)):
        points = np.zeros((0, 3), np.float32)
        ring = np.zeros(0, np.int16)
        seen.take(Scan("lidar", stamp_ns, points, nothing, ring, None, stamp_ns + S // 10))
    return seen


def camera(rate_hz=20.0, duration_s=5.0, delay_s=0.015, **status):
    """A camera whose pictures follow each beginning of a period."""
    seen = ObservedSensor("cam", SourceStatus("cam", **status), watched_s=duration_s)
    seen.ended_ns = START_NS + round(duration_s * S)
    for number, begin_ns in enumerate(range(START_NS, seen.ended_ns, round(S / rate_hz))):
        stamp_ns = begin_ns + round(delay_s * S)
        seen.take(Image("cam", "frames", stamp_ns, np.zeros((2, 2), np.uint8), stamp_ns, 7 + number))
    return seen


def sync_board(rate_hz=20.0, duration_s=5.0, line="cam", drift=4e-05, **status):
    """A board whose clock runs too fast by `drift`, and whose pulses begin with each period."""
    seen = ObservedSensor("sync", SourceStatus("sync", **status), watched_s=duration_s)
    seen.ended_ns = START_NS + round(duration_s * S)
    for number, host_ns in enumerate(range(START_NS, seen.ended_ns, round(S / rate_hz))):
        stamp_ns = BOARD_NS + round((1 + drift) * (host_ns - START_NS))
        seen.take(Pulse(line, stamp_ns, 100 + number, host_ns + 300_000))
    seen.host_clock = ClockModel(
        BOARD_NS,
        START_NS,
        -drift,
        np.diag([1e8, 1e-14]),
        1e4,
        1e4,
        BOARD_NS,
        BOARD_NS + 5 * S,
        50,
        "requests",
    )
    return seen
