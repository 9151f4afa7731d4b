"""Study of corruptions: the verdict on corrupted sessions, compared with their actual error."""

import os
import sys
import traceback
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from functools import partial

from benchmarks.corruption_draws import Draws, draw_halves, print_draws
from benchmarks.corruption_kinds import SOUND, Corruption, corruptions
from benchmarks.corruption_others import OTHERS
from benchmarks.corruption_outcomes import (
    METHODS,
    Outcome,
    judged,
    measure_causes,
    pair,
    print_causes,
    print_summary,
    refused,
)
from benchmarks.corruption_sessions import (
    Detector,
    Samples,
    calibrate_by,
    recorded_samples,
    simulated_samples,
)
from benchmarks.recordings import SETS
from benchmarks.tables import print_head, print_row
from lce_rig.core.calibration import Method
from lce_rig.core.errors import LceRigError
from lce_rig.core.geometry import Array
from lce_rig.detect.detection import Detections
from lce_rig.rig import Rig

_TITLE = "error deg / mm, reported deg / mm, in sigmas"
_SIMULATED = ("rlfs", "rles")
# Simulated by others, and kept for measurements after a delivery.
_NOT_OF_FRAMES = ("sss_noise15mm", "rles03")
_RECORDED = {
    each.name: replace(each, folders=each.folders[:1]) for each in SETS if each.name not in _NOT_OF_FRAMES
}
_REASON_LENGTH = 120


def bench_corruptions(
    only: str = "", kinds: str = "", method: str | None = None, n_jobs: int = 1, n_draws: int = 0
) -> None:
    """Print what becomes of corrupted sessions: a table of each session, and counts by verdict and cause.

    Args:
        only: the session of this name, or those whose name contains it.
        kinds: corruptions whose name contains this, beside the sound session.
        method: of the calibration; None for all.
        n_jobs: processes, each of which works on one session.
        n_draws: where positive, calibrate so many random halves of each sound session instead.
    """
    methods = tuple(each for each in METHODS if method in (None, each))
    names = [only] if only in _names() else [name for name in _names() if only in name]
    with ProcessPoolExecutor(max(n_jobs, 1)) as pool:
        if n_draws:
            print_draws(pool.map(partial(_drawn, methods=methods, n_draws=n_draws), names))
            return
        sessions = pool.map(partial(_judged, methods=methods, kinds=kinds), names)
        every = [
            outcome
            for name, rows in zip(names, sessions, strict=True)
            for outcome in _print_session(name, rows)
        ]
    for name, calibrate_all in OTHERS.items():
        if only not in name or kinds:
            continue
        print(f"\n### {name}\n")
        print_head(
            "corruption", *f"session, method: verdict, {_TITLE}".split(", "), "first cause", "first reason"
        )
        for outcome in calibrate_all(methods):
            cells = outcome.verdict, pair(outcome.error), pair(outcome.reported), f"{outcome.in_sigmas:.1f}"
            reason = outcome.cause or "-", _shortened(outcome.reason)
            print_row(outcome.corruption, outcome.session, outcome.method, *cells, *reason)
            every.append(outcome)
    print("\n`*` The data cannot show it:\n")
    for kind in corruptions():
        if kind.unobservable and kinds in kind.name:
            print(f"- {kind.name}: {kind.unobservable}")
    print("\n### Together\n")
    print_summary(every)
    print("\n### Causes\n")
    print_causes(every)
    measure_causes(every)


def judge_session(
    samples: Samples, kinds: Sequence[Corruption], methods: Sequence[Method] = METHODS
) -> Iterator[list[Outcome]]:
    """Calibrate a session under each corruption, by each method.

    Without a known truth an error is the difference from the same method's result on the sound session.

    Args:
        samples: the sound session.
        kinds: the corruptions that it lends itself to are tried.
        methods: of the calibration.
    """
    detector = Detector(samples)
    truths = {method: _truth(samples, detector, method) for method in methods}
    for number, kind in enumerate(kinds, start=1):
        print(f"{samples.name}: {number} of {len(kinds)}: {kind.name}", file=sys.stderr, flush=True)
        try:
            corrupted = kind.corrupt(samples)
        except LceRigError as error:
            # The corrupted profile is invalid: a user would get this error.
            yield [refused(_blank(samples.rig, samples, kind, method), error) for method in methods]
            continue
        if corrupted is not None:
            found = detector.detect(corrupted)
            if kind.spoil is not None:
                found = kind.spoil(samples.rig, found, truths[methods[0]])
            yield [_judge(samples.rig, corrupted, kind, found, method, truths[method]) for method in methods]


