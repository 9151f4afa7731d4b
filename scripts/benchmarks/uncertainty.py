"""Is the claimed covariance true, and how near is the error to the Cramer-Rao bound of the same captures?"""

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
from typing import get_args

import numpy as np
from scipy.optimize import minimize
from scipy.stats import chi2

from benchmarks.measured import DEG_MM, measure
from benchmarks.profile_errors import with_profile_errors
from benchmarks.still_sessions import StillSession, still_session
from benchmarks.tables import print_head, print_row, rms
from lce_rig.calibrate import CalibrateOptions, EstimateSettings, fit_extrinsic
from lce_rig.calibrate.likelihood.end_density import density
from lce_rig.calibrate.likelihood.fit import extrinsics_by_unknowns
from lce_rig.calibrate.likelihood.images import stack_images
from lce_rig.calibrate.likelihood.layout import END, SHIFTS, State
from lce_rig.calibrate.likelihood.levels import MOST_LOST, Levels, Priors
from lce_rig.calibrate.likelihood.model import Terms, assemble, linearise
from lce_rig.calibrate.likelihood.rays import EdgeRows, interior, stack_scans
from lce_rig.calibrate.plane_and_ends import EDGE_SHIFT_SIGMA_M
from lce_rig.core.calibration import Calibration, Method
from lce_rig.core.camera import Intrinsics
from lce_rig.core.data_sheets import VLP_16
from lce_rig.core.geometry import Array, difference, invert, transform
from lce_rig.core.results import Observation
from lce_rig.detect.detection import Detections, LidarDetection
from lce_rig.detect.finder import BoardFinder
from lce_rig.lens.difference import turn_of_lens
from lce_rig.lens.models import model_of
from lce_rig.pipeline.calibration import calibrate_detections
from lce_rig.rig import Rig, load_rig
from lce_rig.simulate import LidarNoise, SimulationOptions, simulate_captures, truth_extrinsics

CORNER_SIGMA_PX = 0.1
# Largest distance of a candidate in the scan from the board; farther ones are other objects.
_FOUND_M = 0.05
_FREEDOMS = 6
# Of a normal distribution.
_THREE_SIGMAS = 0.9973
# Distance of the point with the tabulated image error.
_POINT_M = 10.0
_DISPLACEMENT = SHIFTS[-2:]
# Scatter of the logarithms of simulated levels about those of recordings.
_WITHIN = 1.5


@dataclass(frozen=True)
class Case:
    """A simulated rig, perhaps with another LiDAR, and its errors beyond the defaults.

    Levels are those of errors that the corners of one image share.
    """

    rig: str
    label: str
    model: str = ""
    range_offset_m: float = 0.0
    edge_growth_m: float | None = None
    levels: Levels | None = None

    def profile(self) -> Rig:
        """Load the profile with the LiDAR's model."""
        rig = load_rig(self.rig)
        ((name, lidar),) = rig.lidars.items()
        other = lidar.model_copy(update={"model": self.model or lidar.model})
        return rig.model_copy(update={"lidars": {name: other}})

    def options(self) -> SimulationOptions:
        """Choose the simulator's options."""
        options = SimulationOptions.for_rig(self.rig)
        lidar = LidarNoise(range_offset_m=self.range_offset_m)
        if self.edge_growth_m is not None:
            lidar = replace(lidar, edge_growth_m=self.edge_growth_m)
        return replace(options, lidar=lidar)


CASES = (
    Case("rlfs", "rlfs"),
    Case("rles", "rles"),
    Case("rlfs", "rlfs, ranges +2 cm, edges +3 mm", range_offset_m=0.02, edge_growth_m=0.003),
)
PROFILES_IN_ERROR = CASES[:2]
WITHOUT_RINGS = (
    Case("mid360", "Mid-360"),
    Case("mid360", "Avia", model="Avia"),
    Case("mid360", "Mid-360, images as recorded", levels=Levels()),
    Case("mid360", "Avia, images as recorded", model="Avia", levels=Levels()),
)
_TWO = "VLP-16 and OS1-64"
_TWO_PROFILE = Path(__file__).parents[2] / "tests/rigs/two_lidars.yaml"


@dataclass(frozen=True, eq=False)
class Run:
    """Errors of one session: tangents (6,), covariances (6, 6)."""

    error: Array
    cov: Array


@dataclass(frozen=True, eq=False)
class BoundedRun(Run):
    """With the bound (6, 6) of its captures."""

    bound: Array


@dataclass(frozen=True, eq=False)
class JudgedRun(Run):
    """With the verdict, and the error of a point 10 m away in the image's middle, claimed and true, px."""

    verdict: str
    point_px: float
    claimed_px: float


