"""Kinds of findings of the doctor: computer, each sensor's stream, clock, pulses and images, the board."""

from functools import partial
from textwrap import shorten

from lce_rig.core.findings import Figure, Finding, Kind

_MAX_COMMAND = 50
_EVERY_PULSE = (
    "make every pulse trigger one image: set the camera's trigger mode in driver.controls, check the line"
)

_note, _warning = partial(Kind, severity="note"), partial(Kind, severity="warning")


def _packages(finding: Finding) -> str:
    """All {n} packages are installed; OpenCV {opencv}, for a DAVIS dv-processing {dv_processing}."""
    opencv = finding.figures["opencv"] or "another build"
    davis = finding.figures["dv_processing"]
    more = f", dv-processing {davis}" if davis else ""
    return f"all {finding.figures['n']} installed; OpenCV {opencv}{more}"


def _install_packages(finding: Finding) -> str:
    """run: pip install {packages}"""
    return f"run: pip install {_spaced(finding.figures['packages'])}"


def _install_libraries(finding: Finding) -> str:
    """run: sudo apt install {packages}"""
    return f"run: sudo apt install {_spaced(finding.figures['packages'])}"


def _spaced(figure: Figure) -> str:
    assert isinstance(figure, tuple)
    return " ".join(map(str, figure))


def _answers(finding: Finding) -> str:
    """The {driver} reads {device}, firmware {firmware}, serial number {serial}, at {temperature_c}."""
    figures = finding.figures
    device = str(figures["device"] or f"answers (driver {figures['driver']})")
    parts = [shorten(device, _MAX_COMMAND, placeholder=" ...") if figures["driver"] == "command" else device]
    parts += [f"{name} {figures[name]}" for name in ("firmware", "serial") if figures.get(name)]
    if figures.get("temperature_c") is not None:
        parts.append(f"{finding.figure('temperature_c'):.0f} C")
    return ", ".join(parts)


def _expected(finding: Finding) -> str:
    is_known = finding.figures["expected_hz"] is not None
    return f" ({finding.figure('expected_hz'):g} expected)" if is_known else ""


def _rate(finding: Finding) -> str:
    """{stream} come at {rate_hz}, {expected_hz} expected."""
    return f"{finding.figure('rate_hz'):.1f} {finding.figures['stream']}/s{_expected(finding)}"


def _none(finding: Finding) -> str:
    """No {stream} come, {expected_hz} expected."""
    return f"no {finding.figures['stream']}{_expected(finding)}"


def _stopped(finding: Finding) -> str:
    """{stream} came at {rate_hz}, {expected_hz} expected, and then none for {silent_s}."""
    return f"{_rate(finding)}, none for {finding.figure('silent_s'):.1f} s"


def _events(finding: Finding) -> str:
    """{events_per_s} events come a second."""
    return f"{finding.figure('events_per_s') / 1e6:.2f} M events/s"


def _complete(finding: Finding) -> str:
    """No packet of {n_packets} and no sample is lost."""
    return f"{_received(finding)}none lost"


def _losses(finding: Finding) -> str:
    """Of {n_packets} packets {n_lost} were lost, {n_dropped} samples not read in time: {share} of all."""
    late = f", {finding.figures['n_dropped']} not read in time" if finding.figures["n_dropped"] else ""
    return f"{_received(finding)}{finding.figures['n_lost']} lost{late}"


def _received(finding: Finding) -> str:
    n_packets = finding.figures["n_packets"]
    return "" if n_packets is None else f"{n_packets} packets, "


def _settings(finding: Finding) -> str:
    """The LiDAR's page shows {rotor_hz}, returns {returns}, view {fov_deg}, data to {host} {data_port}."""
    figures, parts = finding.figures, list[str]()
    if figures["rotor_hz"] is not None:
        parts.append(f"{60 * finding.figure('rotor_hz'):.0f} rpm")
    if figures["returns"]:
        parts.append(str(figures["returns"]))
    if isinstance(figures["fov_deg"], tuple):
        parts.append(f"{' to '.join(map(str, figures['fov_deg']))} deg")
    if figures["host"] or figures["data_port"]:
        port = f":{figures['data_port']}" if figures["data_port"] else ""
        parts.append(f"to {figures['host']}{port}")
    return ", ".join(parts)


