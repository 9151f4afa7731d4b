"""Phrases of the doctor: computer, profile, each sensor's stream, clock, pulses and images, the board."""

from collections.abc import Mapping
from textwrap import shorten

from lce_rig.core.findings import Figure, Finding
from lce_rig.words.rendering import Phrase

_MAX_COMMAND = 50
_EVERY_PULSE = (
    "make every pulse trigger one image: set the camera's trigger mode in driver.controls, check the line"
)


def _listed(figure: Figure, separator: str = ", ") -> str:
    assert isinstance(figure, tuple)
    return separator.join(str(each) for each in figure)


def _packages(finding: Finding) -> str:
    """All {n} packages are installed; OpenCV {opencv}, for a DAVIS dv-processing {dv_processing}."""
    opencv = finding.figures["opencv"] or "another build"
    davis = finding.figures["dv_processing"]
    more = f", dv-processing {davis}" if davis else ""
    return f"all {finding.figures['n']} installed; OpenCV {opencv}{more}"


def _packages_missing(finding: Finding) -> str:
    """The packages {packages} are missing."""
    return f"missing: {_listed(finding.figures['packages'])}"


def _install_packages(finding: Finding) -> str:
    """run: pip install {packages}"""
    return f"run: pip install {_listed(finding.figures['packages'], ' ')}"


def _libraries(finding: Finding) -> str:
    """The system libraries {libraries} load."""
    return _listed(finding.figures["libraries"])


def _libraries_missing(finding: Finding) -> str:
    """The system libraries {libraries} are missing; Open3D, which `lce-rig simulate` uses, does not load."""
    missing = _listed(finding.figures["libraries"])
    return f"missing: {missing}; Open3D, which `lce-rig simulate` uses, does not load"


def _install_libraries(finding: Finding) -> str:
    """run: sudo apt install {packages}"""
    return f"run: sudo apt install {_listed(finding.figures['packages'], ' ')}"


def _udev_rules(finding: Finding) -> str:
    """Rules for {devices} are installed."""
    return f"installed for {_listed(finding.figures['devices'])}"


def _udev_rules_missing(finding: Finding) -> str:
    """No rule for {devices}: only root may open it."""
    return f"none for {_listed(finding.figures['devices'])}: only root may open it"


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
    known = finding.figures["expected_hz"] is not None
    return f" ({finding.figure('expected_hz'):g} expected)" if known else ""


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


def _received(finding: Finding) -> str:
    n_packets = finding.figures["n_packets"]
    return "" if n_packets is None else f"{n_packets} packets, "


def _complete(finding: Finding) -> str:
    """No packet of {n_packets} and no sample is lost."""
    return f"{_received(finding)}none lost"


def _losses(finding: Finding) -> str:
    """Of {n_packets} packets {n_lost} were lost, {n_dropped} samples not read in time: {share} of all."""
    late = f", {finding.figures['n_dropped']} not read in time" if finding.figures["n_dropped"] else ""
    return f"{_received(finding)}{finding.figures['n_lost']} lost{late}"


def _settings(finding: Finding) -> str:
    """The LiDAR's page shows {rotor_hz}, returns {returns}, view {fov_deg}, data to {host} {data_port}."""
    figures, parts = finding.figures, list[str]()
    if figures["rotor_hz"] is not None:
        parts.append(f"{60 * finding.figure('rotor_hz'):.0f} rpm")
    if figures["returns"]:
        parts.append(str(figures["returns"]))
    if isinstance(figures["fov_deg"], tuple):
        parts.append(f"{_listed(figures['fov_deg'], ' to ')} deg")
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


