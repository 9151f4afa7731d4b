"""Check whether this computer, with these sensors, is ready to collect.

A check yields findings: first its notes, then the faults. A check of the computer takes the examination, all
others also the name of a sensor. A fault is a warning if collecting works, but less well. It is an error if
collecting fails or its data are wrong.
"""

import ctypes
import os
import shutil
import tempfile
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from lce_rig.core.data import Image, Pulse
from lce_rig.core.errors import SourceError
from lce_rig.core.findings import Figure, Finding, Severity, worst
from lce_rig.core.geometry import SIGMA_PER_MAD
from lce_rig.devices import sensors, source_of
from lce_rig.devices.findings import BOARD_NOT_TIED
from lce_rig.devices.reading import MAX_LOST_SHARE, MAX_OFF_RATE, LiveSource
from lce_rig.doctor import findings
from lce_rig.doctor.observing import Examination, ObservedSensor, observe
from lce_rig.rig import Rig
from lce_rig.rig.profile import BOARD, PPS_LINE
from lce_rig.timing.rig_clock import RigClock, edge_line
from lce_rig.timing.triggers import TriggerMatcher

# Minimum and scarce free space, MB: a capture is a few MB; raw 1280x720 px images at 30 Hz are 55 MB/s.
_MIN_FREE_MB, _SCARCE_MB = 500.0, 5000.0
_MIN_WRITE_MBPS, _SLOW_WRITE_MBPS = 2.0, 20.0
# struct timex is 26 longs on 64-bit Linux; its fourth is the largest error, us.
_TIMEX_LONGS, _MAX_ERROR_LONG, _TIME_ERROR = 32, 3, 5
# Largest relative error of the rate of the sync board's pulses.
_MAX_OFF_PULSES = 0.02
_STOPPED_S = 1.0
# Tolerance on the counts of frames and pulses: both arrive in bursts.
_ROOM = 2


def check_disk(exam: Examination, _subject: str = "") -> Iterator[Finding]:
    """Measure the free space of a folder's disk, and its write rate for flushed data."""
    folder = exam.folder.absolute()
    folder = next(path for path in (folder, *folder.parents) if path.exists())
    try:
        free_mb = shutil.disk_usage(folder).free / 1e6
        block = os.urandom(4 << 20)  # random data: disks may compress
        n_bytes, start_s = 0, time.monotonic()
        with tempfile.TemporaryFile(dir=folder) as file:
            # At most half a second or 48 MiB, each block flushed like a capture's files.
            while n_bytes < 48 << 20 and time.monotonic() - start_s < 0.5:
                file.write(block)
                file.flush()
                os.fsync(file.fileno())
                n_bytes += len(block)
        write_mbps = n_bytes / 1e6 / max(time.monotonic() - start_s, 1e-9)
    except OSError as error:
        yield findings.DISK_NOT_WRITABLE(folder=str(folder), cause=error.strerror)
        return
    yield findings.DISK(free_mb=free_mb, write_mbps=write_mbps, folder=str(folder))
    if free_mb < _SCARCE_MB:
        yield findings.DISK_FULL(severity="error" if free_mb < _MIN_FREE_MB else "warning")
    elif write_mbps < _SLOW_WRITE_MBPS:
        yield findings.DISK_SLOW(severity="error" if write_mbps < _MIN_WRITE_MBPS else "warning")


def check_computer_clock(_exam: Examination, _subject: str = "") -> Iterator[Finding]:
    """Ask the kernel whether the computer's clock is synchronised; a VLP-16's hour is taken from it."""
    timex = (ctypes.c_long * _TIMEX_LONGS)()
    state = ctypes.CDLL(None).adjtimex(ctypes.byref(timex))
    if state in (-1, _TIME_ERROR):
        yield findings.COMPUTER_CLOCK_LOOSE()
    else:
        yield findings.COMPUTER_CLOCK(max_error_ms=timex[_MAX_ERROR_LONG] / 1000)


def check_device(exam: Examination, sensor: str) -> Iterator[Finding]:
    """Report the connected device, or the reason of its failure."""
    seen = exam.seen[sensor]
    if seen.failure is not None:
        what = seen.failure.what  # without the sensor's name, which starts the line
        for start in (f"{sensor}: ", f"camera {sensor!r}: "):
            what = what.removeprefix(start)
        yield findings.FAILED(what=what, hint=seen.failure.hint)
        return
    assert seen.status is not None  # sensors that neither open nor fail in time are reported as failed
    yield findings.ANSWERS(device=seen.status.device)
    yield from exam.problems(sensor, "device")