def _pulse(finding: Finding) -> str:
    """PPS is {pps}, NMEA {nmea_past_hour_s} past the hour, valid: {is_fix}."""
    pps, past_hour_s = finding.figures["pps"] or "unknown", finding.figures.get("nmea_past_hour_s")
    if past_hour_s is not None:
        minute, second = divmod(round(finding.figure("nmea_past_hour_s")), 60)
        fix = "" if finding.figures.get("is_fix") else ", no fix"
        return f"{pps}, NMEA {minute:02d}:{second:02d} past the hour{fix}"
    return f"{pps}, no NMEA" if finding.figures["has_position"] else f"{pps}, no position packets"


def _offset(finding: Finding) -> str:
    """The clock of {subject} is {offset_ms} ahead and drifts by {drift_ppm} +- {drift_sigma_ppm}."""
    offset = ""
    if finding.figures["offset_ms"] is not None:
        ms = finding.figure("offset_ms")
        offset = f" {ms / 1000:+.3g} s," if abs(ms) >= 1000 else f" {ms:+.1f} ms,"
    drift = f"{finding.figure('drift_ppm'):+.0f} +- {finding.figure('drift_sigma_ppm'):.0f} ppm"
    return f"{finding.subject}{offset} {drift}"


def _in_scan(finding: Finding) -> str:
    """The board is {distance_m} away: {n_rings} rings, {n_points} points, {n_candidates} candidates."""
    n_rings, n_points, n = (finding.figure(name) for name in ("n_rings", "n_points", "n_candidates"))
    text = f"{finding.figure('distance_m'):.2f} m away, {n_rings:.0f} rings, {n_points:.0f} points"
    return f"{text}; {n:.0f} objects of its size" if n > 1 else text


PYTHON = _note("computer.python", "Python {python}, numpy {numpy}, {system} {machine}, {n_bits} bit")
NOT_LINUX_64 = Kind(
    "computer.not_linux_64", "not 64-bit Linux", "read live sensors on 64-bit Linux; recordings work"
)
PACKAGES = _note("computer.packages", _packages)
PACKAGES_MISSING = Kind("computer.packages_missing", "missing: {packages}", _install_packages)
DV_PROCESSING_MISSING = Kind(
    "computer.dv_processing_missing",
    "missing: dv-processing, which reads the DAVIS",
    "run: pip install 'lce-rig[davis]' (Linux, Python 3.10 to 3.13)",
)
LIBRARIES = _note("computer.libraries", "{libraries}")
LIBRARIES_MISSING = _warning(
    "computer.libraries_missing",
    "missing: {libraries}; Open3D, which `lce-rig simulate` uses, does not load",
    _install_libraries,
)
DISK = _note("computer.disk", "{free_mb:.0f} MB free, {write_mbps:.0f} MB/s flushed, in {folder}")
DISK_FULL = Kind(
    "computer.disk_full", "too little space (minimum 5000 MB)", "make room, or choose another disk with -o"
)
DISK_SLOW = Kind(
    "computer.disk_slow",
    "too slow (minimum 20 MB/s)",
    "write to an SSD (-o FOLDER), and record no raw streams beside the captures",
)
DISK_NOT_WRITABLE = Kind(
    "computer.disk_not_writable",
    "{folder} cannot be written: {cause}",
    "choose another folder with -o, or make room there",
)
BUFFER = _note("computer.buffer", "{granted_kib} KiB granted: {buffer_s:.2f} s of a VLP-16's packets")
BUFFER_SMALL = _warning(
    "computer.buffer_small",
    "too small (minimum 0.25 s)",
    "run: sudo sysctl -w net.core.rmem_max={wanted_bytes}\n"
    "to keep it: echo net.core.rmem_max={wanted_bytes} | sudo tee /etc/sysctl.d/60-lidar.conf",
)
UDEV_RULES = _note("computer.udev_rules", "installed for {devices}")
UDEV_RULES_MISSING = _warning(
    "computer.udev_rules_missing",
    "none for {devices}: only root may open it",
    "run: sudo cp {rules} /etc/udev/rules.d/ && sudo udevadm control --reload\n"
    "then unplug the device and plug it in again",
)
COMPUTER_CLOCK = _note("computer.clock", "synchronised, error at most {max_error_ms:.0f} ms")
COMPUTER_CLOCK_LOOSE = _warning(
    "computer.clock_not_synchronised",
    "not synchronised, according to the kernel",
    "run: timedatectl set-ntp true, or let chrony follow the rig's GPS",
)

