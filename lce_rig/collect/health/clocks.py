"""The streams' clocks: what each is tied to, how they lie apart and drift, and whether boards may move."""

from dataclasses import replace

import numpy as np

from lce_rig.collect.edge_clock import EdgeClock
from lce_rig.collect.health.check import Check, problems_of
from lce_rig.collect.health.examination import Examination
from lce_rig.collect.health.observing import Observation
from lce_rig.collect.health.sensors import SYNC, driver_of
from lce_rig.collect.sync import CommonClock, judge_sync
from lce_rig.core.clock import ClockModel
from lce_rig.core.clock_fit import fit_arrivals
from lce_rig.core.findings import Figure, Finding, Severity

_RIG = "rig"
_PPS_LINE = "pps"
# A locked VLP-16 counts whole microseconds.
_LOCKED_SIGMA_NS = 1_000.0
# A DAVIS takes the computer's time when it is opened; as `collect` has it.
_COARSE_EDGE_NS = 100_000_000.0
_MAX_DRIFT_PPM = 200.0
_STREAMS = ("scans", "events", "frames")


def check_clock(exam: Examination, sensor: str) -> Check | None:
    """Say what a camera's or sync board's stamps are tied to."""
    status = exam.seen[sensor].status
    if status is None:
        return None
    state = Finding("clock.no_timestamps", "note") if status.clock is None else status.clock.finding
    return Check.of(sensor, "clock", state, *problems_of(status, "clock"))


def check_edges(exam: Examination, sensor: str) -> Check | None:
    """Fit the clock of a camera that sees the board's pulses to them."""
    if not _sees_edges(exam, sensor):
        return None
    model, problem, n_sent = _fit_edges(exam, sensor)
    figures: dict[str, Figure] = {"n_edges": len(exam.seen[sensor].pulses), "n_pulses": n_sent}
    if model is None:
        return Check.of(sensor, "edges", Finding("edges.not_fitted", figures=figures), problem)
    figures |= {"drift_ppm": -1e6 * model.drift, "rms_us": model.rms_ns / 1000}
    return Check.of(sensor, "edges", Finding("edges.fitted", "note", figures=figures))


def check_offsets(exam: Examination) -> Check | None:
    """Measure every stream's offset and drift against this computer's clock, by when its samples arrive."""
    offsets, strays = list[Finding](), list[Finding]()
    for sensor, seen in exam.seen.items():
        model = seen.host_clock if sensor == SYNC else _by_arrivals(exam, seen)
        if model is None:
            continue
        # The model has the computer's time on the sensor's clock: its drift is the other way round.
        drift_ppm, sigma_ppm = -1e6 * model.drift, 1e6 * float(np.sqrt(model.cov[1, 1]))
        figures = {
            "offset_ms": _offset_ms(seen, model),
            "drift_ppm": drift_ppm,
            "drift_sigma_ppm": max(sigma_ppm, 1),
        }
        offsets.append(Finding("clock.offset", "note", sensor, figures))
        if abs(drift_ppm) > _MAX_DRIFT_PPM + 3 * sigma_ppm:
            limit = {"drift_ppm": drift_ppm, "limit_ppm": _MAX_DRIFT_PPM}
            strays.append(Finding("clock.drifts", "warning", sensor, limit))
    is_empty = all(found.subject == SYNC for found in offsets)  # the board's own line says as much
    return None if is_empty else Check.of(_RIG, "clocks", *offsets, *strays)


def check_sync(exam: Examination) -> Check | None:
    """Judge whether boards may move while they are captured; absent sensors are left out of it."""
    rig, verdict = exam.rig, judge_sync(exam.rig, tie(exam))
    if not verdict.requires_still_boards:
        return Check.of(_RIG, "sync", verdict.finding)
    absent = [sensor for sensor, seen in exam.seen.items() if not seen.has_opened]
    reasons = [each for each in verdict.reasons if each.code != "sync.not_tied" or each.subject not in absent]
    if not reasons:
        return None
    is_promised = any(sync != "none" for sync in _promises(exam))
    severity: Severity = "warning" if is_promised else "note"
    action = ("add_board" if rig.sync is None else "see_lines") if is_promised else ""
    judged = replace(verdict.finding, severity=severity, action=action)
    named = [replace(reason, severity=severity, action="named") for reason in reasons]
    return Check.of(_RIG, "sync", judged, *named)


