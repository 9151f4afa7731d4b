"""The streams' clocks: what each is tied to, how they lie apart and drift, and whether boards may move."""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from lce_rig.core.data import Image, Pulse
from lce_rig.core.findings import Figure, Finding, Severity
from lce_rig.devices.findings import BOARD_NOT_TIED
from lce_rig.devices.velodyne_web import WebReport
from lce_rig.doctor import findings
from lce_rig.doctor.examination import Examination, driver_of
from lce_rig.doctor.observing import ObservedSensor
from lce_rig.rig.sync_settings import BOARD, PPS_LINE
from lce_rig.timing.clock import ClockModel
from lce_rig.timing.clock_fit import fit_arrivals
from lce_rig.timing.rig_clock import RigClock, edge_line
from lce_rig.timing.triggers import TriggerMatcher

_SIGMA_PER_MAD = 1.4826
_MAX_OFF_RATE = 0.02
# Frames and lines come in bursts: how many are still on their way differs.
_ROOM, _MAX_UNLIKE = 2, 0.01
_MAX_DRIFT_PPM = 200.0
_STREAMS = ("scans", "events", "frames")


def check_clock(exam: Examination, sensor: str) -> Iterator[Finding]:
    """Report the clock of a camera's or sync board's timestamps."""
    status = exam.seen[sensor].status
    if status is not None:
        yield findings.NO_TIMESTAMPS() if status.clock is None else status.clock.finding
        yield from exam.problems(sensor, "clock")


def check_pps(exam: Examination, sensor: str) -> Iterator[Finding]:
    """Check whether a LiDAR is locked to pulses and knows UTC, and which clock its scans carry."""
    status, report, lidar = exam.seen[sensor].status, exam.web.get(sensor), exam.rig.lidars[sensor]
    if status is None or status.clock is None:
        return
    clock = status.clock
    figures: dict[str, Any] = {
        "pps": (report.pps or None) if isinstance(report, WebReport) else None,
        "has_position": "pps" in clock.finding.figures,
        **clock.finding.figures,
    }
    yield findings.PULSE(**figures)
    if clock.is_utc or lidar.timestamps.clock != "utc":
        yield replace(clock.finding, severity="note")
        return
    severity: Severity = "error" if lidar.timestamps.sync == "hardware" else "warning"
    yield replace(clock.finding, severity=severity)
    yield findings.WITHOUT_PULSES()


def check_pulses_sent(exam: Examination, sensor: str = BOARD) -> Iterator[Finding]:
    """Count the board's pulses by line, and compare their rates with the profile."""
    board, sync = exam.seen[BOARD], exam.rig.sync
    if board.status is None or sync is None:
        return
    wanted = {PPS_LINE: 1.0} | {name: trigger.rate_hz for name, trigger in sync.triggers.items()}
    for line, expected_hz in wanted.items():
        rate_hz, action = 0.0, "pps" if line == PPS_LINE else ""
        stamps_ns = [pulse.stamp_ns for pulse in board.pulses if pulse.sensor == line]
        if len(stamps_ns) > 1 and stamps_ns[-1] > stamps_ns[0]:
            # By the board's clock; lost lines count.
            n_lost = board.status.n_lost_by_line.get(line, 0)
            rate_hz = 1e9 * (len(stamps_ns) - 1 + n_lost) / (stamps_ns[-1] - stamps_ns[0])
        figures: dict[str, Any] = {"line": line, "rate_hz": rate_hz, "expected_hz": expected_hz}
        if not rate_hz:
            # The driver says that the pulse per second is missing.
            severity: Severity = "note" if line == PPS_LINE else "error"
            yield findings.LINE_NONE(**figures, severity=severity, action=action)
        elif abs(rate_hz / expected_hz - 1) > _MAX_OFF_RATE:
            yield findings.LINE_OFF(**figures, action=action)
        else:
            yield findings.LINE(**figures)
    yield findings.PULSES_LOST(n=board.status.n_lost)
    yield from exam.problems(BOARD, "stream")


def check_frames_of_pulses(exam: Examination, sensor: str) -> Iterator[Finding]:
    """See whether each pulse made a frame of a triggered camera."""
    sync, board, seen = exam.rig.sync, exam.seen.get(BOARD), exam.seen[sensor]
    is_triggered = sync is not None and sensor in sync.triggers and driver_of(exam.rig, sensor) != "davis"
    if sync is None or board is None or not is_triggered or board.status is None or seen.status is None:
        return
    pulses = [pulse for pulse in board.pulses if pulse.sensor == sensor]
    n_frames, n_pulses = len(seen.frames), len(pulses)
    if seen.frames and pulses:
        # While both came; by their running numbers, so that lost ones count.
        frames_ns = [image.host_ns or 0 for image in seen.frames]
        first_ns = max(frames_ns[0], pulses[0].host_ns)
        last_ns = min(frames_ns[-1], pulses[-1].host_ns)
        n_frames, n_pulses = (_count(each, first_ns, last_ns) for each in (seen.frames, pulses))
    yield findings.FRAMES_OF_PULSES(n_frames=n_frames, n_pulses=n_pulses)
    trigger, clock = sync.triggers[sensor], board.host_clock
    if clock is None or trigger.rate_hz * trigger.max_delay_s >= 1:
        # `collect` begins with slow pulses then, to tell which is which.
        yield findings.COUNTED_ONLY()
        if abs(n_frames - n_pulses) > _ROOM + _MAX_UNLIKE * n_pulses:
            yield findings.UNEQUAL()
        return
    matcher, delays_ms = TriggerMatcher(sensor, round(1e9 * trigger.max_delay_s)), list[float]()
    matcher.set_clock(clock.inverse())
    samples: list[Pulse | Image] = sorted([*pulses, *seen.frames], key=lambda sample: sample.host_ns or 0)
    for sample in samples:
        take = matcher.take_pulse if isinstance(sample, Pulse) else matcher.take_image
        for matched in take(sample):  # type: ignore[arg-type]
            delays_ms.append(((matched.image.stamp_ns or 0) - clock.convert(matched.pulse_ns)) * 1e-6)
    counts: dict[str, Any] = matcher.figures()
    if matcher.problem is not None or not delays_ms:
        yield findings.NOT_MATCHED(**counts)
        yield from [matcher.problem] if matcher.problem is not None else []
        return
    middle_ms = float(np.median(delays_ms))
    scatter_ms = _SIGMA_PER_MAD * float(np.median(np.abs(np.array(delays_ms) - middle_ms)))
    yield findings.DELAY(**counts, delay_ms=middle_ms, delay_scatter_ms=scatter_ms)
    if matcher.counts["n_slips"] or matcher.counts["n_missed"]:
        yield findings.MISSED(**counts)


