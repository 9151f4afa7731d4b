"""Phrases of drivers: devices, streams, clocks, and the pulses and edges that synchronise them."""

from collections.abc import Mapping

from lce_rig.core.findings import Figure, Finding
from lce_rig.words.rendering import Phrase

_RAISE_LIMIT = (
    "raise the receive buffer limit, now {buffer_kib} KiB: sudo sysctl -w net.core.rmem_max=4194304"
)
_BY_ARRIVAL = "scans are timestamped by arrival: "


def _lidar_utc(finding: Finding) -> str:
    """The timestamps are the LiDAR's UTC by PPS and NMEA, {ahead_s} ahead of this computer's clock."""
    ahead_s = finding.figures.get("ahead_s")
    offset = f", {1000 * finding.figure('ahead_s'):+.1f} ms from this computer's clock" if ahead_s else ""
    return f"UTC by PPS and NMEA{offset}"


def _nmea_of_other_second(finding: Finding) -> str:
    """The sentences' time is {nmea_past_hour_s} past the hour, not the LiDAR's."""
    minute, second = divmod(round(finding.figure("nmea_past_hour_s")), 60)
    return f"{_BY_ARRIVAL}NMEA time {minute:02d}:{second:02d} past the hour is not the LiDAR's"


def _mid_exposure(finding: Finding) -> str:
    """The timestamps are of mid exposure, from {mark} by {clock}; images arrive {delay_ms} old."""
    mark = str(finding.figures["mark"]).replace("_", " ")
    moved = f"{mark} by clock {finding.figures['clock']}, as this computer's UTC, corrected to mid exposure"
    return moved + _delay(finding)


def _davis(finding: Finding) -> str:
    """The timestamps are the camera's own clock, set on opening; events arrive {delay_ms} old."""
    own = (
        "the camera's own clock, set to this computer's UTC on opening; drifts until fitted to trigger edges"
    )
    return own + _delay(finding)


def _delay(finding: Finding) -> str:
    delay = finding.figures.get("delay_ms")
    return "" if delay is None else f"; {finding.figure('delay_ms'):.0f} ms old on arrival"


def _board_clock(finding: Finding) -> str:
    """The timestamps are the board's clock, synchronised with the computer and UTC by {host_by}, {utc_by}."""
    parts = [_tie(finding, "host", "the computer's"), _tie(finding, "utc", "UTC")]
    known = [part for part in parts if part] or ["not yet synchronised with the computer's"]
    text = f"the board's own clock, {'; '.join(known)}"
    has_asked = "round_trip_ms" in finding.figures
    return text + (f"; round trip {finding.figure('round_trip_ms'):.1f} ms" if has_asked else "")


def _tie(finding: Finding, name: str, to: str) -> str:
    if f"{name}_by" not in finding.figures:
        return ""
    sigma_us = finding.figure(f"{name}_sigma_us")
    sigma = f"{sigma_us / 1000:.1f} ms" if sigma_us >= 1000 else f"{sigma_us:.3g} us"
    drift = f"drift {finding.figure(f'{name}_drift_ppm'):+.1f} ppm, standard deviation {sigma}"
    return f"synchronised with {to} by {finding.figures[f'{name}_by']}: {drift}"


def _ages(finding: Finding) -> str:
    ages = finding.figures["delays_ms"]
    assert isinstance(ages, tuple)
    return ", ".join(f"{_number(name)} {_number(age)} ms" for name, age in map(_pair, ages))


def _none_fits(finding: Finding) -> str:
    """No clock of this computer fits the timestamps, {delays_ms} by clock; the arrival is used."""
    return f"no clock fits the timestamps (image age by {_ages(finding)}); arrival times are used"


def _ambiguous_clock(finding: Finding) -> str:
    """Several clocks fit the timestamps, {delays_ms}; they are uncertain by {spread_ms}."""
    spread_ms = finding.figure("spread_ms")
    return f"the clock of the timestamps is uncertain by {spread_ms:.3g} ms (image age by {_ages(finding)})"