def check_stream(exam: Examination, sensor: str) -> Iterator[Finding]:
    """Compare a LiDAR's or camera's rates with the profile, and count its losses."""
    seen, rig = exam.seen[sensor], exam.rig
    status = seen.status
    if status is None:
        return
    stream = "scans" if sensor in rig.lidars else "frames"
    camera = rig.cameras.get(sensor)
    kinds = {"scans"} if camera is None else {channel.kind for channel in camera.channels.values()}
    problems = exam.problems(sensor, "stream", "packet", "buffer")
    if stream in kinds or seen.frames:
        rate = _rate(exam, seen, stream)
        yield rate
        if rate.code == findings.RATE_OFF.code:
            problems = [each for each in problems if each.code != "stream.rotor_rate"]  # the same once more
    if "events" in kinds and not seen.n_events:
        yield findings.NO_EVENTS()
    elif "events" in kinds:
        yield findings.EVENT_RATE(events_per_s=seen.n_events / max(seen.watched_s, 1e-9))
    counts: dict[str, Any] = {
        "watched_s": seen.watched_s,
        "n_packets": status.n_packets,
        "n_lost": status.n_lost,
        "n_dropped": status.n_dropped,
    }
    n_missing = status.n_lost + status.n_dropped
    if n_missing:
        n_came = len(seen.arrivals_ns.get(stream, ())) if status.n_packets is None else status.n_packets
        counts["share"] = share = n_missing / (max(n_came, 1) + status.n_lost)
        severity: Severity = "error" if share > MAX_LOST_SHARE else "warning"
        yield findings.LOSSES(**counts, severity=severity, action="named" if problems else "")
    else:
        yield findings.COMPLETE(**counts)
    yield from problems


def wanted_rate_hz(rig: Rig, sensor: str, driver: str) -> float | None:
    """Return the profile's rate of scans or images, Hz; None if it states none."""
    if sensor in rig.lidars:
        return rig.lidars[sensor].rate_hz
    settings = rig.cameras[sensor].driver
    # Pulses cannot trigger a DAVIS, which has its own frame interval.
    if driver == "davis":
        interval_us = settings.controls.get("frame_interval_us", 0)
        return 1e6 / interval_us if isinstance(interval_us, int | float) and interval_us > 0 else None
    if rig.sync is not None and sensor in rig.sync.triggers:
        return rig.sync.triggers[sensor].rate_hz
    return settings.frame_rate_hz


def _rate(exam: Examination, seen: ObservedSensor, stream: str) -> Finding:
    """Judge the rate of scans or images.

    The LiDAR's rate is its rotor's speed, by its own clock: on a busy computer, scans arrive late.
    """
    rate_hz = 0.0 if seen.status is None else seen.status.rates_hz.get("scans", 0.0)
    if stream != "scans" or stream not in seen.arrivals_ns or rate_hz <= 0:
        arrivals_ns = seen.arrivals_ns.get(stream, [0])
        span_ns = arrivals_ns[-1] - arrivals_ns[0]
        rate_hz = 1e9 * (len(arrivals_ns) - 1) / span_ns if span_ns > 0 else 0.0
    expected_hz = wanted_rate_hz(exam.rig, seen.sensor, exam.driver(seen.sensor))
    figures: dict[str, Any] = {"stream": stream, "rate_hz": rate_hz, "expected_hz": expected_hz}
    if rate_hz == 0:
        return findings.NO_STREAM(**figures)
    silent_s = (seen.ended_ns - seen.arrivals_ns[stream][-1]) * 1e-9
    if silent_s > max(_STOPPED_S, 3 / rate_hz):
        return findings.STOPPED(**figures, silent_s=silent_s)
    if expected_hz is None or abs(rate_hz / expected_hz - 1) <= MAX_OFF_RATE:
        return findings.RATE(**figures)
    is_triggered = exam.rig.sync is not None and seen.sensor in exam.rig.sync.triggers
    action = "rotor" if stream == "scans" else "trigger" if is_triggered else ""
    return findings.RATE_OFF(**figures, expected_rpm=60 * expected_hz, action=action)


def check_clock(exam: Examination, sensor: str) -> Iterator[Finding]:
    """Report the clock of a camera's or sync board's timestamps."""
    status = exam.seen[sensor].status
    if status is not None:
        yield findings.NO_TIMESTAMPS() if status.clock is None else status.clock
        yield from exam.problems(sensor, "clock")


