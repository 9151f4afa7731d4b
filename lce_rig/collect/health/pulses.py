"""The sync board's pulses, and whether each made one frame of the camera it triggers."""

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from lce_rig.collect.health.check import Check, Severity, worst
from lce_rig.collect.health.examination import Examination
from lce_rig.collect.health.observing import Observation
from lce_rig.collect.health.remarks import as_remedy, remarks
from lce_rig.collect.health.sensors import driver_of
from lce_rig.core.data import Image, Pulse
from lce_rig.rig.sync import BOARD, PPS_LINE
from lce_rig.sources.live.sync_lines import DIALECTS
from lce_rig.timing.triggers import TriggeredImage, TriggerMatcher

_SIGMA_PER_MAD = 1.4826
_MAX_OFF_RATE = 0.02
# Frames and lines come in bursts: how many are still on their way differs.
_ROOM, _MAX_UNLIKE = 2, 0.01
_REMEDY = "Every pulse must make one frame: set the camera's trigger mode in driver.controls; check the line."


def check_pulses_sent(exam: Examination) -> Check | None:
    """Count the board's pulses by line, and hold their rates against the profile."""
    board, sync = exam.seen[BOARD], exam.rig.sync
    if board.status is None or sync is None or not DIALECTS[sync.type]().has_triggers:
        return None
    words, remedies, severities = [], [as_remedy(remarks(board.status, "stream"))], list[Severity]()
    wanted = {PPS_LINE: 1.0} | {name: trigger.rate_hz for name, trigger in sync.triggers.items()}
    values = {}
    for line, wanted_hz in wanted.items():
        rate_hz = _rate_hz(board, line)
        values[f"{line}_hz"] = rate_hz
        words.append(f"{line} {rate_hz:.3g} Hz" if rate_hz else f"{line} none")
        is_off = abs(rate_hz / wanted_hz - 1) > _MAX_OFF_RATE
        # Boards of others make no pulse per second; that one of ours is missing, the driver says.
        if is_off and (rate_hz or line != PPS_LINE):
            severities.append("yellow" if rate_hz else "red")
            key = "" if line == PPS_LINE else f"check sync.triggers.{line}, "
            remedies.append(f"Line {line} should pulse at {wanted_hz:g} Hz: {key}reset the board.")
    n_lost = board.status.n_lost
    remedy = "\n".join(filter(None, remedies))
    severities.append("yellow" if remedy else "green")
    figure = f"{', '.join(words)}; {n_lost or 'none'} lost"
    return Check(BOARD, "pulses", worst(severities), figure, remedy, values)


def check_frames_of_pulses(exam: Examination, sensor: str) -> Check | None:
    """See whether each pulse made a frame of a triggered camera."""
    sync, board, seen = exam.rig.sync, exam.seen.get(BOARD), exam.seen[sensor]
    is_triggered = sync is not None and sensor in sync.triggers and driver_of(exam.rig, sensor) != "davis"
    if sync is None or board is None or not is_triggered or board.status is None or seen.status is None:
        return None
    are_numbered = DIALECTS[sync.type]().has_own_counts
    n_frames, n_pulses = _in_common(seen, board, sensor, are_numbered)
    figure = f"{n_frames} frames of {n_pulses} pulses"
    values = {"n_frames": float(n_frames), "n_pulses": float(n_pulses)}
    is_equal = abs(n_frames - n_pulses) <= _ROOM + _MAX_UNLIKE * n_pulses
    trigger = sync.triggers[sensor]
    if board.host_clock is not None and trigger.rate_hz * trigger.max_delay_s < 1:
        matcher = TriggerMatcher(sensor, round(1e9 * trigger.max_delay_s))
        matcher.set_clock(board.host_clock.inverse())
        return _by_matching(matcher, board, seen, Check(sensor, "pulses", "green", figure, "", values))
    # `collect` begins with slow pulses then, to tell which is which.
    figure += ", counted only: which is of which is not known yet"
    return Check(sensor, "pulses", *(("green", figure, "") if is_equal else ("red", figure, _REMEDY)), values)


def _by_matching(matcher: TriggerMatcher, board: Observation, seen: Observation, counted: Check) -> Check:
    """Match frames to pulses by their numbers, and add what comes of it to the line with their counts."""
    pulses = [pulse for pulse in board.pulses if pulse.sensor == seen.sensor]
    delays_ms = np.array([_delay_ms(each, board) for each in _matched(matcher, pulses, seen.frames)])
    counts = matcher.counts
    values = {**counted.values, "n_matched": float(counts.n_matched), "n_missed": float(counts.n_missed)}
    values |= {"n_slips": float(counts.n_slips), "n_lost_pulses": float(counts.n_lost_pulses)}
    if matcher.problem is not None or not len(delays_ms):
        remedy = _REMEDY if matcher.problem is None else as_remedy([matcher.problem])
        figure = f"{counted.figure}, not matched"
        return replace(counted, severity="red", figure=figure, remedy=remedy, values=values)
    middle_ms = float(np.median(delays_ms))
    scatter_ms = _SIGMA_PER_MAD * float(np.median(np.abs(delays_ms - middle_ms)))
    values |= {"delay_ms": middle_ms, "delay_scatter_ms": scatter_ms}
    figure = f"{counted.figure}, delay {middle_ms:.2f} +- {scatter_ms:.2f} ms"
    if counts.n_slips or counts.n_missed:
        figure += f", {counts.n_missed} missed"
        return replace(counted, severity="red", figure=figure, remedy=_REMEDY, values=values)
    return replace(counted, figure=figure, values=values)


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
