"""The sync board's pulses, and whether each made one frame of the camera it triggers."""

from collections.abc import Iterator, Sequence

import numpy as np

from lce_rig.collect.health.check import Check, problems_of
from lce_rig.collect.health.examination import Examination
from lce_rig.collect.health.observing import Observation
from lce_rig.collect.health.sensors import driver_of
from lce_rig.core.data import Image, Pulse
from lce_rig.core.findings import Figure, Finding, Severity
from lce_rig.rig.sync import BOARD, PPS_LINE
from lce_rig.sources.live.sync_lines import DIALECTS
from lce_rig.timing.triggers import TriggeredImage, TriggerMatcher

_SIGMA_PER_MAD = 1.4826
_MAX_OFF_RATE = 0.02
# Frames and lines come in bursts: how many are still on their way differs.
_ROOM, _MAX_UNLIKE = 2, 0.01


def check_pulses_sent(exam: Examination) -> Check | None:
    """Count the board's pulses by line, and compare their rates with the profile."""
    board, sync = exam.seen[BOARD], exam.rig.sync
    if board.status is None or sync is None or not DIALECTS[sync.type]().has_triggers:
        return None
    wanted = {PPS_LINE: 1.0} | {name: trigger.rate_hz for name, trigger in sync.triggers.items()}
    lines = [_judge_line(board, line, expected_hz) for line, expected_hz in wanted.items()]
    lost = Finding("pulses.lost", "note", figures={"n": board.status.n_lost})
    return Check.of(BOARD, "pulses", *lines, lost, *problems_of(board.status, "stream"))


def _judge_line(board: Observation, line: str, expected_hz: float) -> Finding:
    rate_hz = _rate_hz(board, line)
    figures: dict[str, Figure] = {"line": line, "rate_hz": rate_hz, "expected_hz": expected_hz}
    action = "pps" if line == PPS_LINE else ""
    if rate_hz:
        is_off = abs(rate_hz / expected_hz - 1) > _MAX_OFF_RATE
        if is_off:
            return Finding("pulses.line_off", "warning", figures=figures, action=action)
        return Finding("pulses.line", "note", figures=figures)
    # Boards of others make no pulse per second; that one of ours is missing, the driver says.
    severity: Severity = "note" if line == PPS_LINE else "error"
    return Finding("pulses.line_none", severity, figures=figures, action=action)


def check_frames_of_pulses(exam: Examination, sensor: str) -> Check | None:
    """See whether each pulse made a frame of a triggered camera."""
    sync, board, seen = exam.rig.sync, exam.seen.get(BOARD), exam.seen[sensor]
    is_triggered = sync is not None and sensor in sync.triggers and driver_of(exam.rig, sensor) != "davis"
    if sync is None or board is None or not is_triggered or board.status is None or seen.status is None:
        return None
    n_frames, n_pulses = _in_common(seen, board, sensor, DIALECTS[sync.type]().has_own_counts)
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


def _by_matching(matcher: TriggerMatcher, board: Observation, seen: Observation) -> Iterator[Finding]:
    """Match frames to pulses by their numbers, and give what comes of it."""
    pulses = [pulse for pulse in board.pulses if pulse.sensor == seen.sensor]
    delays_ms = np.array([_delay_ms(each, board) for each in _matched(matcher, pulses, seen.frames)])
    counts: dict[str, Figure] = dict(vars(matcher.counts))
    if matcher.problem is not None or not len(delays_ms):
        yield Finding("pulses.not_matched", figures=counts)
        if matcher.problem is not None:
            yield matcher.problem
        return
    middle_ms = float(np.median(delays_ms))
    scatter_ms = _SIGMA_PER_MAD * float(np.median(np.abs(delays_ms - middle_ms)))
    delay: dict[str, Figure] = {"delay_ms": middle_ms, "delay_scatter_ms": scatter_ms}
    yield Finding("pulses.delay", "note", figures=counts | delay)
    if matcher.counts.n_slips or matcher.counts.n_missed:
        yield Finding("pulses.missed", figures=counts)


def _rate_hz(board: Observation, line: str) -> float:
    """Measure how many pulses of a line were sent a second, by the board's clock; lost lines count."""
    stamps_ns = [pulse.stamp_ns for pulse in board.pulses if pulse.sensor == line]
    if len(stamps_ns) < 2 or stamps_ns[-1] <= stamps_ns[0] or board.status is None:
        return 0.0
    n_lost = board.status.n_lost_by_line.get(line, 0)
    return 1e9 * (len(stamps_ns) - 1 + n_lost) / (stamps_ns[-1] - stamps_ns[0])


def _in_common(seen: Observation, board: Observation, line: str, are_numbered: bool) -> tuple[int, int]:
    """Count frames and pulses while both came; by their running numbers, so that lost ones count."""
    frames = [(image.host_ns or 0, image.count) for image in seen.frames]
    pulses = [
        (pulse.host_ns, pulse.count if are_numbered else None)
        for pulse in board.pulses
        if pulse.sensor == line
    ]
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


def _delay_ms(matched: TriggeredImage, board: Observation) -> float:
    assert board.host_clock is not None and matched.image.stamp_ns is not None
    return (matched.image.stamp_ns - board.host_clock.convert(matched.pulse_ns)) * 1e-6
