"""Kinds of findings on attached sensors: the device, its stream, its clock, its settings."""

from lce_rig.core.findings import Finding, note_kind, warning_kind
from lce_rig.core.phrasing import significant

_RAISE_LIMIT = "raise it: sudo sysctl -w net.core.rmem_max=4194304"


def _board_clock(finding: Finding) -> str:
    """The timestamps are the board's clock, synchronised with the computer and UTC by {host_by}, {utc_by}."""
    parts = []
    for name, to in (("host", "the computer's"), ("utc", "UTC")):
        if f"{name}_by" in finding.figures:
            sigma_us = finding.figure(f"{name}_sigma_us")
            sigma = f"{sigma_us / 1000:.1f} ms" if sigma_us >= 1000 else f"{significant(sigma_us, 3)} us"
            drift = f"drift {finding.figure(f'{name}_drift_ppm'):+.1f} ppm, standard deviation {sigma}"
            parts.append(f"synchronised with {to} by {finding.figures[f'{name}_by']}: {drift}")
    synchronised = "; ".join(parts) or "not yet synchronised with the computer's"
    text = f"the board's own clock, {synchronised}"
    has_asked = "round_trip_ms" in finding.figures
    return text + (f"; round trip {finding.figure('round_trip_ms'):.1f} ms" if has_asked else "")


CONTROL_DIFFERS = warning_kind(
    "device.control_differs", "control {control} is {given}, the profile's value is {expected}"
)
RECORDING_STOPPED = warning_kind(
    "device.recording_stopped", "recording to {path} stopped: {cause}", "free some space"
)
RECORDING_INCOMPLETE = warning_kind(
    "device.recording_incomplete",
    "{n} samples missing in {path}: the disk is too slow",
    "record to a faster disk",
)
BOARD_SILENT = warning_kind(
    "device.board_silent",
    "no message from the board for {silent_s:.0f} s",
    "check its cable and power, press its reset",
)
BOARD_RESTARTED = warning_kind(
    "device.board_restarted",
    "the board restarted {n} times, last {ago_s:.0f} s ago",
    "check its power, and that no other program opens its port",
)
BOARD_ERROR = warning_kind("device.board_error", "the board reports: {message} (error {number})")

PACKETS_LOST = warning_kind(
    "stream.packets_lost",
    "{share:1percent} of the packets lost (limit 1 %)",
    "check cable and switch, and that the LiDAR's field of view is 0 to 359",
)
COMPUTER_TOO_SLOW = warning_kind(
    "stream.computer_too_slow",
    "this computer was too slow for {n} packets",
    "close other programs, and see `lce-rig doctor --rig RIG`",
)
ROTOR_RATE = warning_kind(
    "stream.rotor_rate",
    "rotor at {rotor_hz:.1f} Hz ({expected_hz:g} expected)",
    "set rate_hz in the profile, or rpm {expected_rpm:.0f} on the web page",
)
DAMAGED_IMAGES = warning_kind(
    "stream.damaged_images", "{n} damaged images", "check the camera's cable and `dmesg | tail`"
)
MESSAGES_SKIPPED = warning_kind(
    "stream.messages_skipped",
    "{n} messages damaged, repeated or late",
    "record a bag: `lce-rig collect --rig RIG --from FILE` names the cause",
)
DAMAGED_LINES = warning_kind(
    "stream.damaged_lines",
    "{n} of {n_lines} messages damaged",
    "check cable, ground and sync.baud, and that nothing else reads the port",
)
NO_PULSES = warning_kind(
    "stream.no_pulses", "no pulses for {line}", "check sync.triggers.{line}.channel and that triggers are on"
)
PULSE_LINES_LOST = warning_kind(
    "stream.pulse_lines_lost",
    "messages of {n} pulses lost ({by_line})",
    "use a USB port of its own, and close other programs",
)
BUFFER_SMALL = warning_kind(
    "buffer.small",
    "the receive buffer ({buffer_kib} KiB) holds {buffer_s:0ms} (minimum 250 ms)",
    _RAISE_LIMIT,
)

ARRIVAL = note_kind("clock.arrival", "arrival at this computer, later than the exposure by an unknown time")
HEADER = note_kind("clock.header", "headers of the ROS 2 messages, {delay_ms:.3g} ms before their arrival")
MID_EXPOSURE = note_kind(
    "clock.mid_exposure",
    "{mark} by clock {clock}, as this computer's UTC, corrected to mid exposure; "
    "{delay_ms:.0f} ms old on arrival",
)
DAVIS_CLOCK = note_kind(
    "clock.davis",
    "the camera's own clock, set to this computer's UTC on opening; drifts until fitted to trigger edges; "
    "{delay_ms:.0f} ms old on arrival",
)
NO_CLOCK_FITS = warning_kind(
    "clock.none_fits",
    "no clock alone fits the timestamps (image age by {ages})",
    "set driver.frame_timing.clock",
)
EXPOSURE_UNKNOWN = warning_kind(
    "clock.exposure_unknown",
    "the camera does not report its exposure: timestamps are wrong by half of it",
    "set driver.frame_timing.exposure_us",
)
TRIGGER_INPUT_OFF = warning_kind(
    "clock.trigger_input_off",
    "the trigger input cannot be switched on: no edges are detected, and the clock drifts",
    "update the camera's firmware",
)
FOLLOWS_OTHER_CAMERA = warning_kind(
    "clock.follows_other_camera",
    "it follows another camera's clock",
    "unplug the sync cable, or wire the trigger to that camera",
)
CLOCK_DIFFERS = warning_kind(
    "clock.differs_from_computer",
    "its clock and this computer's differ by {difference_s:.3g} s (limit 0.5 s)",
    "open the camera again; stop programs that set this computer's clock",
)

BOARD_CLOCK = note_kind("clock.board", _board_clock)
BOARD_NOT_TIED = warning_kind(
    "clock.board_not_tied",
    "the board's clock is not synchronised with the computer's: no answers to time requests, no pulses",
    "check its firmware",
)
COMPUTER_JUMPED = warning_kind(
    "clock.computer_jumped",
    "the computer's clock jumped {n} times, last by {last_s:+.3f} s",
    "do not set it while you collect (chrony slews, ntpdate jumps)",
)
NO_PPS = warning_kind(
    "clock.no_pps", "no pulse per second: the LiDAR cannot be synchronised", "press the board's reset"
)
BOARD_WITHOUT_UTC = warning_kind(
    "clock.board_without_utc", "the board does not know UTC yet: the LiDAR's hour is unknown"
)