_COMPUTER: Mapping[str, Phrase] = {
    "computer.python": Phrase("Python {python}, numpy {numpy}, {system} {machine}, {n_bits} bit"),
    "computer.not_linux_64": Phrase("not 64-bit Linux", "read live sensors on 64-bit Linux; recordings work"),
    "computer.packages": Phrase(_packages),
    "computer.packages_missing": Phrase(_packages_missing, _install_packages),
    "computer.dv_processing_missing": Phrase(
        "missing: dv-processing, which reads the DAVIS",
        "run: pip install 'lce-rig[davis]' (Linux, Python 3.10 to 3.13)",
    ),
    "computer.libraries": Phrase(_libraries),
    "computer.libraries_missing": Phrase(_libraries_missing, _install_libraries),
    "computer.disk": Phrase("{free_mb:.0f} MB free, {write_mbps:.0f} MB/s flushed, in {folder}"),
    "computer.disk_full": Phrase(
        "too little space (minimum 5000 MB)", "make room, or choose another disk with -o"
    ),
    "computer.disk_slow": Phrase(
        "too slow (minimum 20 MB/s)",
        "write to an SSD (-o FOLDER), and record no raw streams beside the captures",
    ),
    "computer.disk_not_writable": Phrase(
        "{folder} cannot be written: {cause}", "choose another folder with -o, or make room there"
    ),
    "computer.buffer": Phrase("{granted_kib} KiB granted: {buffer_s:.2f} s of a VLP-16's packets"),
    "computer.buffer_small": Phrase(
        "too small (minimum 0.25 s)",
        "run: sudo sysctl -w net.core.rmem_max={wanted_bytes}\n"
        "to keep it: echo net.core.rmem_max={wanted_bytes} | sudo tee /etc/sysctl.d/60-lidar.conf",
    ),
    "computer.udev_rules": Phrase(_udev_rules),
    "computer.udev_rules_missing": Phrase(
        _udev_rules_missing,
        "run: sudo cp {rules} /etc/udev/rules.d/ && sudo udevadm control --reload\n"
        "then unplug the device and plug it in again",
    ),
    "computer.clock": Phrase("synchronised, error at most {max_error_ms:.0f} ms"),
    "computer.clock_not_synchronised": Phrase(
        "not synchronised, according to the kernel",
        "run: timedatectl set-ntp true, or let chrony follow the rig's GPS",
    ),
}
_SENSORS: Mapping[str, Phrase] = {
    "sensor.failed": Phrase("{what}", "{hint}"),
    "sensor.answers": Phrase(_answers),
    "stream.rate": Phrase(_rate),
    "stream.rate_off": Phrase(
        _rate,
        "long exposures slow a camera down: set rate and exposure, or correct the profile",
        {
            "rotor": "set rpm {expected_rpm:.0f} on its web page, or rate_hz in the profile",
            "trigger": "set its trigger mode in driver.controls, and check the line",
        },
    ),
    "stream.none": Phrase(_none, "check its trigger line; a triggered camera waits for pulses"),
    "stream.stopped": Phrase(_stopped, "check cable and power, and its trigger line"),
    "stream.events": Phrase(_events),
    "stream.no_events": Phrase("no events", "uncover the lens, and check the biases in driver.controls"),
    "stream.complete": Phrase(_complete),
    "stream.losses": Phrase(
        _losses, "check its cable; close other programs (top shows which are busy)", {"named": ""}
    ),
    "settings.unknown": Phrase(
        "firmware and settings unknown: {what}",
        "check that driver.address is its own, and that no firewall blocks it",
    ),
    "settings.read": Phrase(_settings),
}
_CLOCKS: Mapping[str, Phrase] = {
    "clock.pulse": Phrase(_pulse),
    "clock.without_pulses": Phrase(
        "timestamps by arrival need still boards",
        "without hardware, set lidars.*.timestamps sync: none, clock: host, and hold boards still",
    ),
    "clock.no_timestamps": Phrase("no timestamps yet"),
    "clock.offset": Phrase(_offset),
    "clock.drifts": Phrase(
        "the clock of {subject} drifts by {drift_ppm:+.0f} ppm (limit {limit_ppm:.0f} ppm)",
        "stop programs that set this computer's clock, and close other programs",
    ),
    "edges.fitted": Phrase(
        "{n_edges} of {n_pulses} pulses, drift {drift_ppm:+.1f} ppm, scatter {rms_us:.1f} us"
    ),
    "edges.not_fitted": Phrase("{n_edges} edges of {n_pulses} pulses detected, clock not fitted"),
    "pulses.line": Phrase("{line} {rate_hz:.3g} Hz"),
    "pulses.line_off": Phrase(
        "{line} {rate_hz:.3g} Hz ({expected_hz:g} Hz expected)",
        "check sync.triggers.{line}, reset the board",
        {"pps": "reset the board"},
    ),
    "pulses.line_none": Phrase(
        "{line} none ({expected_hz:g} Hz expected)",
        "check sync.triggers.{line}, reset the board",
        {"pps": ""},
    ),
    "pulses.lost": Phrase("{n} lost"),
    "pulses.frames": Phrase("{n_frames} images of {n_pulses} pulses"),
    "pulses.counted_only": Phrase("counted only, not matched yet"),
    "pulses.unequal": Phrase("image and pulse counts differ", _EVERY_PULSE),
    "pulses.not_matched": Phrase("not matched"),
    "pulses.delay": Phrase("delay {delay_ms:.2f} +- {delay_scatter_ms:.2f} ms"),
    "pulses.missed": Phrase("{n_missed} pulses missed, count slipped {n_slips} times", _EVERY_PULSE),
}
_IMAGES: Mapping[str, Phrase] = {
    "exposure.grey": Phrase(
        "grey {grey_1:.0f} to {grey_99:.0f}, {white_share:percent} white, edges {edge_px:.1f} px"
    ),
    "exposure.nothing_visible": Phrase(
        "nothing visible", "take the lens cap off, and check that the cable is in the right port"
    ),
    "exposure.dark": Phrase(
        "underexposed ({black_share:percent} black)", "expose longer, open the lens, or add light"
    ),
    "exposure.bright": Phrase("overexposed", "expose shorter, or turn away from the light"),
    "exposure.blurred": Phrase(
        "blurred (limit {limit_px:.0f} px)", "focus the lens, clean it, and expose shorter"
    ),
    "exposure.events": Phrase("moving edges, no flicker, hardly any hot pixels"),
    "board.in_scan": Phrase(_in_scan),
    "board.in_image": Phrase(
        "{distance_m:.2f} m away, {n_corners:.0f} corners to {corner_rms_px:.2f} px rms, "
        "sharpness {sharpness:.1f}"
    ),
    "board.in_events": Phrase("{distance_m:.2f} m away, detected in its events"),
}
_PROFILE: Mapping[str, Phrase] = {
    "profile.swapped_sides": Phrase(
        "{subject}: {n_cols}x{n_rows} inner corners run along the shorter side of the plate "
        "{width_m:g} x {height_m:g} m",
        "check whether to swap width_m and height_m, or the inner_corners",
    ),
    "profile.drifting_clock": Phrase(
        "{subject}: the sensor's own clock without sync drifts away from the others",
    ),
    "profile.unknown_model": Phrase(
        "{subject}: the beams of {value} are not known: recordings can be calibrated, live guidance and "
        "simulation need elevations_deg and columns",
        "enter them and your LiDAR's noise (docs/rig-profiles.md: LiDAR models), or make a new profile with "
        "`lce-rig rigs new --lidar other --from RECORDING`",
    ),
    "profile.other_driver": Phrase(
        "{subject}: {value} reads Velodynes, and the model is {model}",
        "remove the driver block, or correct the model",
    ),
    "profile.unknown_driver": Phrase("{subject}: there is no driver {value}", "choose one of: {known}"),
    "profile.shared": Phrase("{subject}: {value} equals {other}, but two sensors cannot share it"),
}
PHRASES: Mapping[str, Phrase] = {**_COMPUTER, **_SENSORS, **_CLOCKS, **_IMAGES, **_PROFILE}
