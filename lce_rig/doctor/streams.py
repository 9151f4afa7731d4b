"""Checks of each sensor: its identity, the rate and completeness of its stream, the contents."""

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np

from lce_rig.core.data import join_events
from lce_rig.core.errors import SourceError
from lce_rig.core.findings import Finding, Refusal, Severity
from lce_rig.detect.events.event_limits import events_problem
from lce_rig.detect.image.quality import strongest_edge_px
from lce_rig.devices.velodyne_web import WebReport, find_problems
from lce_rig.doctor import findings
from lce_rig.doctor.examination import Examination, driver_of
from lce_rig.doctor.observing import ObservedSensor
from lce_rig.rig import Rig

_BLACK, _WHITE = 5, 250
_MAX_WHITE, _MAX_BLACK = 0.2, 0.6
_DARK_GREY, _FLAT_GREY = 50.0, 3.0
# As the finder of boards has it: edges that are wider are blurred.
_MAX_EDGE_PX = 6.0
# A rotor holds its speed within some tenths of a percent, cameras theirs within a few percent.
_MAX_OFF_RATE = 0.05
_MAX_LOST_SHARE = 0.01
_STOPPED_S = 1.0
_US_PER_S = 1e6


def check_device(exam: Examination, sensor: str) -> Iterator[Finding]:
    """Report the device that answers, or the reason of its failure."""
    seen = exam.seen[sensor]
    if seen.failure is not None:
        yield findings.FAILED(what=seen.failure.what, hint=seen.failure.hint)
        return
    assert seen.status is not None  # what neither opened nor failed is a failure of its own
    figures: dict[str, Any] = {"device": seen.status.device, "driver": driver_of(exam.rig, sensor)}
    report = exam.web.get(sensor)
    if isinstance(report, WebReport):
        figures |= {name: getattr(report, name) for name in ("firmware", "serial", "temperature_c")}
    yield findings.ANSWERS(**figures)
    yield from exam.problems(sensor, "device")


def check_settings(exam: Examination, sensor: str) -> Iterator[Finding]:
    """Compare what the web page of a VLP-16 says with the profile."""
    report = exam.web.get(sensor)
    if isinstance(report, SourceError):
        # A sensor that sends nothing has a line already, with all there is to check.
        if exam.seen[sensor].has_opened:
            yield findings.SETTINGS_UNKNOWN(what=report.what)
    elif report is not None:
        names = ("rotor_hz", "returns", "fov_deg", "host", "data_port")
        figures: dict[str, Any] = {name: getattr(report, name) for name in names}
        yield findings.SETTINGS(**figures)
        problems = find_problems(report, exam.rig.lidars[sensor])
        # The pulse has a line of its own.
        yield from (problem for problem in problems if problem.code != "settings.pps")


def check_stream(exam: Examination, sensor: str) -> Iterator[Finding]:
    """Compare a LiDAR's or camera's rates with the profile, and count what was lost."""
    seen, rig = exam.seen[sensor], exam.rig
    status = seen.status
    if status is None:
        return
    stream = "scans" if sensor in rig.lidars else "frames"
    camera = rig.cameras.get(sensor)
    kinds = {"scans"} if camera is None else {channel.kind for channel in camera.channels.values()}
    problems = exam.problems(sensor, "stream", "packet")
    if stream in kinds or seen.frames:
        rate = _rate(rig, seen, stream)
        yield rate
        if rate.code == findings.RATE_OFF.code:
            problems = [each for each in problems if each.code != "stream.rotor_rate"]  # the same once more
    if "events" in kinds and not seen.n_events:
        yield findings.NO_EVENTS()
    elif "events" in kinds:
        yield findings.EVENT_RATE(events_per_s=seen.n_events / max(seen.watched_s, 1e-9))
    counts: dict[str, Any] = {
        **status.figures,
        "watched_s": seen.watched_s,
        "n_packets": status.n_packets,
        "n_lost": status.n_lost,
        "n_dropped": status.n_dropped,
    }
    n_missing = status.n_lost + status.n_dropped
    if n_missing:
        n_came = len(seen.stamps.get(stream, ())) if status.n_packets is None else status.n_packets
        counts["share"] = share = n_missing / (max(n_came, 1) + status.n_lost)
        severity: Severity = "error" if share > _MAX_LOST_SHARE else "warning"
        yield findings.LOSSES(**counts, severity=severity, action="named" if problems else "")
    else:
        yield findings.COMPLETE(**counts)
    yield from problems


