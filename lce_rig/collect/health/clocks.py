"""The streams' clocks: what each is tied to, how they lie apart and drift, and whether boards may move."""

from dataclasses import replace

import numpy as np

from lce_rig.collect.health.check import Check, problems_of
from lce_rig.collect.health.examination import Examination
from lce_rig.collect.health.observing import Observation
from lce_rig.collect.health.sensors import driver_of
from lce_rig.core.data import Image, Pulse
from lce_rig.core.findings import Figure, Finding, Severity
from lce_rig.rig.sync import BOARD
from lce_rig.timing.clock import ClockModel
from lce_rig.timing.clock_fit import fit_arrivals
from lce_rig.timing.rig_clock import RigClock, edge_line

_RIG = "rig"
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
    board, line = exam.seen[BOARD], edge_line(exam.rig, sensor)
    model, problem = tie(exam).edge_clock(sensor)
    if board.host_clock is None:
        problem = Finding("clock.board_not_tied")
    n_sent = sum(pulse.sensor == line for pulse in board.pulses)
    figures: dict[str, Figure] = {"n_edges": len(exam.seen[sensor].pulses), "n_pulses": n_sent}
    if model is None:
        return Check.of(sensor, "edges", Finding("edges.not_fitted", figures=figures), problem)
    figures |= {"drift_ppm": -1e6 * model.drift, "rms_us": model.rms_ns / 1000}
    return Check.of(sensor, "edges", Finding("edges.fitted", "note", figures=figures))


def check_offsets(exam: Examination) -> Check | None:
    """Measure every stream's offset and drift against this computer's clock, by when its samples arrive."""
    offsets, strays = list[Finding](), list[Finding]()
    for sensor, seen in exam.seen.items():
        model = seen.host_clock if sensor == BOARD else _by_arrivals(exam, seen)
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
    is_empty = all(found.subject == BOARD for found in offsets)  # the board's own line says as much
    return None if is_empty else Check.of(_RIG, "clocks", *offsets, *strays)


def check_sync(exam: Examination) -> Check | None:
    """Judge whether boards may move while they are captured; absent sensors are left out of it."""
    rig, verdict = exam.rig, tie(exam).verdict()
    absent = [sensor for sensor, seen in exam.seen.items() if not seen.has_opened]
    if not verdict.requires_still_boards:
        return None if absent else Check.of(_RIG, "sync", verdict.finding)
    reasons = [each for each in verdict.reasons if each.code != "sync.not_tied" or each.subject not in absent]
    if not reasons:
        return None
    is_promised = any(sync != "none" for sync in _promises(exam))
    severity: Severity = "warning" if is_promised else "note"
    action = ("add_board" if rig.sync is None else "see_lines") if is_promised else ""
    judged = replace(verdict.finding, severity=severity, action=action)
    named = [replace(reason, severity=severity, action="named") for reason in reasons]
    return Check.of(_RIG, "sync", judged, *named)


def tie(exam: Examination) -> RigClock:
    """Put every sensor that can be onto the rig's clock, as `collect` does with the same samples."""
    board = exam.seen.get(BOARD)
    has_board = board is not None and board.status is not None
    cameras = [name for name in exam.rig.cameras if driver_of(exam.rig, name) == "davis"]
    clock = RigClock(exam.rig, has_board=has_board, edge_cameras=cameras)
    models = (None, None) if board is None else (board.host_clock, board.utc_clock)
    locked = [name for name, seen in exam.seen.items() if _is_utc(seen)]
    clock.refresh(*models, locked)
    came: list[tuple[str, Pulse | Image]] = []
    for name, seen in exam.seen.items():
        came += [(name, pulse) for pulse in seen.pulses] + [(name, image) for image in seen.frames]
    for name, sample in sorted(came, key=lambda pair: pair[1].host_ns or 0):
        clock.take(name, sample)
    clock.refresh(*models, locked)
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
    board, seen = exam.seen.get(BOARD), exam.seen[sensor]
    is_davis = driver_of(exam.rig, sensor) == "davis"
    return is_davis and seen.status is not None and board is not None and board.status is not None


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
    if seen.sensor == BOARD:
        return None
    if "scans" in seen.stamps:
        clock = seen.status.clock
        return None if clock is None or clock.ahead_s is None else 1000 * clock.ahead_s
    return (model.anchor_ns - model.reference_ns) * 1e-6
