"""Kinds of findings of the doctor: the computer, each sensor's device, stream, clock and pulses."""

from lce_rig.core.findings import Finding, Kind, note_kind, warning_kind


def _answers(finding: Finding) -> str:
    """{device} answers."""
    return str(finding.figures["device"] or "answers")


def _rate(finding: Finding) -> str:
    """{stream} come at {rate_hz}, {expected_hz} expected."""
    is_known = finding.figures["expected_hz"] is not None
    expected = f" ({finding.figure('expected_hz'):g} expected)" if is_known else ""
    return f"{finding.figure('rate_hz'):.1f} {finding.figures['stream']}/s{expected}"


def _pulse(finding: Finding) -> str:
    """PPS is {pps}, NMEA {nmea_past_hour_s} past the hour, valid: {is_fix}."""
    pps, past_hour_s = finding.figures["pps"] or "unknown", finding.figures.get("nmea_past_hour_s")
    if past_hour_s is not None:
        minute, second = divmod(round(finding.figure("nmea_past_hour_s")), 60)
        fix = "" if finding.figures.get("is_fix") else ", no fix"
        return f"{pps}, NMEA {minute:02d}:{second:02d} past the hour{fix}"
    return f"{pps}, no NMEA" if finding.figures["has_position"] else f"{pps}, no position packets"


DISK = note_kind("computer.disk", "{free_mb:.0f} MB free, {write_mbps:.0f} MB/s flushed, in {folder}")
DISK_FULL = Kind(
    "computer.disk_full",
    "too little space (minimum 5000 MB)",
    "make room, or `lce-rig collect --rig RIG OTHER_DISK/session`",
)
DISK_SLOW = Kind(
    "computer.disk_slow",
    "too slow (minimum 20 MB/s)",
    "collect on an SSD: `lce-rig collect --rig RIG OTHER_DISK/session`",
)
DISK_NOT_WRITABLE = Kind(
    "computer.disk_not_writable",
    "{folder} cannot be written: {cause}",
    "make room, or `lce-rig collect --rig RIG OTHER_DISK/session`",
)
COMPUTER_CLOCK = note_kind("computer.clock", "synchronised, error at most {max_error_ms:.0f} ms")
COMPUTER_CLOCK_LOOSE = warning_kind(
    "computer.clock_not_synchronised",
    "not synchronised, according to the kernel",
    "run: timedatectl set-ntp true, or let chrony follow the rig's GPS",
)

FAILED = Kind("sensor.failed", "{what}", "{hint}")
ANSWERS = note_kind("sensor.answers", _answers)
RATE = note_kind("stream.rate", _rate)
RATE_OFF = warning_kind(
    "stream.rate_off",
    _rate,
    "set rate and exposure (long ones slow down), or correct the profile",
    actions={
        "rotor": "set rpm {expected_rpm:.0f} on its web page, or rate_hz in the profile",
        "trigger": "set its trigger mode in driver.controls, and check the line",
    },
)
NO_STREAM = Kind("stream.none", "no {stream}", "check its trigger line; a triggered camera waits for pulses")
STOPPED = Kind(
    "stream.stopped",
    "{rate_hz:.1f} {stream}/s, then none for {silent_s:.1f} s",
    "check cable and power, and its trigger line",
)
EVENT_RATE = note_kind("stream.events", "{events_per_s:,.0f} events/s")
NO_EVENTS = Kind("stream.no_events", "no events", "uncover the lens, and check the biases in driver.controls")
COMPLETE = note_kind("stream.complete", "none lost")
LOSSES = Kind(
    "stream.losses",
    "{n_lost} lost, {n_dropped} not read in time",
    "check its cable; close other programs (top shows which are busy)",
    actions={"named": ""},
)

PULSE = note_kind("clock.pulse", _pulse)
WITHOUT_PULSES = note_kind(
    "clock.without_pulses",
    "timestamps by arrival need still boards",
    "without it: lidars.*.timestamps clock: host, sync: none, still boards",
)
NO_TIMESTAMPS = note_kind("clock.no_timestamps", "no timestamps yet")
EDGES_FITTED = note_kind(
    "edges.fitted", "{n_edges} of {n_pulses} pulses, drift {drift_ppm:+.1f} ppm, scatter {rms_us:.1f} us"
)
EDGES_NOT_FITTED = Kind("edges.not_fitted", "{n_edges} edges of {n_pulses} pulses detected, clock not fitted")
LINE = note_kind("pulses.line", "{line} {rate_hz:.3g} Hz")
LINE_OFF = warning_kind(
    "pulses.line_off",
    "{line} {rate_hz:.3g} Hz ({expected_hz:g} Hz expected)",
    "check sync.triggers.{line}, reset the board",
    actions={"pps": "reset the board"},
)
FRAMES_OF_PULSES = note_kind("pulses.frames", "{n_frames} images of {n_pulses} pulses")
UNEQUAL = Kind(
    "pulses.unequal",
    "image and pulse counts differ",
    "set the camera's trigger mode in driver.controls, check the line",
)
DELAY = note_kind("pulses.delay", "delay {delay_ms:.2f} +- {delay_scatter_ms:.2f} ms")