def wanted_rate_hz(rig: Rig, sensor: str) -> float | None:
    """Return how many scans or images a second the profile wants; None where it does not say."""
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


def _rate(rig: Rig, seen: ObservedSensor, stream: str) -> Finding:
    """Judge how many scans or images a second came.

    A LiDAR's rate is its rotor's speed, by its own clock: scans arrive late on a busy computer.
    """
    rate_hz = 0.0 if seen.status is None else seen.status.rates_hz.get("scans", 0.0)
    if stream != "scans" or not seen.stamps.get(stream) or rate_hz <= 0:
        _, arrivals = seen.times(stream)
        span_ns = int(arrivals[-1] - arrivals[0]) if len(arrivals) > 1 else 0
        rate_hz = 1e9 * (len(arrivals) - 1) / span_ns if span_ns > 0 else 0.0
    expected_hz = wanted_rate_hz(rig, seen.sensor)
    figures: dict[str, Any] = {"stream": stream, "rate_hz": rate_hz, "expected_hz": expected_hz}
    if rate_hz == 0:
        return findings.NO_STREAM(**figures)
    silent_s = (seen.ended_ns - seen.stamps[stream][-1][1]) * 1e-9
    if silent_s > max(_STOPPED_S, 3 / rate_hz):
        return findings.STOPPED(**figures, silent_s=silent_s)
    if expected_hz is None or abs(rate_hz / expected_hz - 1) <= _MAX_OFF_RATE:
        return findings.RATE(**figures)
    is_triggered = rig.sync is not None and seen.sensor in rig.sync.triggers
    action = "rotor" if stream == "scans" else "trigger" if is_triggered else ""
    return findings.RATE_OFF(**figures, expected_rpm=60 * expected_hz, action=action)


def check_image(exam: Examination, sensor: str) -> Iterator[Finding]:
    """Judge the exposure and sharpness of the last image."""
    images = exam.seen[sensor].images
    if not images:
        return
    grey = next(iter(images.values())).grey
    low, high = (float(value) for value in np.percentile(grey, (1, 99)))
    white, black = float(np.mean(grey >= _WHITE)), float(np.mean(grey <= _BLACK))
    edge_px = strongest_edge_px(grey, high - low)
    yield findings.GREY(grey_1=low, grey_99=high, white_share=white, black_share=black, edge_px=edge_px)
    if high - low < _FLAT_GREY:
        yield findings.NOTHING_VISIBLE()
    elif high < _DARK_GREY or black > _MAX_BLACK:
        yield findings.DARK(black_share=black)
    elif white > _MAX_WHITE:
        yield findings.BRIGHT(white_share=white)
    elif edge_px > _MAX_EDGE_PX:
        yield findings.BLURRED(limit_px=_MAX_EDGE_PX)


def check_events(exam: Examination, sensor: str) -> Iterator[Finding]:
    """Judge the last second of events: lamps that flicker, hot pixels, too few."""
    seen = exam.seen[sensor]
    if seen.events:
        events = join_events(list(seen.events))
        problem = events_problem(events, int(events.t_ns[-1]) + 1, exam.rig.quality)
        yield findings.EVENTS_FIT() if problem is None else replace(problem, severity="warning")


def check_board(exam: Examination, sensor: str) -> Iterator[Finding]:
    """Check whether the sensor sees the board now: where any channel sees it, it is there."""
    boards = [board for (name, _), board in exam.boards.items() if name == sensor]
    if boards:
        seen = next((board for board in boards if not isinstance(board, Refusal)), None)
        yield seen or replace(boards[0], severity="warning")
