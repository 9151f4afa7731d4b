"""The streams' clocks: what each is tied to, how they lie apart and drift, and whether boards may move."""

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from lce_rig.core.data import Image, Pulse
from lce_rig.core.findings import Figure, Finding, Severity
from lce_rig.doctor.line import Check, problems_of
from lce_rig.doctor.observing import ObservedSensor, SensorReport
from lce_rig.doctor.sensor_sources import driver_of
from lce_rig.rig.sync_settings import BOARD, PPS_LINE
from lce_rig.timing.clock import ClockModel
from lce_rig.timing.clock_fit import fit_arrivals
from lce_rig.timing.rig_clock import RigClock, edge_line
from lce_rig.timing.triggers import TriggeredImage, TriggerMatcher

# The sync board's pulses, and whether each made one frame of the camera it triggers.

_SIGMA_PER_MAD = 1.4826
_MAX_OFF_RATE = 0.02
# Frames and lines come in bursts: how many are still on their way differs.
_ROOM, _MAX_UNLIKE = 2, 0.01


def check_pulses_sent(exam: SensorReport) -> Check | None:
    """Count the board's pulses by line, and compare their rates with the profile."""
    board, sync = exam.seen[BOARD], exam.rig.sync
    if board.status is None or sync is None:
        return None
    wanted = {PPS_LINE: 1.0} | {name: trigger.rate_hz for name, trigger in sync.triggers.items()}
    lines = [_judge_line(board, line, expected_hz) for line, expected_hz in wanted.items()]
    lost = Finding("pulses.lost", "note", figures={"n": board.status.n_lost})
    return Check.of(BOARD, "pulses", *lines, lost, *problems_of(board.status, "stream"))


def _judge_line(board: ObservedSensor, line: str, expected_hz: float) -> Finding:
    rate_hz = _rate_hz(board, line)
    figures: dict[str, Figure] = {"line": line, "rate_hz": rate_hz, "expected_hz": expected_hz}
    action = "pps" if line == PPS_LINE else ""
    if rate_hz:
        is_off = abs(rate_hz / expected_hz - 1) > _MAX_OFF_RATE
        if is_off:
            return Finding("pulses.line_off", "warning", figures=figures, action=action)
        return Finding("pulses.line", "note", figures=figures)
    # The driver says that it is missing.
    severity: Severity = "note" if line == PPS_LINE else "error"
    return Finding("pulses.line_none", severity, figures=figures, action=action)


def check_frames_of_pulses(exam: SensorReport, sensor: str) -> Check | None:
    """See whether each pulse made a frame of a triggered camera."""
    sync, board, seen = exam.rig.sync, exam.seen.get(BOARD), exam.seen[sensor]
    is_triggered = sync is not None and sensor in sync.triggers and driver_of(exam.rig, sensor) != "davis"
    if sync is None or board is None or not is_triggered or board.status is None or seen.status is None:
        return None
    n_frames, n_pulses = _in_common(seen, board, sensor)
    counts = Finding("pulses.frames", "note", figures={"n_frames": n_frames, "n_pulses": n_pulses})
    trigger = sync.triggers[sensor]
    if board.host_clock is not None and trigger.rate_hz * trigger.max_delay_s < 1:
        matcher = TriggerMatcher(sensor, round(1e9 * trigger.max_delay_s))
        matcher.set_clock(board.host_clock.inverse())
        return Check.of(sensor, "pulses", counts, *_by_matching(matcher, board, seen))
    # `collect` begins with slow pulses then, to tell which is which.
    is_equal = abs(n_frames - n_pulses) <= _ROOM + _MAX_UNLIKE * n_pulses
    unequal = None if is_equal else Finding("pulses.unequal")
    return Check.of(sensor, "pulses", counts, Finding("pulses.counted_only", "note"), unequal)


def _by_matching(matcher: TriggerMatcher, board: ObservedSensor, seen: ObservedSensor) -> Iterator[Finding]:
    """Match frames to pulses by their numbers, and give what comes of it."""
    pulses = [pulse for pulse in board.pulses if pulse.sensor == seen.sensor]
    delays_ms = np.array([_delay_ms(each, board) for each in _matched(matcher, pulses, seen.frames)])
    counts = matcher.figures()
    if matcher.problem is not None or not len(delays_ms):
        yield Finding("pulses.not_matched", figures=counts)
        if matcher.problem is not None:
            yield matcher.problem
        return
    middle_ms = float(np.median(delays_ms))
    scatter_ms = _SIGMA_PER_MAD * float(np.median(np.abs(delays_ms - middle_ms)))
    delay: dict[str, Figure] = {"delay_ms": middle_ms, "delay_scatter_ms": scatter_ms}
    yield Finding("pulses.delay", "note", figures=counts | delay)
    if matcher.losses.n("pulses.slip", "pulses.missed_by_camera"):
        yield Finding("pulses.missed", figures=counts)


