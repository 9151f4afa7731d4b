"""A VLP-16: how its web page says that it is set, and whether pulses and sentences give it UTC."""

from dataclasses import replace

from lce_rig.collect.health.check import Check
from lce_rig.collect.health.examination import Examination
from lce_rig.core import velodyne
from lce_rig.core.errors import SourceError
from lce_rig.core.findings import Figure, Finding, Severity
from lce_rig.rig import Rig
from lce_rig.sources.live.velodyne_web import VelodyneWeb, WebReport, find_problems

_WEB_TIMEOUT_S = 1.0


def read_web(rig: Rig, lidar: str, port: int = 80) -> WebReport | SourceError:
    """Ask the web page of a VLP-16; why it says nothing where it does not."""
    address = rig.lidars[lidar].driver.address or velodyne.FACTORY_ADDRESS
    try:
        return VelodyneWeb(address, port, _WEB_TIMEOUT_S).read()
    except SourceError as error:
        return error


def check_settings(exam: Examination, sensor: str) -> Check | None:
    """Compare what the web page says with the profile."""
    report = exam.web.get(sensor)
    if report is None:
        return None
    if isinstance(report, SourceError):
        # A sensor that sends nothing has a line already, with all there is to check.
        if not exam.seen[sensor].has_opened:
            return None
        unknown = Finding("settings.unknown", "warning", figures={"what": report.what})
        return Check.of(sensor, "settings", unknown)
    problems = find_problems(report, exam.rig.lidars[sensor])
    # The pulse has a line of its own.
    others = [problem for problem in problems if problem.code != "settings.pps"]
    figures: dict[str, Figure] = {
        "rotor_hz": report.rotor_hz,
        "returns": report.returns,
        "fov_deg": report.fov_deg,
        "host": report.host,
        "data_port": report.data_port,
    }
    return Check.of(sensor, "settings", Finding("settings.read", "note", figures=figures), *others)


def check_pulse(exam: Examination, sensor: str) -> Check | None:
    """Say whether the sensor is locked to pulses and knows UTC, and whose time its scans are stamped with."""
    seen, report, lidar = exam.seen[sensor], exam.web.get(sensor), exam.rig.lidars[sensor]
    if seen.status is None or seen.status.clock is None:
        return None
    clock = seen.status.clock
    told = report.pps if isinstance(report, WebReport) and report.pps else None
    figures: dict[str, Figure] = {"pps": told, "has_position": "pps" in clock.finding.figures}
    pulse = Finding("clock.pulse", "note", figures=figures | dict(clock.finding.figures))
    if clock.is_utc or lidar.timestamps.clock != "utc":
        return Check.of(sensor, "PPS", pulse, replace(clock.finding, severity="note"))
    severity: Severity = "error" if lidar.timestamps.sync == "hardware" else "warning"
    way_out = Finding("clock.without_pulses", "note")
    return Check.of(sensor, "PPS", pulse, replace(clock.finding, severity=severity), way_out)