FAILED = Kind("sensor.failed", "{what}", "{hint}")
ANSWERS = _note("sensor.answers", _answers)
RATE = _note("stream.rate", _rate)
RATE_OFF = _warning(
    "stream.rate_off",
    _rate,
    "long exposures slow a camera down: set rate and exposure, or correct the profile",
    actions={
        "rotor": "set rpm {expected_rpm:.0f} on its web page, or rate_hz in the profile",
        "trigger": "set its trigger mode in driver.controls, and check the line",
    },
)
NO_STREAM = Kind("stream.none", _none, "check its trigger line; a triggered camera waits for pulses")
STOPPED = Kind("stream.stopped", _stopped, "check cable and power, and its trigger line")
EVENT_RATE = _note("stream.events", _events)
NO_EVENTS = Kind("stream.no_events", "no events", "uncover the lens, and check the biases in driver.controls")
COMPLETE = _note("stream.complete", _complete)
LOSSES = Kind(
    "stream.losses",
    _losses,
    "check its cable; close other programs (top shows which are busy)",
    actions={"named": ""},
)
SETTINGS_UNKNOWN = _warning(
    "settings.unknown",
    "firmware and settings unknown: {what}",
    "check that driver.address is its own, and that no firewall blocks it",
)
SETTINGS = _note("settings.read", _settings)

PULSE = _note("clock.pulse", _pulse)
WITHOUT_PULSES = _note(
    "clock.without_pulses",
    "timestamps by arrival need still boards",
    "without hardware, set lidars.*.timestamps sync: none, clock: host, and hold boards still",
)
NO_TIMESTAMPS = _note("clock.no_timestamps", "no timestamps yet")
OFFSET = _note("clock.offset", _offset)
DRIFTS = _warning(
    "clock.drifts",
    "the clock of {subject} drifts by {drift_ppm:+.0f} ppm (limit {limit_ppm:.0f} ppm)",
    "stop programs that set this computer's clock, and close other programs",
)
EDGES_FITTED = _note(
    "edges.fitted", "{n_edges} of {n_pulses} pulses, drift {drift_ppm:+.1f} ppm, scatter {rms_us:.1f} us"
)
EDGES_NOT_FITTED = Kind("edges.not_fitted", "{n_edges} edges of {n_pulses} pulses detected, clock not fitted")
LINE = _note("pulses.line", "{line} {rate_hz:.3g} Hz")
LINE_OFF = _warning(
    "pulses.line_off",
    "{line} {rate_hz:.3g} Hz ({expected_hz:g} Hz expected)",
    "check sync.triggers.{line}, reset the board",
    actions={"pps": "reset the board"},
)
LINE_NONE = Kind(
    "pulses.line_none",
    "{line} none ({expected_hz:g} Hz expected)",
    "check sync.triggers.{line}, reset the board",
    actions={"pps": ""},
)
PULSES_LOST = _note("pulses.lost", "{n} lost")
FRAMES_OF_PULSES = _note("pulses.frames", "{n_frames} images of {n_pulses} pulses")
COUNTED_ONLY = _note("pulses.counted_only", "counted only, not matched yet")
UNEQUAL = Kind("pulses.unequal", "image and pulse counts differ", _EVERY_PULSE)
NOT_MATCHED = Kind("pulses.not_matched", "not matched")
DELAY = _note("pulses.delay", "delay {delay_ms:.2f} +- {delay_scatter_ms:.2f} ms")
MISSED = Kind("pulses.missed", "{n_missed} pulses missed, count slipped {n_slips} times", _EVERY_PULSE)

GREY = _note(
    "exposure.grey", "grey {grey_1:.0f} to {grey_99:.0f}, {white_share:percent} white, edges {edge_px:.1f} px"
)
NOTHING_VISIBLE = Kind(
    "exposure.nothing_visible",
    "nothing visible",
    "take the lens cap off, and check that the cable is in the right port",
)
DARK = _warning(
    "exposure.dark",
    "underexposed ({black_share:percent} black)",
    "expose longer, open the lens, or add light",
)
BRIGHT = _warning("exposure.bright", "overexposed", "expose shorter, or turn away from the light")
BLURRED = _warning(
    "exposure.blurred", "blurred (limit {limit_px:.0f} px)", "focus the lens, clean it, and expose shorter"
)
EVENTS_FIT = _note("exposure.events", "moving edges, no flicker, hardly any hot pixels")
BOARD_IN_SCAN = _note("board.in_scan", _in_scan)
BOARD_IN_IMAGE = _note(
    "board.in_image",
    "{distance_m:.2f} m away, {n_corners:.0f} corners to {corner_rms_px:.2f} px rms, "
    "sharpness {sharpness:.1f}",
)
BOARD_IN_EVENTS = _note("board.in_events", "{distance_m:.2f} m away, detected in its events")