def _rate_hz(board: ObservedSensor, line: str) -> float:
    """Measure how many pulses of a line were sent a second, by the board's clock; lost lines count."""
    stamps_ns = [pulse.stamp_ns for pulse in board.pulses if pulse.sensor == line]
    if len(stamps_ns) < 2 or stamps_ns[-1] <= stamps_ns[0] or board.status is None:
        return 0.0
    n_lost = board.status.n_lost_by_line.get(line, 0)
    return 1e9 * (len(stamps_ns) - 1 + n_lost) / (stamps_ns[-1] - stamps_ns[0])


def _in_common(seen: ObservedSensor, board: ObservedSensor, line: str) -> tuple[int, int]:
    """Count frames and pulses while both came; by their running numbers, so that lost ones count."""
    frames = [(image.host_ns or 0, image.count) for image in seen.frames]
    pulses = [(pulse.host_ns, pulse.count) for pulse in board.pulses if pulse.sensor == line]
    if not frames or not pulses:
        return len(frames), len(pulses)
    first_ns, last_ns = max(frames[0][0], pulses[0][0]), min(frames[-1][0], pulses[-1][0])
    return _count(frames, first_ns, last_ns), _count(pulses, first_ns, last_ns)


def _count(arrivals: Sequence[tuple[int, int | None]], first_ns: int, last_ns: int) -> int:
    numbers = [number for host_ns, number in arrivals if first_ns <= host_ns <= last_ns]
    known = [number for number in numbers if number is not None]
    return known[-1] - known[0] + 1 if known else len(numbers)


def _matched(matcher: TriggerMatcher, pulses: list[Pulse], frames: list[Image]) -> Iterator[TriggeredImage]:
    """Give both streams to the matcher in the order of their arrival."""
    samples: list[Pulse | Image] = sorted([*pulses, *frames], key=lambda sample: sample.host_ns or 0)
    for sample in samples:
        if isinstance(sample, Pulse):
            yield from matcher.take_pulse(sample)
        else:
            yield from matcher.take_image(sample)


def _delay_ms(matched: TriggeredImage, board: ObservedSensor) -> float:
    assert board.host_clock is not None and matched.image.stamp_ns is not None
    return (matched.image.stamp_ns - board.host_clock.convert(matched.pulse_ns)) * 1e-6


_RIG = "rig"
_MAX_DRIFT_PPM = 200.0
_STREAMS = ("scans", "events", "frames")


def check_clock(exam: SensorReport, sensor: str) -> Check | None:
    """Say what a camera's or sync board's timestamps are tied to."""
    status = exam.seen[sensor].status
    if status is None:
        return None
    state = Finding("clock.no_timestamps", "note") if status.clock is None else status.clock.finding
    return Check.of(sensor, "clock", state, *problems_of(status, "clock"))


def check_edges(exam: SensorReport, sensor: str) -> Check | None:
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


def check_offsets(exam: SensorReport) -> Check | None:
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


def check_sync(exam: SensorReport) -> Check | None:
    """Judge whether boards may move while they are captured; absent sensors do not count."""
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


def tie(exam: SensorReport) -> RigClock:
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


def _promises(exam: SensorReport) -> list[str]:
    """List how the profile says that clocks are tied, stream by stream."""
    found: list[str] = [lidar.timestamps.sync for lidar in exam.rig.lidars.values()]
    for camera in exam.rig.cameras.values():
        found += [channel.timestamps.sync for channel in camera.channels.values()]
    return found


def _sees_edges(exam: SensorReport, sensor: str) -> bool:
    board, seen = exam.seen.get(BOARD), exam.seen[sensor]
    is_davis = driver_of(exam.rig, sensor) == "davis"
    return is_davis and seen.status is not None and board is not None and board.status is not None


def _by_arrivals(exam: SensorReport, seen: ObservedSensor) -> ClockModel | None:
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


def _offset_ms(seen: ObservedSensor, model: ClockModel) -> float | None:
    """Give by how much timestamps are ahead of this computer's clock; what samples take to arrive is in it.

    A LiDAR's scan arrives a revolution after its timestamp, which its driver subtracts; None for a board,
    whose clock counts from when it was switched on.
    """
    assert seen.status is not None
    if seen.sensor == BOARD:
        return None
    if "scans" in seen.stamps:
        clock = seen.status.clock
        return None if clock is None or clock.ahead_s is None else 1000 * clock.ahead_s
    return (model.anchor_ns - model.reference_ns) * 1e-6