def _names() -> list[str]:
    names = list(_SIMULATED)
    if os.environ.get("LCE_RIG_DATA"):
        names += [name for name, recorded in _RECORDED.items() if recorded.is_there]
    return names


def _samples(name: str) -> Samples:
    return simulated_samples(name) if name in _SIMULATED else recorded_samples(_RECORDED[name])


def _judged(name: str, methods: Sequence[Method], kinds: str) -> list[list[Outcome]]:
    chosen = [kind for kind in corruptions() if kind.name == SOUND or kinds in kind.name]
    try:
        return list(judge_session(_samples(name), chosen, methods))
    except LceRigError as error:
        print(f"{name}: the sound session: {error}", file=sys.stderr, flush=True)
        return []


def _drawn(name: str, methods: Sequence[Method], n_draws: int) -> list[Draws]:
    samples = _samples(name)
    found = Detector(samples).detect(samples)
    return [draw_halves(samples, method, n_draws, found) for method in methods]


def _print_session(name: str, rows: Sequence[Sequence[Outcome]]) -> list[Outcome]:
    print(f"\n### {name}{'' if name in _SIMULATED else ' (recorded)'}\n")
    if not rows:
        print("The sound session cannot be calibrated.")
        return []
    titles = [f"{outcome.method}: verdict, {_TITLE}, first cause".split(", ") for outcome in rows[0]]
    print_head("corruption", *(title for columns in titles for title in columns), "first reason")
    for outcomes in rows:
        print_row(*_cells(outcomes))
    return [outcome for outcomes in rows for outcome in outcomes]


def _truth(samples: Samples, detector: Detector, method: Method) -> Array:
    if samples.T_cam_lidar is not None:
        return samples.T_cam_lidar
    return calibrate_by(samples.rig, detector.detect(samples), method).T_cam_lidar


def _judge(
    sound: Rig, samples: Samples, kind: Corruption, found: Detections, method: Method, T_cam_lidar: Array
) -> Outcome:
    """Calibrate a corrupted session; `sound` is its profile before."""
    blank = _blank(sound, samples, kind, method)
    try:
        calibration = calibrate_by(samples.rig, found, method)
    except LceRigError as error:
        return refused(blank, error)
    except Exception as error:
        # A study of hours continues after a program fault, and records it as the cause.
        traceback.print_exc()
        return replace(blank, cause=type(error).__name__, reason=str(error))
    return judged(samples.rig, blank, calibration, T_cam_lidar @ samples.T_lidar_moved)


def _blank(sound: Rig, samples: Samples, kind: Corruption, method: Method) -> Outcome:
    """Start an outcome with the figures known before the calibration."""
    what = samples.name, kind.name, method, kind.unobservable, "refused", ""
    return Outcome(*what, expected=kind.causes, faults=samples.faults, is_beyond=kind.is_beyond(sound))


def _cells(outcomes: Sequence[Outcome]) -> Iterator[str]:
    yield outcomes[0].corruption + (" *" if outcomes[0].unobservable else "")
    for outcome in outcomes:
        yield outcome.verdict
        yield pair(outcome.error)
        yield pair(outcome.reported)
        yield f"{outcome.in_sigmas:.1f}" if outcome.error else "-"
        yield outcome.cause or "-"
    reasons = [outcome.reason for outcome in outcomes if outcome.reason]
    yield _shortened(reasons[0]) if reasons else ""


def _shortened(reason: str) -> str:
    line = reason.replace("|", "/").replace("\n", " ")
    return line if len(line) <= _REASON_LENGTH else line[:_REASON_LENGTH].rsplit(" ", 1)[0] + " ..."