def bench_uncertainty(n_seeds: int, folder: Path, only: str = "", n_captures: int = 30) -> None:
    """Tabulate errors, bounds and coverage of the joint estimate, and of every method with profiles in error.

    Args:
        n_seeds: sessions of each case.
        folder: where detections are kept.
        only: cases whose label contains this.
        n_captures: of each session.
    """
    head = (
        "rig, sessions, captures, rms deg / mm, bound deg / mm, ratio, reported deg / mm, NEES (95 % "
        "interval)"
    )
    print_head(*head.split(", "), "95 % regions hold")
    for case in CASES:
        if only in case.label:
            runs = list(_runs(case, n_seeds, folder, n_captures))
            print_row(case.label, len(runs), n_captures, *_cells(runs))
            key = f"uncertainty.{case.label}.exact"
            _measure(key, runs)
            measure(f"{key}.bound", DEG_MM, *_sizes(np.mean([run.bound for run in runs], axis=0)))

    print("\nLiDARs without rings, and two LiDARs to each other\n")
    print_head("LiDAR", *head.split(", ")[1:4], *head.split(", ")[-2:], "95 % regions hold")
    others = {case.label: _runs_without_rings(case, n_seeds, folder, n_captures) for case in WITHOUT_RINGS}
    for label, errors in {**others, _TWO: _runs_of_lidars(n_seeds, n_captures)}.items():
        if only in label:
            found = list(errors)
            print_row(label, n_seeds, n_captures, *_claim_cells(found))
            _measure(f"uncertainty.{label}", found)

    print("\nProfiles in error as their standard deviations say\n")
    print_head(
        "rig", "method", "sessions", "captures", "rms deg / mm", *head.split(", ")[-2:],
        "95 % regions hold", "beyond 3 sigma", "10 m away, rms and reported px", "pass, marginal, fail",
    )  # fmt: skip
    for case, method in product(PROFILES_IN_ERROR, get_args(Method)):
        if only in case.label:
            own = list(_runs_in_error(case, method, n_seeds, folder, n_captures))
            verdicts = Counter(run.verdict for run in own)
            counts = ", ".join(str(verdicts[verdict]) for verdict in ("pass", "marginal", "fail"))
            beyond = sum(nees_of(run) > chi2.ppf(_THREE_SIGMAS, _FREEDOMS) for run in own)
            point = rms([run.point_px for run in own]), rms([run.claimed_px for run in own])
            cells = (*_claim_cells(own), beyond, "{:.2f}, {:.2f}".format(*point), counts)
            print_row(case.label, method, len(own), n_captures, *cells)
            key = f"uncertainty.{case.label}.{method}"
            _measure(key, own)
            measure(f"{key}.point", "{:.2f} px ({:.2f} px reported)", *point)


def _measure(key: str, runs: Sequence[Run]) -> None:
    nees = np.array([nees_of(run) for run in runs])
    measure(f"{key}.sessions", "{}", len(runs))
    measure(f"{key}.rms", DEG_MM, *_rms(runs))
    measure(f"{key}.claim", DEG_MM, *_sizes(np.mean([run.cov for run in runs], axis=0)))
    measure(f"{key}.nees", "{:.1f}", nees.mean())
    measure(f"{key}.regions", "{:.0f} %", 100 * np.mean(nees < chi2.ppf(0.95, _FREEDOMS)))


def _cells(runs: list[BoundedRun]) -> Iterator[str]:
    size, *others = _claim_cells(runs)
    deg, mm = _rms(runs)
    bound_deg, bound_mm = _sizes(np.mean([run.bound for run in runs], axis=0))
    yield size
    yield f"{bound_deg:.4f} / {bound_mm:.2f}"
    yield f"{deg / bound_deg:.2f} / {mm / bound_mm:.2f}"
    yield from others


def _claim_cells(runs: Sequence[Run]) -> Iterator[str]:
    """Print the actual and the reported errors, NEES with its interval, and coverage."""
    deg, mm = _rms(runs)
    claimed_deg, claimed_mm = _sizes(np.mean([run.cov for run in runs], axis=0))
    nees = np.array([nees_of(run) for run in runs])
    low, high = chi2.ppf([0.025, 0.975], _FREEDOMS * len(runs)) / len(runs)
    yield f"{deg:.4f} / {mm:.2f}"
    yield f"{claimed_deg:.4f} / {claimed_mm:.2f}"
    yield f"{nees.mean():.2f} ({low:.2f} to {high:.2f})"
    yield f"{100 * np.mean(nees < chi2.ppf(0.95, _FREEDOMS)):.0f} %"


