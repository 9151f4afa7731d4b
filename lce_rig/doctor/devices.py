"""Each sensor: whether it answers and what it is, and whether its stream comes whole and at its rate."""

from dataclasses import replace

import numpy as np

from lce_rig.core import velodyne
from lce_rig.core.data import join_events
from lce_rig.core.errors import SourceError
from lce_rig.core.findings import Figure, Finding, Refusal, Severity
from lce_rig.detect.events.event_limits import events_problem
from lce_rig.detect.image.quality import strongest_edge_px
from lce_rig.devices.velodyne_web import VelodyneWeb, WebReport, find_problems
from lce_rig.doctor.line import Check, problems_of
from lce_rig.doctor.observing import ObservedSensor, SensorReport
from lce_rig.doctor.sensor_sources import driver_of
from lce_rig.rig import Rig

# A VLP-16: how its web page says that it is set, and whether pulses and sentences give it UTC.

_WEB_TIMEOUT_S = 1.0


def read_web(rig: Rig, lidar: str, port: int = 80) -> WebReport | SourceError:
    """Ask the web page of a VLP-16; why it says nothing where it does not."""
    address = rig.lidars[lidar].driver.address or velodyne.FACTORY_ADDRESS
    try:
        return VelodyneWeb(address, port, _WEB_TIMEOUT_S).read()
    except SourceError as error:
        return error


def check_settings(exam: SensorReport, sensor: str) -> Check | None:
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


def check_pulse(exam: SensorReport, sensor: str) -> Check | None:
    """Check whether the sensor is locked to pulses and knows UTC, and which clock its scans carry."""
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


# What a camera's images and events are like, and the board in them and in a LiDAR's scans.

_BLACK, _WHITE = 5, 250
_MAX_WHITE, _MAX_BLACK = 0.2, 0.6
_DARK_GREY, _FLAT_GREY = 50.0, 3.0
# As the finder of boards has it: edges that are wider are blurred.
_MAX_EDGE_PX = 6.0


def check_image(exam: SensorReport, sensor: str) -> Check | None:
    """Judge the exposure and sharpness of the last image."""
    images = exam.seen[sensor].images
    if not images:
        return None
    grey = next(iter(images.values())).grey
    low, high = (float(value) for value in np.percentile(grey, (1, 99)))
    white, black = float(np.mean(grey >= _WHITE)), float(np.mean(grey <= _BLACK))
    edge_px = strongest_edge_px(grey, high - low)
    figures = {"grey_1": low, "grey_99": high, "white_share": white, "black_share": black, "edge_px": edge_px}
    wrong = None
    if high - low < _FLAT_GREY:
        wrong = Finding("exposure.nothing_visible")
    elif high < _DARK_GREY or black > _MAX_BLACK:
        wrong = Finding("exposure.dark", "warning", figures={"black_share": black})
    elif white > _MAX_WHITE:
        wrong = Finding("exposure.bright", "warning", figures={"white_share": white})
    elif edge_px > _MAX_EDGE_PX:
        wrong = Finding("exposure.blurred", "warning", figures={"limit_px": _MAX_EDGE_PX})
    return Check.of(sensor, "picture", Finding("exposure.grey", "note", figures=figures), wrong)


def check_events(exam: SensorReport, sensor: str) -> Check | None:
    """Judge the last second of events: lamps that flicker, hot pixels, too few."""
    seen = exam.seen[sensor]
    if not seen.events:
        return None
    events = join_events(list(seen.events))
    problem = events_problem(events, int(events.t_ns[-1]) + 1, exam.rig.quality)
    found = Finding("exposure.events", "note") if problem is None else replace(problem, severity="warning")
    return Check.of(sensor, "events", found)


def check_board(exam: SensorReport, sensor: str) -> Check | None:
    """Check whether the sensor sees the board now."""
    found = [board for (name, _), board in exam.boards.items() if name == sensor]
    if not found:
        return None
    # Where any channel sees it, it is there.
    seen = next((board for board in found if not isinstance(board, Refusal)), None)
    return Check.of(sensor, "board", seen or replace(found[0], severity="warning"))


# A rotor holds its speed within some tenths of a percent, cameras theirs within a few percent.
_MAX_OFF_RATE = 0.05
_MAX_LOST_SHARE = 0.01
_STOPPED_S = 1.0
_US_PER_S = 1e6


def check_device(exam: SensorReport, sensor: str) -> Check:
    """Say what answers, or why nothing does."""
    seen = exam.seen[sensor]
    if seen.failure is not None:
        figures = {"what": seen.failure.what, "hint": seen.failure.hint}
        return Check.of(sensor, "device", Finding("sensor.failed", figures=figures))
    assert seen.status is not None  # what neither opened nor failed is a failure of its own
    found: dict[str, Figure] = {"device": seen.status.device, "driver": driver_of(exam.rig, sensor)}
    report = exam.web.get(sensor)
    if isinstance(report, WebReport):
        found |= {
            "firmware": report.firmware,
            "serial": report.serial,
            "temperature_c": report.temperature_c,
        }
    answers = Finding("sensor.answers", "note", figures=found)
    return Check.of(sensor, "device", answers, *problems_of(seen.status, "device"))