def check_pps(exam: Examination, sensor: str) -> Iterator[Finding]:
    """Check whether a LiDAR is locked to pulses and knows UTC, and which clock its timestamps use."""
    status, lidar = exam.seen[sensor].status, exam.rig.lidars[sensor]
    if status is None or status.clock is None:
        return
    clock = status.clock
    figures: dict[str, Any] = {"pps": None, "has_position": "pps" in clock.figures, **clock.figures}
    yield findings.PULSE(**figures)
    if status.is_utc or lidar.timestamps.clock != "utc":
        yield replace(clock, severity="note")
        return
    severity: Severity = "error" if lidar.timestamps.sync == "hardware" else "warning"
    yield replace(clock, severity=severity)
    yield findings.WITHOUT_PULSES()


def check_pulses_sent(exam: Examination, sensor: str = BOARD) -> Iterator[Finding]:
    """Count the sync board's pulses by line, and compare their rates with the profile."""
    board, sync = exam.seen[BOARD], exam.rig.sync
    if board.status is None or sync is None:
        return
    wanted = {PPS_LINE: 1.0} | {name: trigger.rate_hz for name, trigger in sync.triggers.items()}
    for line, expected_hz in wanted.items():
        rate_hz, action = 0.0, "pps" if line == PPS_LINE else ""
        stamps_ns = [pulse.stamp_ns for pulse in board.pulses if pulse.sensor == line]
        if len(stamps_ns) > 1 and stamps_ns[-1] > stamps_ns[0]:
            # Pulse rate by the board's clock, including pulses whose lines were lost.
            n_lost = board.status.n_lost_by_line.get(line, 0)
            rate_hz = 1e9 * (len(stamps_ns) - 1 + n_lost) / (stamps_ns[-1] - stamps_ns[0])
        figures: dict[str, Any] = {"line": line, "rate_hz": rate_hz, "expected_hz": expected_hz}
        if abs(rate_hz / expected_hz - 1) > _MAX_OFF_PULSES:
            # The driver reports the missing pulse per second.
            severity: Severity = "warning" if rate_hz else "note" if line == PPS_LINE else "error"
            yield findings.LINE_OFF(**figures, severity=severity, action=action)
        else:
            yield findings.LINE(**figures)
    yield from exam.problems(BOARD, "stream")


def check_frames_of_pulses(exam: Examination, sensor: str) -> Iterator[Finding]:
    """Check that each pulse made one image of a triggered camera, and measure their delay."""
    sync, board, seen = exam.rig.sync, exam.seen.get(BOARD), exam.seen[sensor]
    is_triggered = sync is not None and sensor in sync.triggers and exam.driver(sensor) != "davis"
    if sync is None or board is None or not is_triggered or board.status is None or seen.status is None:
        return
    pulses = [pulse for pulse in board.pulses if pulse.sensor == sensor]
    n_frames, n_pulses = len(seen.frames), len(pulses)
    if seen.frames and pulses:
        # Count over the common interval, by sequence number, so that losses are included.
        frames_ns = [image.host_ns or 0 for image in seen.frames]
        first_ns = max(frames_ns[0], pulses[0].host_ns)
        last_ns = min(frames_ns[-1], pulses[-1].host_ns)
        n_frames, n_pulses = (_count(each, first_ns, last_ns) for each in (seen.frames, pulses))
    yield findings.FRAMES_OF_PULSES(n_frames=n_frames, n_pulses=n_pulses)
    if abs(n_frames - n_pulses) > _ROOM + MAX_LOST_SHARE * n_pulses:
        yield findings.UNEQUAL()
    trigger, clock = sync.triggers[sensor], board.host_clock
    if clock is None or trigger.rate_hz * trigger.max_delay_s >= 1:
        return  # `collect` then starts with slow pulses, to match images to them.
    matcher, delays_ms = TriggerMatcher(sensor, round(1e9 * trigger.max_delay_s)), list[float]()
    matcher.set_clock(clock.inverse())
    samples: list[Pulse | Image] = sorted([*pulses, *seen.frames], key=lambda sample: sample.host_ns or 0)
    for sample in samples:
        take = matcher.take_pulse if isinstance(sample, Pulse) else matcher.take_image
        for matched in take(sample):  # type: ignore[arg-type]
            delays_ms.append(((matched.image.stamp_ns or 0) - clock.convert(matched.pulse_ns)) * 1e-6)
    if delays_ms:
        middle_ms = float(np.median(delays_ms))
        scatter_ms = SIGMA_PER_MAD * float(np.median(np.abs(np.array(delays_ms) - middle_ms)))
        yield findings.DELAY(delay_ms=middle_ms, delay_scatter_ms=scatter_ms)
    if matcher.problem is not None:
        yield matcher.problem


