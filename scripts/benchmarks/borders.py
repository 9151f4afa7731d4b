"""Simulated boards with a hidden, smeared or merged border: boards used, and coverage of covariances."""

from collections import Counter
from collections.abc import Callable
from dataclasses import replace

import numpy as np
from bad_borders import SCENES, Scene
from scans import BOARD, Shape, accumulate, cast
from scipy import stats

from benchmarks.measured import measure
from benchmarks.tables import print_head, print_row
from lce_rig.calibrate.likelihood.layout import OWN, State
from lce_rig.calibrate.likelihood.levels import Levels, Priors
from lce_rig.calibrate.likelihood.model import linearise, prior_of, sum_products
from lce_rig.calibrate.likelihood.rays import interior, stack_scans
from lce_rig.core.data import Scan
from lce_rig.core.findings import Refusal
from lce_rig.core.geometry import Array, difference
from lce_rig.core.results import LidarBoard
from lce_rig.detect.finder import BoardFinder
from lce_rig.detect.lidar.measurement import Beam
from lce_rig.detect.lidar.search import Limits
from lce_rig.rig import parse_rig

_PROFILE = """
format_version: 1
name: borders
board: {{inner_corners: [8, 6], square_m: 0.07, width_m: 0.767, height_m: 0.626}}
lidars: {{lidar: {{model: {model}}}}}
cameras:
  cam:
    resolution_px: [1280, 720]
    intrinsics: {{fx_px: 900, fy_px: 900, cx_px: 640, cy_px: 360}}
"""
_NOISE_M = 0.008
_OS1_DEG = np.linspace(-16.6, 16.6, 64)
# Standard deviation of the pose above which a board has no information, m and rad.
_OPEN = 1.0
_PRIORS = Priors(shift_m=1e-3, lateral_m=1e-6, vertical_m=1e-6)


class _PointBeams(BoardFinder):
    """Finds the board for beams without a width, as `scans` casts them."""

    def _limits(self, sensor: str) -> Limits:
        return replace(super()._limits(sensor), beam=Beam(0.0, 0.0, 0.0))


def _vlp_16(shapes: list[Shape], seed: int) -> Scan:
    return cast(shapes, sigma_m=_NOISE_M, seed=seed, stagger=1 / 24)


def _os1_64(shapes: list[Shape], seed: int) -> Scan:
    # Lasers of four columns, with angles that are not multiples of a step.
    return cast(
        shapes, sigma_m=_NOISE_M, seed=seed, elevations_deg=_OS1_DEG, step_deg=360 / 1024, stagger=0.27
    )


def _rosette(shapes: list[Shape], seed: int) -> Scan:
    return accumulate(shapes, sigma_m=_NOISE_M, seed=seed)


# How each model scans shapes.
_LIDARS: dict[str, Callable[[list[Shape], int], Scan]] = {
    "VLP-16": _vlp_16,
    "OS1-64": _os1_64,
    "unstructured": _rosette,
}


def bench_borders(n_poses: int, only: str = "") -> None:
    """Print a row of each border and LiDAR.

    Args:
        n_poses: of each.
        only: LiDARs or borders whose name contains this.
    """
    print_head("LiDAR", "border", "boards used", "refused by", "chi2 of 6, mean",
               "within 95 % of its claim", "beyond 3 sigma", "middle off, median / largest mm")  # fmt: skip
    for name in _LIDARS:
        for border, scene in SCENES.items():
            if only in f"{name} {border}":
                _bench_one(name, border, scene, n_poses)


def _bench_one(name: str, border: str, scene: Scene, n_poses: int) -> None:
    rig = parse_rig(_PROFILE.format(model=name))
    finder, has_rings = _PointBeams(rig), rig.lidars["lidar"].has_rings
    refused: Counter[str] = Counter()
    chi2, off_mm = [], []
    for seed in range(n_poses):
        shapes, T_lidar_board = scene(seed, has_rings)
        found = finder.scan(_LIDARS[name](shapes, seed))
        if isinstance(found, Refusal):
            refused[found.code] += 1
            continue
        away = [np.linalg.norm(each.T_lidar_board[:3, 3] - T_lidar_board[:3, 3]) for each in found]
        if min(away) > 0.15:
            refused["elsewhere"] += 1
            continue
        board = found[int(np.argmin(away))]
        error, cov = claim_at(board, T_lidar_board)
        chi2.append(float(error @ np.linalg.solve(cov, error)))
        off_mm.append(1e3 * float(np.linalg.norm(error[:3])))
    inside = np.array(chi2) < stats.chi2.ppf(0.95, 6)
    # As improbable as three standard deviations of one unknown.
    beyond = np.array(chi2) > stats.chi2.ppf(1 - 2 * stats.norm.sf(3), 6)
    key = f"borders.{border}.{name}"
    if chi2:
        measure(key, "{} of {}, {:.0f} %", len(chi2), n_poses, 100 * inside.mean())
    print_row(
        name,
        border,
        f"{len(chi2)} of {n_poses}",
        ", ".join(f"{code} {n}" for code, n in refused.most_common()) or "-",
        f"{np.mean(chi2):.1f}" if chi2 else "-",
        f"{inside.mean():.0%}" if chi2 else "-",
        int(beyond.sum()),
        f"{np.median(off_mm):.1f} / {np.max(off_mm):.1f}" if chi2 else "-",
    )


def claim_at(found: LidarBoard, T_lidar_board: Array) -> tuple[Array, Array]:
    """Estimate a board's pose by its own returns and ends; its error and covariance, tangent (6,)."""
    T = upright(T_lidar_board, found.T_lidar_board)
    scans = stack_scans([interior(found, BOARD)], BOARD)
    state = State.without_errors(np.zeros((0, 4, 4)), T[None], len(scans.rings), [])
    for _ in range(4):
        terms = linearise(scans, (), BOARD, state)
        products = sum_products(terms, Levels()).products[0]
        known = prior_of(terms, Levels(), _PRIORS)
        information, gradient = products[:-1, :-1].copy(), products[:-1, -1].copy()
        information[OWN.size :, OWN.size :] += known.information
        gradient[OWN.size :] += known.information @ known.off
        information[:6, :6] += np.eye(6) / _OPEN**2
        step = -np.linalg.solve(information, gradient)
        state = state.moved(step[OWN.size :], step[None, : OWN.size])
    return difference(state.T_lidar_board[0], T), np.linalg.inv(information)[:6, :6]


def upright(T_lidar_board: Array, found: Array) -> Array:
    """Turn the true pose by half a turn where the one found is."""
    return (
        T_lidar_board @ np.diag([-1.0, -1.0, 1.0, 1.0])
        if T_lidar_board[:3, 0] @ found[:3, 0] < 0
        else T_lidar_board
    )
