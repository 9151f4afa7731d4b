"""Is the claimed covariance true, and how near is the error to the Cramer-Rao bound of the same captures?"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.stats import chi2

from benchmarks.still_sessions import StillSession, still_session
from benchmarks.tables import print_head, print_row, rms
from lce_rig.calibrate import CalibrateOptions, calibrate
from lce_rig.calibrate.likelihood.levels import Levels, Priors
from lce_rig.calibrate.likelihood.picture_terms import stack_pictures
from lce_rig.calibrate.likelihood.refine import to_extrinsic
from lce_rig.calibrate.likelihood.scans import N_FIELDS, stack_scans
from lce_rig.calibrate.likelihood.system import PER_CAMERA, State, assemble, linearise
from lce_rig.core.geometry import Array, difference, invert
from lce_rig.rig import Rig, load_rig
from lce_rig.simulate import SimulationOptions

CORNER_SIGMA_PX = 0.1
_FREEDOMS = 6


@dataclass(frozen=True)
class Case:
    """What is simulated: a rig, and how its LiDAR errs beyond the defaults."""

    rig: str
    label: str
    range_offset_m: float = 0.0
    edge_growth_m: float | None = None

    def options(self) -> SimulationOptions:
        """Choose the simulator's options."""
        options = SimulationOptions.for_rig(self.rig)
        lidar = replace(options.lidar, range_offset_m=self.range_offset_m)
        if self.edge_growth_m is not None:
            lidar = replace(lidar, edge_growth_m=self.edge_growth_m)
        return replace(options, lidar=lidar)


CASES = (
    Case("rlfs", "rlfs"),
    Case("rles", "rles"),
    Case("rlfs", "rlfs, ranges +2 cm, edges +3 mm", range_offset_m=0.02, edge_growth_m=0.003),
)


@dataclass(frozen=True, eq=False)
class Run:
    """Errors of one session: tangents (6,), covariances (6, 6)."""

    error: Array
    cov: Array
    bound: Array


def bench_uncertainty(n_seeds: int, folder: Path, only: str = "", n_captures: int = 30) -> None:
    """Tabulate errors, bounds and coverage of the joint estimate.

    Args:
        n_seeds: sessions of each case.
        folder: where detections are kept.
        only: cases whose label contains this.
        n_captures: of each session.
    """
    head = (
        "rig, sessions, captures, rms deg / mm, bound deg / mm, ratio, claimed deg / mm, NEES (95 % interval)"
    )
    print_head(*head.split(", "), "95 % regions hold")
    for case in CASES:
        if only in case.label:
            runs = list(_runs(case, n_seeds, folder, n_captures))
            print_row(case.label, len(runs), n_captures, *_cells(runs))


def _cells(runs: list[Run]) -> Iterator[str]:
    errors = np.array([run.error for run in runs])
    bound, claimed = (np.mean([getattr(run, name) for run in runs], axis=0) for name in ("bound", "cov"))
    deg, mm = (
        np.degrees(rms(np.linalg.norm(errors[:, 3:], axis=1))),
        rms(np.linalg.norm(errors[:, :3], axis=1)),
    )
    bound_deg, bound_mm = _sizes(bound)
    claimed_deg, claimed_mm = _sizes(claimed)
    nees = np.array([run.error @ np.linalg.solve(run.cov, run.error) for run in runs])
    low, high = chi2.ppf([0.025, 0.975], _FREEDOMS * len(runs)) / len(runs)
    yield f"{deg:.4f} / {1e3 * mm:.2f}"
    yield f"{bound_deg:.4f} / {bound_mm:.2f}"
    yield f"{deg / bound_deg:.2f} / {1e3 * mm / bound_mm:.2f}"
    yield f"{claimed_deg:.4f} / {claimed_mm:.2f}"
    yield f"{nees.mean():.2f} ({low:.2f} to {high:.2f})"
    yield f"{100 * np.mean(nees < chi2.ppf(0.95, _FREEDOMS)):.0f} %"


def _sizes(cov: Array) -> tuple[float, float]:
    return float(np.degrees(np.sqrt(np.trace(cov[3:, 3:])))), float(1e3 * np.sqrt(np.trace(cov[:3, :3])))


def _runs(case: Case, n_seeds: int, folder: Path, n_captures: int) -> Iterator[Run]:
    rig = load_rig(case.rig)
    lidar = next(iter(rig.lidars.values()))
    options = CalibrateOptions(
        method="ml",
        n_draws=0,
        laser_bias_sigma_m=lidar.laser_bias_sigma_m,
        range_offset_sigma_m=lidar.range_offset_sigma_m,
    )
    own = folder / "".join(c if c.isalnum() else "-" for c in case.label)
    for seed in range(n_seeds):
        session = still_session(rig, seed, case.options(), n_captures, CORNER_SIGMA_PX, own)
        estimate = calibrate(session.candidates, rig.board.to_board(), options)
        error = difference(estimate.T_cam_lidar, session.T_cam_lidar)
        yield Run(error, estimate.cov, cramer_rao_bound(rig, session, options, case.options()))


def cramer_rao_bound(
    rig: Rig, session: StillSession, options: CalibrateOptions, simulated: SimulationOptions
) -> Array:
    """Compute the covariance (6, 6) below which no unbiased estimate gets from a session's captures.

    The inverse of the information of ranges, ring ends and corners at the true poses, with the noise that
    the simulator has: ranges and lasers as its options say, ring ends anywhere within their step, corners
    as drawn, and no pose error. Constant errors of the sensors are unknown, but for what the profile says
    of them.
    """
    names = [item.capture for item in session.candidates]
    T_cam_board = np.array([session.T_cam_board[name] for name in names])
    scans = stack_scans([item.lidar[0] for item in session.candidates])
    images = [item.image for item in session.candidates]
    pictures = stack_pictures(np.arange(len(names)), images, np.ones(len(names)))
    n_constants = PER_CAMERA + len(scans.rings) + N_FIELDS + 1
    T = session.T_cam_lidar
    state = State(T[None], invert(T) @ T_cam_board, np.zeros(n_constants))
    terms = linearise(scans, (pictures,), rig.board.to_board(), state)
    tiny = 1e-6
    noise = simulated.lidar_noise
    levels = Levels(noise.range_sigma_m, tiny, tiny, tiny, tiny, tiny, tiny, noise.laser_sigma_m)
    priors = Priors(offset_m=options.range_offset_sigma_m, shift_m=options.edge_shift_sigma_m)
    information = assemble(terms, levels, priors, np.ones(len(scans.end_rays))).information
    J = to_extrinsic(T, 0, n_constants)
    return np.asarray(J @ np.linalg.inv(information) @ J.T)