def check_stream(exam: SensorReport, sensor: str) -> Check | None:
    """Compare a LiDAR's or camera's rates with the profile, and count what was lost."""
    seen, rig = exam.seen[sensor], exam.rig
    if seen.status is None:
        return None
    stream = "scans" if sensor in rig.lidars else "frames"
    camera = rig.cameras.get(sensor)
    kinds = {"scans"} if camera is None else {channel.kind for channel in camera.channels.values()}
    rate = _rate(rig, seen, stream) if stream in kinds or seen.frames else None
    problems = problems_of(seen.status, "stream")
    if rate is not None and rate.code == "stream.rate_off":
        problems = [each for each in problems if each.code != "stream.rotor_rate"]  # the same once more
    events = _event_rate(seen) if "events" in kinds else None
    losses = _losses(seen, len(seen.stamps.get(stream, ())), has_named_cause=bool(problems))
    return Check.of(sensor, "stream", rate, events, losses, *problems)


def wanted_rate_hz(rig: Rig, sensor: str) -> float | None:
    """Give how many scans or images a second the profile wants; None where it does not say."""
    if sensor in rig.lidars:
        return rig.lidars[sensor].rate_hz
    driver = rig.cameras[sensor].driver
    # Pulses cannot trigger a DAVIS, which keeps an interval of its own.
    if driver_of(rig, sensor) == "davis":
        interval_us = driver.controls.get("frame_interval_us", 0)
        return _US_PER_S / interval_us if isinstance(interval_us, int | float) and interval_us > 0 else None
    if rig.sync is not None and sensor in rig.sync.triggers:
        return rig.sync.triggers[sensor].rate_hz
    return driver.frame_rate_hz


def rate_hz(seen: ObservedSensor, stream: str) -> float:
    """Measure how many a second came; 0 where fewer than two did.

    A LiDAR's is its rotor's speed, by its own clock: scans arrive late on a busy computer.
    """
    rotor_hz = 0.0 if seen.status is None else seen.status.rates_hz.get("scans", 0.0)
    if stream == "scans" and seen.stamps.get(stream) and rotor_hz > 0:
        return rotor_hz
    _, arrivals = seen.times(stream)
    span_ns = int(arrivals[-1] - arrivals[0]) if len(arrivals) > 1 else 0
    return 1e9 * (len(arrivals) - 1) / span_ns if span_ns > 0 else 0.0


def _rate(rig: Rig, seen: ObservedSensor, stream: str) -> Finding:
    now_hz, expected_hz = rate_hz(seen, stream), wanted_rate_hz(rig, seen.sensor)
    figures: dict[str, Figure] = {"stream": stream, "rate_hz": now_hz, "expected_hz": expected_hz}
    if now_hz == 0:
        return Finding("stream.none", figures=figures)
    silent_s = (seen.ended_ns - seen.stamps[stream][-1][1]) * 1e-9
    if silent_s > max(_STOPPED_S, 3 / now_hz):
        return Finding("stream.stopped", figures=figures | {"silent_s": silent_s})
    if expected_hz is None or abs(now_hz / expected_hz - 1) <= _MAX_OFF_RATE:
        return Finding("stream.rate", "note", figures=figures)
    figures["expected_rpm"] = 60 * expected_hz
    is_triggered = rig.sync is not None and seen.sensor in rig.sync.triggers
    action = "rotor" if stream == "scans" else "trigger" if is_triggered else ""
    return Finding("stream.rate_off", "warning", figures=figures, action=action)


def _event_rate(seen: ObservedSensor) -> Finding:
    if not seen.n_events:
        return Finding("stream.no_events")
    figures = {"events_per_s": seen.n_events / max(seen.watched_s, 1e-9)}
    return Finding("stream.events", "note", figures=figures)


def _losses(seen: ObservedSensor, n_came: int, *, has_named_cause: bool) -> Finding:
    """Count what was lost on the way and by this computer."""
    status = seen.status
    assert status is not None
    counts: dict[str, Figure] = {
        **status.figures,
        "watched_s": seen.watched_s,
        "n_packets": status.n_packets,
        "n_lost": status.n_lost,
        "n_dropped": status.n_dropped,
    }
    n_missing = status.n_lost + status.n_dropped
    if not n_missing:
        return Finding("stream.complete", "note", figures=counts)
    n_all = max(n_came if status.n_packets is None else status.n_packets, 1)
    counts["share"] = share = n_missing / (n_all + status.n_lost)
    severity: Severity = "error" if share > _MAX_LOST_SHARE else "warning"
    return Finding("stream.losses", severity, figures=counts, action="named" if has_named_cause else "")