def nees_of(run: Run) -> float:
    """Compute e^T cov^-1 e, chi square of six freedoms where the claim is true."""
    return float(run.error @ np.linalg.solve(run.cov, run.error))


def _rms(runs: Sequence[Run]) -> tuple[float, float]:
    errors = np.array([run.error for run in runs])
    rotation, translation = (rms(np.linalg.norm(errors[:, part], axis=1)) for part in (slice(3, 6), slice(3)))
    return float(np.degrees(rotation)), float(1e3 * translation)


def _sizes(cov: Array) -> tuple[float, float]:
    return float(np.degrees(np.sqrt(np.trace(cov[3:, 3:])))), float(1e3 * np.sqrt(np.trace(cov[:3, :3])))


def _runs_without_rings(case: Case, n_seeds: int, folder: Path, n_captures: int) -> Iterator[Run]:
    """Estimate from accumulated scans, with an exact profile."""
    rig = case.profile()
    (lidar,) = rig.lidars.values()
    settings = EstimateSettings.of(CalibrateOptions("ml"), lidar)
    for seed in range(n_seeds):
        session = still_session(rig, seed, case.options(), n_captures, CORNER_SIGMA_PX, folder, case.levels)
        estimate = fit_extrinsic(session.candidates, rig.board.to_board(), settings)
        yield Run(difference(estimate.T_cam_lidar, session.T_cam_lidar), estimate.cov)


def _runs_of_lidars(n_seeds: int, n_captures: int) -> Iterator[Run]:
    """Calibrate two LiDARs to each other, without a camera."""
    rig = load_rig(_TWO_PROFILE)
    side = rig.lidars["side"].model_copy(update={"model": "OS1-64"})
    rig = rig.model_copy(update={"lidars": {**rig.lidars, "side": side}})
    finder, pair = BoardFinder(rig), ("front", "side")
    for seed in range(n_seeds):
        scans: dict[str, dict[str, LidarDetection]] = {name: {} for name in pair}
        for capture in simulate_captures(rig, n_captures=n_captures, seed=seed):
            for scan in capture.scans:
                scans[scan.sensor][f"{capture.index:06d}"] = finder.scan(scan)
        (calibration,), _ = calibrate_detections(rig, Detections({}, scans))
        yield Run(difference(calibration.T_cam_lidar, truth_extrinsics(rig, seed)[pair]), calibration.cov)


def _runs_in_error(
    case: Case, method: Method, n_seeds: int, folder: Path, n_captures: int
) -> Iterator[JudgedRun]:
    """Calibrate sessions with profiles whose lens, board and ranges are wrong."""
    rig = load_rig(case.rig)
    for seed in range(n_seeds):
        session = still_session(rig, seed, case.options(), n_captures, CORNER_SIGMA_PX, folder)
        profile, found, lens = with_profile_errors(rig, session, seed, CORNER_SIGMA_PX)
        options = CalibrateOptions(method=method)
        (calibration,), _ = calibrate_detections(profile, found, options)
        error = error_in_use(calibration, session.T_cam_lidar, lens)
        point_px = _point_error_px(calibration, session.T_cam_lidar, lens)
        (claimed_px,) = (u.centre_px for u in calibration.uncertainty if u.distance_m == _POINT_M)
        yield JudgedRun(error, calibration.cov, calibration.verdict, point_px, claimed_px)


def error_in_use(calibration: Calibration, T_cam_lidar: Array, lens: Intrinsics) -> Array:
    """Compute the error (6,) of extrinsics used with their intrinsics, whose errors compensate rotations."""
    assert calibration.intrinsics is not None
    model = model_of(lens)
    wrong = model.vector(calibration.intrinsics) - model.vector(lens)
    turn = turn_of_lens(calibration.intrinsics) @ wrong
    return difference(calibration.T_cam_lidar, T_cam_lidar) + np.append(np.zeros(3), turn)


def _point_error_px(calibration: Calibration, T_cam_lidar: Array, lens: Intrinsics) -> float:
    """Measure how far a point in the image's middle is drawn from where the true camera sees it."""
    assert calibration.intrinsics is not None
    middle = np.array([[(lens.width_px - 1) / 2, (lens.height_px - 1) / 2]])
    point = _POINT_M * calibration.intrinsics.unproject(middle)
    pixel, _ = lens.project(transform(T_cam_lidar @ invert(calibration.T_cam_lidar), point))
    return float(np.linalg.norm(pixel - middle))