def _count(samples: Sequence[Pulse | Image], first_ns: int, last_ns: int) -> int:
    numbers = [sample.count for sample in samples if first_ns <= (sample.host_ns or 0) <= last_ns]
    known = [number for number in numbers if number is not None]
    return known[-1] - known[0] + 1 if known else len(numbers)


def check_edges(exam: Examination, sensor: str) -> Iterator[Finding]:
    """Fit the clock of a camera that receives the sync board's pulses to these pulses."""
    board, seen = exam.seen.get(BOARD), exam.seen[sensor]
    is_davis = exam.driver(sensor) == "davis"
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


def check_sync(exam: Examination, _subject: str = "") -> Iterator[Finding]:
    """Judge whether boards may move during captures; absent sensors do not count."""
    rig, verdict = exam.rig, tie(exam).verdict()
    absent = [sensor for sensor, seen in exam.seen.items() if seen.status is None]
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
    """Convert all synchronised sensors to the rig's clock, as `collect` does with the same samples."""
    board = exam.seen.get(BOARD)
    has_board = board is not None and board.status is not None
    cameras = [name for name in exam.rig.cameras if exam.driver(name) == "davis"]
    clock = RigClock(exam.rig, has_board=has_board, edge_cameras=cameras)
    models = (None, None) if board is None else (board.host_clock, board.utc_clock)
    locked = [name for name, seen in exam.seen.items() if seen.is_utc]
    clock.refresh(*models, locked)
    came: list[tuple[str, Pulse | Image]] = []
    for name, seen in exam.seen.items():
        came += [(name, pulse) for pulse in seen.pulses] + [(name, image) for image in seen.frames]
    for name, sample in sorted(came, key=lambda pair: pair[1].host_ns or 0):
        clock.take(name, sample)
    clock.refresh(*models, locked)
    return clock


CHECKS: dict[str, dict[str, Callable[[Examination, str], Iterable[Finding]]]] = {
    "computer": {"disk": check_disk, "clock": check_computer_clock},
    "lidar": {
        "device": check_device,
        "stream": check_stream,
        "PPS": check_pps,
    },
    "camera": {
        "device": check_device,
        "stream": check_stream,
        "clock": check_clock,
        "pulses": check_frames_of_pulses,
        "edges": check_edges,
    },
    "sync": {
        "device": check_device,
        "pulses": check_pulses_sent,
        "clock": check_clock,
    },
    "rig": {"sync": check_sync},
}
"""Every check by its line's name; a line without findings is skipped."""


@dataclass(frozen=True)
class Check:
    """Result of one check, a line of the report.

    Attributes:
        subject: "computer", a sensor's name in the profile, or "rig" for several sensors together.
        name: one word for the checked item.
        findings: findings of the check; those without a subject get the line's.
    """

    subject: str
    name: str
    findings: tuple[Finding, ...]

    def __post_init__(self) -> None:
        named = (each if each.subject else replace(each, subject=self.subject) for each in self.findings)
        object.__setattr__(self, "findings", tuple(named))

    @property
    def severity(self) -> Severity:
        """The worst of the findings."""
        return worst(self.findings)

    @property
    def figures(self) -> dict[str, Figure]:
        """The figures of all findings together."""
        return {name: figure for each in self.findings for name, figure in each.figures.items()}


def examine(rig: Rig, duration_s: float = 5.0, folder: Path = Path()) -> list[Check]:
    """Check the computer and every sensor of a rig.

    An absent or failing sensor is an error; everything else is still checked. The check lasts for the
    duration and the time that sensors take to open.

    Args:
        rig: the profile.
        duration_s: time for which the sensors are watched.
        folder: folder of the sessions.

    Returns:
        A line for each check: of the computer, of each sensor, of the rig.
    """
    seen, sources = dict[str, ObservedSensor](), list[LiveSource]()
    for sensor in sensors(rig):
        try:
            sources.append(source_of(rig, sensor))
        except SourceError as error:
            seen[sensor] = ObservedSensor(sensor, failure=error)
    exam = Examination(rig, folder, seen | observe(sources, duration_s))
    subjects = [("computer", "computer"), *((name, "lidar") for name in rig.lidars)]
    subjects += [*((name, "camera") for name in rig.cameras), *([(BOARD, "sync")] if rig.sync else [])]
    lines = [
        Check(subject, name, tuple(check(exam, subject)))
        for subject, kind in (*subjects, ("rig", "rig"))
        for name, check in CHECKS[kind].items()
    ]
    return [line for line in lines if line.findings]