def tie(exam: Examination) -> CommonClock:
    """Put every sensor that can be onto the rig's clock: UTC as the sync board or this computer has it."""
    clock, board = CommonClock(), exam.seen.get(SYNC)
    host = None
    if board is not None and board.host_clock is not None and board.utc_clock is not None:
        host = board.host_clock.inverse().then(board.utc_clock)
    for sensor, seen in exam.seen.items():
        if seen.status is None or sensor == SYNC:
            continue
        model = host
        if _is_utc(seen):
            model = ClockModel.identity(_LOCKED_SIGMA_NS, "UTC by PPS and NMEA")
        elif _sees_edges(exam, sensor):
            fitted, _, _ = _fit_edges(exam, sensor)
            utc = None if board is None else board.utc_clock
            model = None if fitted is None or utc is None else fitted.then(utc)
        if model is not None:
            clock.tie(sensor, model)
    return clock


def _is_utc(seen: Observation) -> bool:
    return seen.status is not None and seen.status.clock is not None and seen.status.clock.is_utc


def _promises(exam: Examination) -> list[str]:
    """List how the profile says that clocks are tied, stream by stream."""
    found: list[str] = [lidar.timestamps.sync for lidar in exam.rig.lidars.values()]
    for camera in exam.rig.cameras.values():
        found += [channel.timestamps.sync for channel in camera.channels.values()]
    return found


def _sees_edges(exam: Examination, sensor: str) -> bool:
    board, seen = exam.seen.get(SYNC), exam.seen[sensor]
    is_davis = driver_of(exam.rig, sensor) == "davis"
    return is_davis and seen.status is not None and board is not None and board.status is not None


def _fit_edges(exam: Examination, sensor: str) -> tuple[ClockModel | None, Finding | None, int]:
    """Fit the board's time on a sensor's clock; gives why not as well, and how many pulses were sent."""
    board, seen = exam.seen[SYNC], exam.seen[sensor]
    assert exam.rig.sync is not None
    line = sensor if sensor in exam.rig.sync.triggers else _PPS_LINE
    sent = [pulse for pulse in board.pulses if pulse.sensor == line]
    edges = EdgeClock(sensor, _COARSE_EDGE_NS)
    if board.host_clock is None:
        return None, Finding("clock.board_not_tied"), len(sent)
    edges.set_clock(board.host_clock.inverse())
    for pulse in sent:
        edges.take_sent(pulse)
    for pulse in seen.pulses:
        edges.take_seen(pulse)
    return edges.fit(), edges.problem, len(sent)


def _by_arrivals(exam: Examination, seen: Observation) -> ClockModel | None:
    """Fit this computer's time on a sensor's clock; None of stamps that are arrivals themselves."""
    stream = next((name for name in _STREAMS if name in seen.stamps), None)
    if stream is None or seen.status is None or driver_of(exam.rig, seen.sensor) == "command":
        return None
    if stream == "scans" and not _is_utc(seen):
        return None
    stamps, arrivals = seen.times(stream)
    # A LiDAR's first scans may be stamped by arrival yet, until its position packets have come.
    steps_back = np.flatnonzero(np.diff(stamps) <= 0)
    first = int(steps_back[-1]) + 1 if len(steps_back) else 0
    return fit_arrivals(stamps[first:], arrivals[first:], "arrivals")


def _offset_ms(seen: Observation, model: ClockModel) -> float | None:
    """Give by how much stamps are ahead of this computer's clock; what samples take to arrive is in it.

    A LiDAR's scan arrives a revolution after its stamp, which its driver has taken off; None for a board,
    whose clock counts from when it was switched on.
    """
    assert seen.status is not None
    if seen.sensor == SYNC:
        return None
    if "scans" in seen.stamps:
        clock = seen.status.clock
        return None if clock is None or clock.ahead_s is None else 1000 * clock.ahead_s
    return (model.anchor_ns - model.reference_ns) * 1e-6