def _runs(case: Case, n_seeds: int, folder: Path, n_captures: int) -> Iterator[BoundedRun]:
    rig = load_rig(case.rig)
    board = rig.board.to_board()
    lidar = next(iter(rig.lidars.values()))
    options = EstimateSettings.of(CalibrateOptions("ml"), lidar)
    sessions = [
        still_session(rig, seed, case.options(), n_captures, CORNER_SIGMA_PX, folder)
        for seed in range(n_seeds)
    ]
    at_truth = [_at_truth(rig, session) for session in sessions]
    levels = _true_levels(case.options().lidar or LidarNoise.of(VLP_16), [terms.edges for terms in at_truth])
    priors = Priors(offset_m=options.range_offset_sigma_m, shift_m=EDGE_SHIFT_SIGMA_M)
    for session, terms in zip(sessions, at_truth, strict=True):
        estimate = fit_extrinsic(session.candidates, board, options)
        bound = cramer_rao_bound(terms, levels, priors)
        yield BoundedRun(difference(estimate.T_cam_lidar, session.T_cam_lidar), estimate.cov, bound)


def cramer_rao_bound(terms: Terms, levels: Levels, priors: Priors) -> Array:
    """Compute the covariance (6, 6) below which no estimate gets on average, from a session's captures.

    The inverse of the information of ranges, ring ends and corners at the true poses, with the noise that
    the simulator has. Constant errors of the sensors are unknown, but for what the profile says of them.

    Args:
        terms: at the truth.
        levels: of the simulated noise.
        priors: of the constant errors.
    """
    information = assemble(terms, levels, priors).cost.information
    (J,) = extrinsics_by_unknowns(terms)
    return np.asarray(J @ np.linalg.inv(information) @ J.T)


def _true_levels(noise: LidarNoise, edges: Sequence[EdgeRows]) -> Levels:
    """Ranges and lasers as the simulator's options say, ring ends as they are, no pose error."""
    none = 1e-6
    without = Levels(ring_m=none, own_shift_m=none, tilt_rad=none, spin_rad=none, depth_m=none, across_m=none)
    lidar = replace(without, range_m=noise.range_sigma_m, laser_m=noise.laser_sigma_m)
    return replace(lidar, **_fit_ends(edges))


def _at_truth(rig: Rig, session: StillSession) -> Terms:
    found = [item for item in session.candidates if is_board(session, item)]
    board = rig.board.to_board()
    scans = stack_scans([interior(item.lidar, board) for item in found], board)
    pictures = stack_images(np.arange(len(found)), [item.image for item in found])
    T = session.T_cam_lidar
    T_lidar_board = invert(T) @ np.array([session.T_cam_board[item.capture] for item in found])
    return linearise(
        scans, (pictures,), board, State.without_errors(T[None], T_lidar_board, len(scans.rings), [0])
    )


def is_board(session: StillSession, item: Observation) -> bool:
    """Check whether the candidate in the scan is at the board's true position."""
    T = invert(session.T_cam_lidar) @ session.T_cam_board[item.capture]
    return float(np.linalg.norm(item.lidar.points.mean(axis=0) - T[:3, 3])) < _FOUND_M


def _fit_ends(edges: Sequence[EdgeRows]) -> dict[str, float]:
    """Find the blurs and lost share under which ring ends at the true poses are most probable.

    How far a ring end strays follows from ray-traced footprints, not from a number among the options. The
    beam's width is free.
    """
    rows, step_m, range_m, is_backed = (
        np.concatenate([getattr(e, name) for e in edges])
        for name in ("rows", "step_m", "range_m", "is_backed")
    )

    # The truth has no displacement common to all ring ends.
    by_width_mm = rows[:, END["shifts"]][:, : -len(_DISPLACEMENT)] / 1e3
    n = by_width_mm.shape[1]

    def cost(x: Array) -> float:
        blur = np.exp(np.where(is_backed, x[-1], x[-3])) * range_m / step_m
        lost_share = float(np.exp(min(x[-2], np.log(MOST_LOST))))
        p, _ = density((rows[:, -1] + by_width_mm @ x[:n]) / step_m, blur, lost_share)
        return -float(np.mean(np.log(p)))

    usual = Levels()
    names = ("edge_rad", "lost_share", "backed_rad")
    width_mm = -1e3 * float(np.median(rows[:, -1]))
    start = [width_mm, *np.zeros(n - 1), *(np.log(getattr(usual, name)) for name in names)]
    # A sharper density is flat where it is not zero: the search must not end there.
    levels = start[n:]
    bounds = [(None, None)] * n + [(level - _WITHIN, level + _WITHIN) for level in levels]
    found = minimize(cost, start, method="L-BFGS-B", bounds=bounds).x[n:]
    return dict(zip(names, np.exp(np.minimum(found, [np.inf, np.log(MOST_LOST), np.inf])), strict=True))
