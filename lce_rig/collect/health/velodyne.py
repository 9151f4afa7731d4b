"""A VLP-16: how its web page says that it is set, and whether pulses and sentences give it UTC."""

from collections.abc import Mapping

from lce_rig.collect.health.check import Check, Severity
from lce_rig.collect.health.examination import Examination
from lce_rig.collect.health.remarks import as_remedy
from lce_rig.core import velodyne
from lce_rig.core.errors import SourceError
from lce_rig.core.findings import Figure
from lce_rig.rig import LidarSettings, Rig
from lce_rig.sources.live.velodyne_web import VelodyneWeb, WebReport, find_problems
from lce_rig.words import as_line, describe, recommend

_WEB_TIMEOUT_S = 1.0
_PPS_PROBLEM = "settings.pps"


def read_web(rig: Rig, lidar: str, port: int = 80) -> WebReport | SourceError:
    """Ask the web page of a VLP-16; why it says nothing where it does not."""
    address = rig.lidars[lidar].driver.address or velodyne.FACTORY_ADDRESS
    try:
        return VelodyneWeb(address, port, _WEB_TIMEOUT_S).read()
    except SourceError as error:
        return error


def check_settings(exam: Examination, sensor: str) -> Check | None:
    """Hold what the web page says against the profile."""
    report = exam.web.get(sensor)
    if report is None:
        return None
    if isinstance(report, SourceError):
        # A sensor that sends nothing has a red line already, with all there is to check.
        if not exam.seen[sensor].has_opened:
            return None
        remedy = "Firmware and settings stay unknown. Is driver.address its own, and no firewall in the way?"
        return Check(sensor, "settings", "yellow", report.what, remedy)
    problems = [
        problem for problem in find_problems(report, exam.rig.lidars[sensor]) if problem.code != _PPS_PROBLEM
    ]
    return Check(
        sensor, "settings", "yellow" if problems else "green", _setting_words(report), as_remedy(problems)
    )


def check_pulse(exam: Examination, sensor: str) -> Check | None:
    """Say whether the sensor is locked to pulses and knows UTC, and whose time its scans are stamped with."""
    seen, report, lidar = exam.seen[sensor], exam.web.get(sensor), exam.rig.lidars[sensor]
    if seen.status is None:
        return None
    clock = seen.status.clock
    assert clock is not None  # a VLP-16 that is open has one
    figures = clock.finding.figures
    told = report.pps if isinstance(report, WebReport) and report.pps else "unknown"
    state = figures.get("pps", told)
    figure = f"{state}, {_nmea_words(figures)}"
    values = {} if clock.ahead_s is None else {"ahead_s": clock.ahead_s}
    figure += f"; {describe(clock.finding)}"
    if clock.is_utc:
        return Check(sensor, "PPS", "green", figure, values=values)
    remedy = _lost_time_remedy(recommend(clock.finding))
    return Check(sensor, "PPS", _without_lock(lidar), figure, remedy, values)


def _without_lock(lidar: LidarSettings) -> Severity:
    """Judge a clock that runs freely by what the profile promises."""
    if lidar.timestamps.clock != "utc":
        return "green"
    return "red" if lidar.timestamps.sync == "hardware" else "yellow"


def _nmea_words(figures: Mapping[str, Figure]) -> str:
    past_hour_s = figures.get("nmea_past_hour_s")
    if isinstance(past_hour_s, int):
        minute, second = divmod(past_hour_s, 60)
        fix = "" if figures.get("is_fix") else ", no fix"
        return f"NMEA {minute:02d}:{second:02d} past the hour{fix}"
    return "no NMEA" if "pps" in figures else "no position packets"


def _lost_time_remedy(remedy: str) -> str:
    otherwise = "without hardware: lidars.*.timestamps sync: none, clock: host; boards must then stand still"
    return f"{as_line(remedy)}\n{as_line(otherwise)}" if remedy else ""


def _setting_words(report: WebReport) -> str:
    rotor = None if report.rotor_hz is None else f"{60 * report.rotor_hz:.0f} rpm"
    view = None if report.fov_deg is None else f"{report.fov_deg[0]:.0f} to {report.fov_deg[1]:.0f} deg"
    port = f":{report.data_port}" if report.data_port else ""
    host = f"to {report.host}{port}" if report.host or port else None
    return ", ".join(filter(None, (rotor, report.returns, view, host)))