def _count(samples: Sequence[Pulse | Image], first_ns: int, last_ns: int) -> int:
    numbers = [sample.count for sample in samples if first_ns <= (sample.host_ns or 0) <= last_ns]
    known = [number for number in numbers if number is not None]
    return known[-1] - known[0] + 1 if known else len(numbers)


def check_edges(exam: Examination, sensor: str) -> Iterator[Finding]:
    """Fit the clock of a camera that sees the board's pulses to them."""
    board, seen = exam.seen.get(BOARD), exam.seen[sensor]
    is_davis = driver_of(exam.rig, sensor) == "davis"
    if not is_davis or seen.status is None or board is None or board.status is None:
        return
    line = edge_line(exam.rig, sensor)
    model, problem = tie(exam).edge_clock(sensor)
    if board.host_clock is None:
        problem = BOARD_NOT_TIED(severity="error")
    n_edges, n_pulses = len(seen.pulses), sum(pulse.sensor == line for pulse in board.pulses)
    if model is None:
        yield findings.EDGES_NOT_FITTED(n_edges=n_edges, n_pulses=n_pulses)
        yield from [problem] if problem is not None else []
        return
    drift_ppm, rms_us = -1e6 * model.drift, model.rms_ns / 1000
    yield findings.EDGES_FITTED(n_edges=n_edges, n_pulses=n_pulses, drift_ppm=drift_ppm, rms_us=rms_us)


def check_offsets(exam: Examination, _subject: str = "") -> Iterator[Finding]:
    """Measure every stream's offset and drift against this computer's clock, by when its samples arrive."""
    offsets, strays = list[Finding](), list[Finding]()
    for sensor, seen in exam.seen.items():
        model = seen.host_clock if sensor == BOARD else _by_arrivals(exam, seen)
        if model is None or seen.status is None:
            continue
        # The model has the computer's time on the sensor's clock: its drift is the other way round.
        drift_ppm, sigma_ppm = -1e6 * model.drift, 1e6 * float(np.sqrt(model.cov[1, 1]))
        # How far timestamps are ahead of this computer's clock; what samples take to arrive is in it. A
        # scan arrives a revolution after its timestamp, which its driver subtracts. A board's clock counts
        # from when it was switched on.
        offset_ms: float | None = (model.anchor_ns - model.reference_ns) * 1e-6
        if sensor == BOARD or "scans" in seen.stamps:
            ahead_s = seen.status.clock.ahead_s if seen.status.clock is not None else None
            offset_ms = None if sensor == BOARD or ahead_s is None else 1000 * ahead_s
        offset: dict[str, Figure] = {
            "offset_ms": offset_ms,
            "drift_ppm": drift_ppm,
            "drift_sigma_ppm": max(sigma_ppm, 1),
        }
        offsets.append(Finding(findings.OFFSET.code, "note", sensor, offset))
        if abs(drift_ppm) > _MAX_DRIFT_PPM + 3 * sigma_ppm:
            strays.append(findings.DRIFTS(sensor, drift_ppm=drift_ppm, limit_ppm=_MAX_DRIFT_PPM))
    if any(finding.subject != BOARD for finding in offsets):  # the board's own line says as much
        yield from (*offsets, *strays)


def _by_arrivals(exam: Examination, seen: ObservedSensor) -> ClockModel | None:
    """Fit this computer's time on a sensor's clock; None of timestamps that are arrivals themselves."""
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


def check_sync(exam: Examination, _subject: str = "") -> Iterator[Finding]:
    """Judge whether boards may move while they are captured; absent sensors do not count."""
    rig, verdict = exam.rig, tie(exam).verdict()
    absent = [sensor for sensor, seen in exam.seen.items() if not seen.has_opened]
    if not verdict.requires_still_boards:
        yield from [] if absent else [verdict.finding]
        return
    reasons = [each for each in verdict.reasons if each.code != "sync.not_tied" or each.subject not in absent]
    if not reasons:
        return
    timestamps = [lidar.timestamps for lidar in rig.lidars.values()]
    for camera in rig.cameras.values():
        timestamps += [channel.timestamps for channel in camera.channels.values()]
    is_promised = any(each.sync != "none" for each in timestamps)
    severity: Severity = "warning" if is_promised else "note"
    action = ("add_board" if rig.sync is None else "see_lines") if is_promised else ""
    yield replace(verdict.finding, severity=severity, action=action)
    yield from (replace(reason, severity=severity, action="named") for reason in reasons)


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


def _is_utc(seen: ObservedSensor) -> bool:
    return seen.status is not None and seen.status.clock is not None and seen.status.clock.is_utc
