"""Study of corruptions: what the verdict says of sessions that are wrong as a whole, against their error."""

import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import get_args

from benchmarks.corruption_kinds import Corruption, corruptions
from benchmarks.corruption_sessions import (
    N_CAPTURES,
    SEED,
    Detector,
    Samples,
    recorded_samples,
    simulated_samples,
)
from benchmarks.recordings import RIGS, SETS
from benchmarks.tables import compare, print_head, print_row
from lce_rig.calibrate import CalibrateOptions
from lce_rig.core.calibration import Calibration, Method
from lce_rig.core.errors import LceRigError
from lce_rig.core.geometry import Array, sigma_sizes
from lce_rig.detect.detection import Detections, ImageDetection
from lce_rig.detect.finder import BoardFinder
from lce_rig.judge.findings import Verdict
from lce_rig.judge.reach import covariance_alone
from lce_rig.pipeline.calibration import calibrate_detections
from lce_rig.rig import Rig, load_rig
from lce_rig.simulate import SimulationOptions, simulate_captures, truth_extrinsics

METHODS: tuple[Method, ...] = ("paper", "ml")
_SIMULATED = ("rlfs", "rles")
_EXCHANGED = "two_cameras"
_FRAMES_OF = ("rlfs02", "rles01", "rles02", "acfr_vlp16", "os1_64", "vlp32c_left", "vlp32c_right")
_RECORDED = tuple(replace(each, folders=each.folders[:1]) for each in SETS if each.name in _FRAMES_OF)
_VERDICTS = (*get_args(Verdict), "refused")
# An error beyond so many reported standard deviations, or targets of the profile, is a wrong result.
_WRONG = 3.0
_REASON_LENGTH = 120


@dataclass(frozen=True)
class Outcome:
    """What one method made of one session.

    Attributes:
        session, corruption, method: which.
        unobservable: as `Corruption.unobservable`.
        verdict: "refused" where nothing came out.
        reason: the first one.
        error: deg and mm; None where nothing came out.
        reported: standard deviations, deg and mm.
        in_sigmas: the error, as a multiple of what is reported; the larger of rotation and translation.
        in_targets: the same, as a multiple of the profile's targets.
    """

    session: str
    corruption: str
    method: str
    unobservable: str
    verdict: str
    reason: str
    error: tuple[float, float] | None = None
    reported: tuple[float, float] | None = None
    in_sigmas: float = 0.0
    in_targets: float = 0.0

    @property
    def is_wrong(self) -> bool:
        """Whether the error is larger than the reported standard deviations allow."""
        return self.in_sigmas > _WRONG

    @property
    def is_far_off(self) -> bool:
        """Whether it is beyond what the profile asks for as well."""
        return self.is_wrong and self.in_targets > _WRONG


def bench_corruptions(only: str = "") -> None:
    """Print what becomes of corrupted sessions: a table of each session, and counts by verdict.

    Args:
        only: sessions whose name contains this.
    """
    every: list[Outcome] = []
    title = "error deg / mm, reported deg / mm, in sigmas"
    for samples in _sessions(only):
        print(f"\n### {samples.name}{'' if samples.T_cam_lidar is not None else ' (recorded)'}\n")
        columns = [f"{method}: verdict, {title}".split(", ") for method in METHODS]
        print_head("corruption", *columns[0], *columns[1], "first reason")
        for outcomes in judge_session(samples, corruptions()):
            print_row(*_cells(outcomes))
            every += outcomes
    if only in _EXCHANGED:
        print(f"\n### {_EXCHANGED}\n")
        print_head("corruption", *f"camera, method: verdict, {title}".split(", "), "first reason")
        for outcome in exchanged_cameras():
            cells = outcome.verdict, _pair(outcome.error), _pair(outcome.reported), f"{outcome.in_sigmas:.1f}"
            print_row(outcome.corruption, outcome.session, outcome.method, *cells, _shortened(outcome.reason))
            every.append(outcome)
    print("\n`*` The data cannot show it:\n")
    for kind in corruptions():
        if kind.unobservable:
            print(f"- {kind.name}: {kind.unobservable}")
    print("\n### Together\n")
    print_summary(every)


def judge_session(samples: Samples, kinds: Sequence[Corruption]) -> Iterator[list[Outcome]]:
    """Calibrate a session under each corruption, by each method.

    Without a known truth an error is the difference from the same method's result on the sound session.

    Args:
        samples: the sound session.
        kinds: the corruptions that it lends itself to are tried.
    """
    detector = Detector(samples)
    truths = {method: _truth(samples, detector, method) for method in METHODS}
    for kind in kinds:
        try:
            corrupted = kind.corrupt(samples)
        except LceRigError as error:
            # The corrupted profile is none: that is what a user would be told.
            yield [_refused(samples, kind, method, error) for method in METHODS]
            continue
        if corrupted is not None:
            found = detector.detect(corrupted)
            yield [_judge(corrupted, kind, found, method, truths[method]) for method in METHODS]


