"""The streams' clocks: what each is tied to, how they lie apart and drift, and whether boards may move."""

import numpy as np

from lce_rig.collect.health.check import Check, Severity
from lce_rig.collect.health.examination import Examination
from lce_rig.collect.health.observing import Observation
from lce_rig.collect.health.remarks import as_remedy, remarks
from lce_rig.collect.health.sensors import driver_of
from lce_rig.core.data import Image, Pulse
from lce_rig.core.findings import Finding
from lce_rig.rig.sync import BOARD
from lce_rig.timing.clock import ClockModel
from lce_rig.timing.clock_fit import fit_arrivals
from lce_rig.timing.rig_clock import RigClock, edge_line
from lce_rig.words import as_line, describe

_RIG = "rig"
_MAX_DRIFT_PPM = 200.0
_STREAMS = ("scans", "events", "frames")


def check_clock(exam: Examination, sensor: str) -> Check | None:
    """Say what a camera's or sync board's stamps are tied to."""
    status = exam.seen[sensor].status
    if status is None:
        return None
    problems = remarks(status, "clock")
    figure, figures = (
        "no stamps yet" if status.clock is None else describe(status.clock.finding),
        status.figures,
    )
    severity: Severity = "yellow" if problems else "green"
    return Check(sensor, "clock", severity, figure, as_remedy(problems), figures)


def check_edges(exam: Examination, sensor: str) -> Check | None:
    """Fit the clock of a camera that sees the board's pulses to them."""
    if not _sees_edges(exam, sensor):
        return None
    board, line = exam.seen[BOARD], edge_line(exam.rig, sensor)
    model, problem = tie(exam).edge_clock(sensor)
    if board.host_clock is None:
        problem = Finding("clock.board_not_tied", "error", sensor)
    n_sent = sum(pulse.sensor == line for pulse in board.pulses)
    n_seen = len(exam.seen[sensor].pulses)
    if model is None:
        figure = f"{n_seen} edges seen of {n_sent} pulses, clock not fitted"
        return Check(sensor, "edges", "red", figure, as_remedy(filter(None, [problem])))
    drift_ppm, rms_us = -1e6 * model.drift, model.rms_ns / 1000
    values = {"drift_ppm": drift_ppm, "rms_us": rms_us, "n_edges": float(n_seen), "n_pulses": float(n_sent)}
    figure = f"{n_seen} of {n_sent} pulses, drift {drift_ppm:+.1f} ppm, scatter {rms_us:.1f} us"
    return Check(sensor, "edges", "green", figure, values=values)


def check_offsets(exam: Examination) -> Check | None:
    """Measure every stream's offset and drift against this computer's clock, by when its samples arrive."""
    words, strays = list[str](), list[str]()
    values: dict[str, float] = {}
    for sensor, seen in exam.seen.items():
        model = seen.host_clock if sensor == BOARD else _by_arrivals(exam, seen)
        if model is None:
            continue
        # The model has the computer's time on the sensor's clock: its drift is the other way round.
        drift_ppm, sigma_ppm = -1e6 * model.drift, 1e6 * float(np.sqrt(model.cov[1, 1]))
        values |= {f"{sensor}.drift_ppm": drift_ppm, f"{sensor}.drift_sigma_ppm": sigma_ppm}
        offset_ms = _offset_ms(seen, model)
        if offset_ms is not None:
            values[f"{sensor}.offset_ms"] = offset_ms
        if sensor != BOARD:  # the board's own line has it
            offset = "" if offset_ms is None else f" {_duration(offset_ms)},"
            words.append(f"{sensor}{offset} {drift_ppm:+.0f} +- {max(sigma_ppm, 1):.0f} ppm")
        if abs(drift_ppm) > _MAX_DRIFT_PPM + 3 * sigma_ppm:
            strays.append(
                f"the clock of {sensor} drifts as no crystal does: is one being set, or the computer busy?"
            )
    if not words:
        return None
    severity: Severity = "yellow" if strays else "green"
    return Check(_RIG, "clocks", severity, "; ".join(words), "\n".join(map(as_line, strays)), values)


def check_sync(exam: Examination) -> Check | None:
    """Judge whether boards may move while they are captured; absent sensors are left out of it."""
    rig, verdict = exam.rig, tie(exam).verdict()
    absent = [sensor for sensor, seen in exam.seen.items() if not seen.has_opened]
    if not verdict.requires_still_boards:
        return None if absent else Check(_RIG, "sync", "green", describe(verdict.finding))
    reasons = [each for each in verdict.reasons if each.code != "sync.not_tied" or each.subject not in absent]
    if not reasons:
        return None
    figure = f"{describe(verdict.finding)}: {'; '.join(map(describe, reasons))}"
    if all(sync == "none" for sync in _promises(exam)):
        return Check(_RIG, "sync", "green", figure)
    if rig.sync is None:
        remedy = "The profile has no sync board: add `sync` (docs/wiring-and-sync.md) to let boards move."
    else:
        remedy = "See the lines of these sensors and of the sync board."
    return Check(_RIG, "sync", "yellow", figure, remedy)


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


def _duration(ms: float) -> str:
    return f"{ms / 1000:+.3g} s" if abs(ms) >= 1000 else f"{ms:+.1f} ms"
