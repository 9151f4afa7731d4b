"""Study of faults: how often a wrong result passes, and how often a sound session is refused."""

import sys
import tempfile
from collections import Counter
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from benchmarks.fault_kinds import KINDS, Case
from benchmarks.fault_sessions import rig_with_drawing, simulated_scans
from benchmarks.tables import compare, print_head, print_row
from lce_rig import pipeline
from lce_rig.calibrate import CalibrateOptions
from lce_rig.core.errors import NotEnoughDataError
from lce_rig.rig import Rig
from lce_rig.words import sentence

_RIG = "rlfs"
_N_DRAWS = 20
_WRONG = 3.0
_VERDICTS = ("pass", "marginal", "fail", "refused")


@dataclass(frozen=True)
class Outcome:
    """What became of one session: error in units of the profile's target; infinite where nothing came out."""

    verdict: str
    error: float
    reasons: tuple[str, ...]

    @property
    def is_wrong(self) -> bool:
        """Whether the result is off by more than three times the target."""
        return np.isfinite(self.error) and self.error > _WRONG


def bench_faults(n_seeds: int, folder: Path | None = None, n_sessions: int = 100) -> None:
    """Print what becomes of sessions with each fault.

    Args:
        n_seeds: sessions with each fault.
        folder: where simulated sessions are kept.
        n_sessions: simulated; with fewer than seeds, several seeds share the scans of one.
    """
    folder = folder or Path(tempfile.gettempdir()) / "lce-rig-benchmarks" / "faults"
    rig = rig_with_drawing(_RIG)
    outcomes: dict[str, list[Outcome]] = {kind: [] for kind in KINDS}
    for seed in range(n_seeds):
        scans = simulated_scans(rig, seed % n_sessions, folder)
        for number, (kind, spoil) in enumerate(KINDS.items()):
            outcome = _calibrate(spoil(scans, rig, np.random.default_rng([seed, number])))
            outcomes[kind].append(outcome)
            is_missed = outcome.verdict == "pass" and outcome.is_wrong
            if is_missed or (kind == "none" and outcome.verdict != "pass"):
                print(f"seed {seed}, {kind}: {outcome}", file=sys.stderr, flush=True)
    print_head("fault", "runs", "wrong", "wrong and pass", *_VERDICTS, "largest error that passes")
    for kind, found in outcomes.items():
        counts = Counter(outcome.verdict for outcome in found)
        passing = [outcome.error for outcome in found if outcome.verdict == "pass"]
        wrong = [outcome for outcome in found if outcome.is_wrong]
        print_row(
            kind,
            len(found),
            len(wrong),
            sum(outcome.verdict == "pass" for outcome in wrong),
            *(counts[verdict] for verdict in _VERDICTS),
            f"{max(passing):.1f}" if passing else "-",
        )


def _calibrate(case: Case) -> Outcome:
    rig: Rig = case.rig
    camera, lidar = next(iter(rig.cameras)), next(iter(rig.lidars))
    detections = pipeline.Detections({(camera, "frames"): case.images}, {lidar: case.scans})
    options = CalibrateOptions(n_draws=_N_DRAWS)
    try:
        calibration, *_ = pipeline.calibrate_detections(rig, detections, options)[0]
    except NotEnoughDataError as error:
        return Outcome("refused", float("inf"), (str(error),))
    rotation_deg, translation_mm = compare(calibration.T_cam_lidar, case.T_cam_lidar)
    error = rig.calibration.in_targets(rotation_deg, translation_mm / 1000)
    return Outcome(calibration.verdict, error, tuple(map(sentence, calibration.findings)))