def exchanged_cameras() -> Iterator[Outcome]:
    """Calibrate two alike cameras as they are, and with their images exchanged."""
    rig = load_rig(RIGS / f"{_EXCHANGED}.yaml")
    options, (lidar,), names = SimulationOptions.for_rig(rig.name), rig.lidars, sorted(rig.cameras)
    truths = truth_extrinsics(rig, SEED, options)
    finder, scans = BoardFinder(rig), {}
    images: dict[str, dict[str, ImageDetection]] = {name: {} for name in names}
    for number, capture in enumerate(
        simulate_captures(rig, n_captures=N_CAPTURES, seed=SEED, options=options)
    ):
        scans[f"{number:06d}"] = finder.scan(capture.scans[0])
        for image in capture.images:
            images[image.sensor][f"{number:06d}"] = finder.image(image)
    for corruption, sources in (("none", names), ("images of the cameras exchanged", names[::-1])):
        of_names = {(n, "frames"): images[source] for n, source in zip(names, sources, strict=True)}
        for method in METHODS:
            found = Detections(of_names, {lidar: scans})
            for calibration in calibrate_detections(rig, found, CalibrateOptions(method=method))[0]:
                truth, camera = truths[calibration.camera, lidar], f"{_EXCHANGED} {calibration.camera}"
                yield _outcome(rig, (camera, corruption, method, ""), calibration, truth)


def print_summary(outcomes: Sequence[Outcome]) -> None:
    """Count by method and verdict, and name every wrong result that passes.

    Args:
        outcomes: of all sessions; sound ones are not counted.
    """
    corrupted = [outcome for outcome in outcomes if outcome.corruption != "none"]
    head = "method, verdict, calibrations, error over 3 sigmas, of them over 3 targets, worst in sigmas"
    print_head(*head.split(", "), "over 3 sigmas where the data cannot show it")
    for method in METHODS:
        for verdict in _VERDICTS:
            found = [o for o in corrupted if (o.method, o.verdict) == (method, verdict)]
            shown = [o for o in found if not o.unobservable]
            worst = max((o.in_sigmas for o in shown), default=0.0)
            print_row(
                method,
                verdict,
                len(found),
                sum(o.is_wrong for o in shown),
                sum(o.is_far_off for o in shown),
                f"{worst:.1f}" if verdict != "refused" else "-",
                sum(o.is_wrong for o in found) - sum(o.is_wrong for o in shown),
            )
    print("\nWrong and passed:\n")
    print_head(
        "session", "corruption", "method", "error deg / mm", "in sigmas", "in targets", "why it passes"
    )
    for o in corrupted:
        if o.is_wrong and o.verdict == "pass":
            why = f"the data cannot show it: {o.unobservable}" if o.unobservable else "overconfident"
            figures = f"{o.in_sigmas:.1f}", f"{o.in_targets:.1f}"
            print_row(o.session, o.corruption, o.method, _pair(o.error), *figures, why)


def _sessions(only: str) -> Iterator[Samples]:
    for name in _SIMULATED:
        if only in name:
            yield simulated_samples(name)
    if os.environ.get("LCE_RIG_DATA"):
        for recorded in _RECORDED:
            if only in recorded.name and recorded.is_there:
                yield recorded_samples(recorded)


def _truth(samples: Samples, detector: Detector, method: Method) -> Array:
    if samples.T_cam_lidar is not None:
        return samples.T_cam_lidar
    return _calibrate(samples.rig, detector.detect(samples), method).T_cam_lidar


def _judge(
    samples: Samples, kind: Corruption, found: Detections, method: Method, T_cam_lidar: Array
) -> Outcome:
    try:
        calibration = _calibrate(samples.rig, found, method)
    except LceRigError as error:
        return _refused(samples, kind, method, error)
    what = samples.name, kind.name, method, kind.unobservable
    return _outcome(samples.rig, what, calibration, T_cam_lidar @ samples.T_lidar_moved)


def _outcome(rig: Rig, what: tuple[str, str, str, str], calibration: Calibration, truth: Array) -> Outcome:
    error_deg, error_mm = compare(calibration.T_cam_lidar, truth)
    # The truth is a pose alone, whatever the intrinsics.
    sigma_deg, sigma_m = sigma_sizes(covariance_alone(calibration))
    sigma_mm = 1000 * sigma_m
    return Outcome(
        *what,
        calibration.verdict,
        calibration.findings[0].sentence if calibration.findings else "",
        (error_deg, error_mm),
        (sigma_deg, sigma_mm),
        max(error_deg / sigma_deg, error_mm / sigma_mm),
        rig.calibration.in_targets(error_deg, error_mm / 1000),
    )


def _calibrate(rig: Rig, found: Detections, method: Method) -> Calibration:
    calibration, *_ = calibrate_detections(rig, found, CalibrateOptions(method=method))[0]
    return calibration


def _refused(samples: Samples, kind: Corruption, method: Method, error: LceRigError) -> Outcome:
    reason = f"{error.what}: {error.hint}" if error.hint else error.what
    return Outcome(samples.name, kind.name, method, kind.unobservable, "refused", reason)


def _cells(outcomes: Sequence[Outcome]) -> Iterator[str]:
    yield outcomes[0].corruption + (" *" if outcomes[0].unobservable else "")
    for outcome in outcomes:
        yield outcome.verdict
        yield _pair(outcome.error)
        yield _pair(outcome.reported)
        yield f"{outcome.in_sigmas:.1f}" if outcome.error else "-"
    reasons = [outcome.reason for outcome in outcomes if outcome.reason]
    yield _shortened(reasons[0]) if reasons else ""


def _pair(figures: tuple[float, float] | None) -> str:
    return "-" if figures is None else f"{figures[0]:.2f} / {figures[1]:.1f}"


def _shortened(reason: str) -> str:
    line = reason.replace("|", "/").replace("\n", " ")
    return line if len(line) <= _REASON_LENGTH else line[:_REASON_LENGTH].rsplit(" ", 1)[0] + " ..."
