"""Sessions calibrated with a profile with a wrong focal length, principal point or square size."""

from collections import Counter
from pathlib import Path
from typing import get_args

import numpy as np

from benchmarks.measured import measure
from benchmarks.profile_errors import draw_session
from benchmarks.still_sessions import still_session
from benchmarks.tables import print_head, print_row, rms
from benchmarks.uncertainty import CORNER_SIGMA_PX, error_in_use
from lce_rig.calibrate import CalibrateOptions
from lce_rig.core.calibration import Method
from lce_rig.judge.findings import Verdict
from lce_rig.pipeline.calibration import calibrate_detections
from lce_rig.rig import Rig, load_rig
from lce_rig.simulate import SimulationOptions

_RIG = "rlfs"
# Factor of the focal length, shift of the principal point in both directions, factor of the squares.
_WRONG: dict[str, tuple[float, float, float]] = {
    "nothing": (1.0, 0.0, 1.0),
    "focal length 2 % too long": (1.02, 0.0, 1.0),
    "focal length 2 % too short": (0.98, 0.0, 1.0),
    "principal point 10 px off": (1.0, 10.0, 1.0),
    "squares 1 % too large": (1.0, 0.0, 1.01),
    "all three": (1.02, 10.0, 1.01),
}


def bench_wrong_profiles(n_seeds: int, folder: Path, n_captures: int = 16) -> None:
    """Tabulate errors in use, claims and verdicts under each mistake.

    Args:
        n_seeds: sessions of each.
        folder: where detections are kept.
        n_captures: of each session.
    """
    head = "wrong in the profile, method, rms deg / mm, claimed deg / mm, chi-squared, largest"
    print_head(*head.split(", "), "pass, marginal, fail")
    rig = load_rig(_RIG)
    options = SimulationOptions.for_rig(_RIG)
    for label, (focal, shift_px, squares) in _WRONG.items():
        profile = _mistaken(rig, focal, shift_px, squares)
        for method in get_args(Method):
            errors, covs, verdicts = [], [], Counter[Verdict]()
            for seed in range(n_seeds):
                session = still_session(rig, seed, options, n_captures, CORNER_SIGMA_PX, folder)
                found, lens = draw_session(rig, profile, session, seed, CORNER_SIGMA_PX)
                (calibration,), _ = calibrate_detections(profile, found, CalibrateOptions(method=method))
                errors.append(error_in_use(calibration, session.T_cam_lidar, lens))
                covs.append(calibration.cov)
                verdicts[calibration.verdict] += 1
            off, cov = np.array(errors), np.mean(covs, axis=0)
            chi2 = [e @ np.linalg.solve(c, e) for e, c in zip(errors, covs, strict=True)]
            sizes = (
                (
                    np.degrees(rms(np.linalg.norm(off[:, 3:], axis=1))),
                    1e3 * rms(np.linalg.norm(off[:, :3], axis=1)),
                ),
                (np.degrees(np.sqrt(np.trace(cov[3:, 3:]))), 1e3 * np.sqrt(np.trace(cov[:3, :3]))),
            )
            cells = [f"{deg:.2f} / {mm:.1f}" for deg, mm in sizes]
            for what, size in zip(("rms", "claim"), sizes, strict=True):
                measure(f"wrong_profiles.{label}.{method}.{what}", "{:.2f} deg, {:.1f} mm", *size)
            counts = ", ".join(str(verdicts[verdict]) for verdict in get_args(Verdict))
            measure(f"wrong_profiles.{label}.{method}.verdicts", "{}", counts)
            print_row(label, method, *cells, f"{np.mean(chi2):.1f}", f"{max(chi2):.1f}", counts)


def _mistaken(rig: Rig, focal: float, shift_px: float, squares: float) -> Rig:
    (name, camera), board = next(iter(rig.cameras.items())), rig.board
    lens = camera.intrinsics
    wrong = {
        "fx_px": focal * lens.fx_px,
        "fy_px": focal * lens.fy_px,
        "cx_px": lens.cx_px + shift_px,
        "cy_px": lens.cy_px + shift_px,
    }
    changed = camera.model_copy(update={"intrinsics": lens.model_copy(update=wrong)})
    return rig.model_copy(
        update={
            "cameras": {name: changed},
            "board": board.model_copy(update={"square_m": squares * board.square_m}),
        }
    )