def _pulse_lines_lost(finding: Finding) -> str:
    """Messages of {n} pulses were lost, {by_line}."""
    by_line = finding.figures["by_line"]
    assert isinstance(by_line, tuple)
    lines = ", ".join(f"{_number(line)} {_number(n)}" for line, n in map(_pair, by_line))
    return f"messages of {finding.figures['n']} pulses lost ({lines})"


def _pair(figure: Figure) -> tuple[Figure, Figure]:
    assert isinstance(figure, tuple)
    first, second = figure
    return first, second


def _number(figure: Figure) -> str:
    return f"{figure:.3g}" if isinstance(figure, float) else str(figure)


def _simulated_slowly(finding: Finding) -> str:
    """The simulation runs {factor} times slower than real time."""
    factor = f"{'more than' if finding.figures['is_more'] else 'about'} {finding.figures['factor']}"
    return f"simulated {factor} times slower than real time"


_DEVICE: Mapping[str, Phrase] = {
    "device.control_differs": Phrase("control {control} is {given}, the profile's value is {expected}"),
    "device.row_padding": Phrase(
        "rows of {row_bytes} bytes, GStreamer pads them to {padded_bytes}",
        "if the image is slanted, let the command write JPEG (jpegenc)",
    ),
    "device.recording_stopped": Phrase("recording to {path} stopped: {cause}", "free some space"),
    "device.recording_incomplete": Phrase(
        "{n} samples missing in {path}: the disk is too slow", "record to a faster disk"
    ),
    "device.board_silent": Phrase(
        "no message from the board for {silent_s:.0f} s", "check its cable and power, press its reset"
    ),
    "device.commands_not_taken": Phrase("the board did not accept {n} commands", "press its reset"),
    "device.board_restarted": Phrase(
        "the board restarted {n} times, last {ago_s:.0f} s ago",
        "check its power, and that no other program opens its port",
    ),
    "device.board_error": Phrase("the board reports: {message} (error {number})"),
}
_STREAM: Mapping[str, Phrase] = {
    "stream.packets_lost": Phrase(
        "{share:1percent} of the packets lost (limit 1 %)",
        "check cable and switch, and that the LiDAR's field of view is 0 to 359",
    ),
    "stream.computer_too_slow": Phrase(
        "this computer was too slow for {n} packets", f"close other programs, and {_RAISE_LIMIT}"
    ),
    "stream.rotor_rate": Phrase(
        "rotor at {rotor_hz:.1f} Hz ({expected_hz:g} expected)",
        "set rate_hz in the profile, or rpm {expected_rpm:.0f} on the web page",
    ),
    "stream.rate_refused": Phrase(
        "the camera sends {rate_hz:.4g} images/s ({expected_hz:g} expected)",
        "choose a rate that `v4l2-ctl --list-formats-ext` lists",
    ),
    "stream.few_buffers": Phrase("the driver grants {n} buffers ({expected} expected): images may be lost"),
    "stream.damaged_images": Phrase(
        "{n} damaged images",
        "check the camera's cable and `dmesg | tail`",
        {"command": "check the command"},
    ),
    "stream.messages_skipped": Phrase(
        "{n} messages damaged, repeated or late", "record a bag: `lce-rig collect --from` names the cause"
    ),
    "stream.damaged_lines": Phrase(
        "{n} of {n_lines} messages damaged",
        "check cable, ground and sync.baud, and that nothing else reads the port",
    ),
    "stream.no_pulses": Phrase(
        "no pulses for {line}", "check sync.triggers.{line}.channel and that triggers are on"
    ),
    "stream.pulse_lines_lost": Phrase(_pulse_lines_lost, "use a USB port of its own"),
    "stream.pps_lines_lost": Phrase("messages of {n} pulses per second lost; the LiDAR received the pulses"),
    "stream.lines_dropped_by_board": Phrase(
        "the board dropped {n} messages: the computer read too slowly", "close other programs"
    ),
    "stream.simulated_slowly": Phrase(
        _simulated_slowly, "expect low rates: this computer is too busy or too slow, no sensor is at fault"
    ),
    "buffer.small": Phrase("the receive buffer holds {buffer_s:0ms} (minimum 250 ms)", _RAISE_LIMIT),
}
_PACKETS: Mapping[str, Phrase] = {
    "packet.wrong_length": Phrase("{n} {of} packets of wrong length skipped"),
    "packet.wrong_flag": Phrase("{n} {of} packets with a wrong block flag skipped"),
    "packet.time_beyond_hour": Phrase("{n} {of} packets with a time beyond the hour skipped"),
    "packet.azimuth_beyond_360": Phrase("{n} {of} packets with an azimuth beyond 360 deg skipped"),
    "packet.unknown_factory_bytes": Phrase(
        "{n} {of} packets with unknown factory bytes skipped (firmware before 3.0.29 sends none)"
    ),
    "packet.uneven_azimuths": Phrase("{n} {of} packets with uneven azimuths skipped"),
    "packet.unknown_pps": Phrase("{n} {of} packets with an unknown PPS state skipped"),
    "packet.lost": Phrase("{n} data packets lost"),
    "packet.late": Phrase("{n} data packets late or sent twice, skipped"),
    "packet.astray": Phrase("{n} data packets with a damaged time skipped"),
    "packet.clock_set": Phrase("the LiDAR's clock was set {n} times"),
    "scan.partial": Phrase("{n} revolutions skipped: cut off at an end, or where the clock was set"),
    "scan.thin": Phrase("{n} revolutions skipped: more than half of their packets are lost"),
    "scan.empty": Phrase("{n} revolutions without a return"),
    "scan.not_rising": Phrase("{n} scans skipped: their timestamps do not rise"),
    "packet.other_model": Phrase("{n} {of} packets of another LiDAR model skipped"),
    "datagram.fragmented": Phrase("{n} datagrams sent in fragments skipped"),
    "datagram.cut_short": Phrase("{n} datagrams cut short by the recorder skipped"),
}
_LIDAR_CLOCK: Mapping[str, Phrase] = {
    "clock.lidar_utc": Phrase(_lidar_utc),
    "clock.host_wanted": Phrase(f"{_BY_ARRIVAL}timestamps.clock is host"),
    "clock.arrivals_unknown": Phrase("scans are not timestamped: their arrivals and so the hour are unknown"),
    "clock.no_position_packets": Phrase(
        f"{_BY_ARRIVAL}no position packets, which report PPS",
        "open port 8308 in the firewall, and record it beside the data",
    ),
    "clock.position_packets_stopped": Phrase(
        f"{_BY_ARRIVAL}position packets have stopped, or their time differs",
        "check the network and the sensor",
    ),
    "clock.pps_not_locked": Phrase(
        f"{_BY_ARRIVAL}PPS is {{pps}}",
        "check the pulse at the LiDAR's interface box: 1 Hz, 3 to 15 V, rising edge",
    ),
    "clock.no_nmea": Phrase(f"{_BY_ARRIVAL}no NMEA", "send $GPRMC at 9600 baud with RS-232 polarity"),
    "clock.nmea_damaged": Phrase(
        f"{_BY_ARRIVAL}NMEA is damaged", "send $GPRMC at 9600 baud with RS-232 polarity"
    ),
    "clock.nmea_of_other_second": Phrase(
        _nmea_of_other_second, "send each sentence after its pulse, within a second"
    ),
    "clock.lidar_utc_differs": Phrase(
        f"{_BY_ARRIVAL}the LiDAR's UTC differs by {{ahead_s:+.2f}} s from this computer's",
        "set this computer's clock by the same source (chrony with gpsd, or NTP)",
    ),
}
_CAMERA_CLOCK: Mapping[str, Phrase] = {
    "clock.arrival": Phrase("arrival at this computer, later than the exposure by an unknown time"),
    "clock.header": Phrase("headers of the ROS 2 messages, {delay_ms:.3g} ms before their arrival"),
    "clock.simulated": Phrase("simulated"),
    "clock.mid_exposure": Phrase(_mid_exposure),
    "clock.davis": Phrase(_davis),
    "clock.missing": Phrase(
        "this computer has no clock {clock}; arrival times are used", "set driver.frame_timing.clock"
    ),
    "clock.does_not_fit": Phrase(
        "by clock {clock} images are {delay_ms:.3g} ms old", "correct driver.frame_timing.clock"
    ),
    "clock.none_fits": Phrase(_none_fits, "set driver.frame_timing.clock if you know it"),
    "clock.ambiguous": Phrase(_ambiguous_clock, "set driver.frame_timing.clock if you know it"),
    "clock.changed": Phrase("the timestamps changed clock {n} times", "check the camera's driver (dmesg)"),
    "clock.exposure_unknown": Phrase(
        "the camera does not report its exposure: timestamps are wrong by half of it",
        "set driver.frame_timing.exposure_us",
    ),
    "clock.trigger_input_off": Phrase(
        "the trigger input cannot be switched on: no edges are detected, and the clock drifts",
        "update the camera's firmware",
    ),
    "clock.follows_other_camera": Phrase(
        "it follows another camera's clock", "unplug the sync cable, or wire the trigger to that camera"
    ),
    "clock.differs_from_computer": Phrase(
        "its clock and this computer's differ by {difference_s:.3g} s (limit 0.5 s)",
        "open the camera again; stop programs that set this computer's clock",
    ),
    "clock.restarted": Phrase(
        "its clock restarted {n} times: a sync cable sent a reset", "open the camera again"
    ),
}
_BOARD_CLOCK: Mapping[str, Phrase] = {
    "clock.board": Phrase(_board_clock),
    "clock.receiver": Phrase("UTC by whole seconds; no pulses"),
    "clock.board_not_tied": Phrase(
        "the board's clock is not synchronised with the computer's: no answers to time requests, no pulses",
        "check its firmware and sync.type",
    ),
    "clock.board_by_arrivals": Phrase(
        "the board answers no time requests: its clock is synchronised by arrivals only, to about 1 ms"
    ),
    "clock.computer_jumped": Phrase(
        "the computer's clock jumped {n} times, last by {last_s:+.3f} s",
        "do not set it while you collect (chrony slews, ntpdate jumps)",
    ),
    "clock.receiver_no_time": Phrase("the receiver has no time yet", "give its antenna a view of the sky"),
    "clock.receiver_not_valid": Phrase(
        "the receiver reports its time as not valid (status V)", "give its antenna a view of the sky"
    ),
    "clock.no_pps": Phrase(
        "no pulse per second: the LiDAR cannot be synchronised", "press the board's reset"
    ),
    "clock.pps_stopped": Phrase("no pulse per second for {silent_s:.0f} s", "press the board's reset"),
    "clock.board_without_utc": Phrase("the board does not know UTC yet: the LiDAR's hour is unknown"),
    "clock.pps_output_off": Phrase("its output of pulses per second is off", "press the board's reset"),
}
_PULSES: Mapping[str, Phrase] = {
    "pulses.nothing_yet": Phrase("no images and pulses yet"),
    "pulses.images_not_numbered": Phrase("its images carry no numbers: they cannot be matched to pulses"),
    "pulses.clock_not_tied": Phrase("its clock is not synchronised yet: images cannot be matched to pulses"),
    "pulses.none": Phrase("images and no pulses", "check the board's line to the computer"),
    "pulses.images_without": Phrase(
        "images without pulses", "set the camera to trigger mode, and check its line"
    ),
    "pulses.ambiguous": Phrase(
        "more than one pulse in {window_ms:.0f} ms could have triggered an image",
        "begin with slower pulses, or lower sync.triggers.{subject}.max_delay_s",
    ),
    "pulses.not_followed": Phrase("its images do not follow the pulses", "set the camera to trigger mode"),
    "pulses.board_restarted": Phrase("the board restarted its count"),
    "pulses.camera_restarted": Phrase("the camera restarted its count"),
    "pulses.image_unmatched": Phrase("{n} images match no pulse"),
    "pulses.image_lost": Phrase("{n} images lost, by the camera's numbers"),
    "pulses.message_lost": Phrase("messages of {n} pulses lost, whose images came"),
    "pulses.missed_by_camera": Phrase("{n} pulses made no image"),
    "pulses.repeated": Phrase("{n} images and pulses came twice"),
    "pulses.slip": Phrase("the camera's count slipped {n} times"),
    "pulses.restart": Phrase("the camera or the board restarted its count {n} times"),
    "pulses.slipped": Phrase(
        "its count slipped against the pulses {n_slips} times and restarted {n_restarts} times; "
        "{n_matched} images matched, {n_unmatched} not"
    ),
    "edges.none_seen": Phrase("no edges detected yet", "wire its trigger input, and switch it on"),
    "edges.too_close": Phrase(
        "its clock is uncertain by {sigma_ms:.0f} ms, too much for pulses every {period_ms:.0f} ms",
        "wire the pulse per second, or begin slower",
    ),
    "edges.not_the_pulses": Phrase("the detected edges are not the board's pulses", "check the wire"),
    "sync.boards_may_move": Phrase("boards may move while they are captured"),
    "sync.boards_must_stand": Phrase(
        "boards must stand still while they are captured",
        actions={
            "add_board": "add `sync` to the profile (docs/wiring-and-sync.md) to let boards move",
            "see_lines": "see the lines of these sensors and of the sync board",
        },
    ),
    "sync.no_board": Phrase("no sync board synchronises the cameras with the LiDAR", actions={"named": ""}),
    "sync.none_in_profile": Phrase("{key} is none", actions={"named": ""}),
    "sync.not_tied": Phrase(
        "the clock of {subject} is not synchronised with the rig's", "run `lce-rig doctor`", {"named": ""}
    ),
    "sync.too_uncertain": Phrase(
        "time of {subject}: standard deviation {sigma_ms:.1f} ms (limit {limit_ms:.1f} ms)",
        actions={"named": ""},
    ),
}
_SETTINGS: Mapping[str, Phrase] = {
    "settings.other_model": Phrase(
        "the LiDAR is a {model}, the profile says {expected}: its packets are not read",
        "correct the model in the profile",
    ),
    "settings.motor_off": Phrase("the motor is off", "switch it on (rpm 600)"),
    "settings.laser_off": Phrase("the laser is off", "switch it on"),
    "settings.rotor_rate": Phrase(
        "rotor set to {set_hz:.1f} Hz ({expected_hz:g} expected)",
        "set rpm to {expected_rpm:.0f}, or rate_hz in the profile",
    ),
    "settings.fov_cut": Phrase(
        "field of view cut to {start_deg:.0f} to {end_deg:.0f} deg", "set it to 0 to 359"
    ),
    "settings.data_port": Phrase(
        "data sent to port {port} ({expected_port} expected)", "set either of them to the other"
    ),
    "settings.position_port": Phrase(
        "telemetry sent to port {port} ({expected_port} expected): PPS is unknown",
        "set driver.controls.position_port",
    ),
    "settings.pps": Phrase("PPS is {pps}: the LiDAR's clock is not UTC", "check pulse and NMEA"),
}
PHRASES: Mapping[str, Phrase] = {
    **_DEVICE,
    **_STREAM,
    **_PACKETS,
    **_LIDAR_CLOCK,
    **_CAMERA_CLOCK,
    **_BOARD_CLOCK,
    **_PULSES,
    **_SETTINGS,
}
