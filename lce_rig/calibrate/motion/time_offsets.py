"""Time offsets of each channel's images, from boards that moved.

The cost of Algorithm 1 is a function of the channels' time offsets o: each o gives every capture another pose
of the board at the time the LiDAR saw it (`board_motion`), and the extrinsics are solved again,

    C(o) = min_T sum_k rho(c_k(T, o) / u) + rho(m_k(o)) + l_k(o) + sum_c (o_c / sigma_c)^2                (1)

with c_k the cost of capture k, u its typical size, m_k + l_k = -2 ln p of its images' poses (offsets of two
channels that nearly agree would need boards faster than hands), and rho bounding the influence of one
capture.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product

import numpy as np

from lce_rig.calibrate.algorithm_1.moments import Problem, Weights
from lce_rig.calibrate.covariance import symmetric_inverse
from lce_rig.calibrate.features import CaptureFeatures, extract_features, place_features
from lce_rig.calibrate.motion.board_motion import BoardMotions, PoseSamples, board_time_s, deskew, fit_motions
from lce_rig.calibrate.options import EstimateSettings
from lce_rig.calibrate.plane_and_ends import along_normals, differentiate
from lce_rig.core.board import Board
from lce_rig.core.geometry import Array, difference
from lce_rig.core.results import Observation

_REACH_S, _GRID_S = 0.2, 0.04
_STEP_S = 0.004
_N_ITERATIONS = 6
_CONVERGED_S = 5e-4
# A capture's squared term of this size has half weight; it has three to six degrees of freedom.
_ROBUST = 12.0
_FREEDOMS = 3


@dataclass(frozen=True, eq=False)
class TimeOffsets:
    """Offsets from the timestamps of each channel's images to the LiDAR's time.

    Attributes:
        channels: names.
        offset_s: (C,).
        cov: (C, C) s^2, from the scatter between captures.
        sensitivity: (6, C) change of the extrinsics (m, rad) per second of each offset.
    """

    channels: tuple[str, ...]
    offset_s: Array
    cov: Array
    sensitivity: Array


def at_scan_time(
    observations: Sequence[Observation], motions: BoardMotions, sweep_s: float
) -> list[Observation]:
    """Replace the board's pose of every capture by that at the LiDAR's time.

    Args:
        observations: of F captures.
        motions: of the board in them.
        sweep_s: of the LiDAR.
    """
    times_s = np.array([board_time_s(observation.lidar, sweep_s) for observation in observations])
    return [
        replace(o, image=replace(o.image, T_cam_board=T, cov=cov, T_cam_board_alternative=None))
        for o, T, cov in zip(observations, motions.at(times_s), motions.cov_at(times_s), strict=True)
    ]


def deskew_points(
    observations: Sequence[Observation], motions: BoardMotions, T_cam_lidar: Array
) -> list[Observation]:
    """Motion-compensate the points of boards to one time.

    Args:
        observations: of F captures.
        motions: of the board in them.
        T_cam_lidar: (4, 4), accurate to a few degrees; it only rotates the rates of motion.
    """
    R_cam_lidar = T_cam_lidar[:3, :3]
    rates = np.concatenate([motions.rates[:, :3] @ R_cam_lidar, motions.rates[:, 3:] @ R_cam_lidar], axis=1)
    return [replace(o, lidar=deskew(o.lidar, rate)) for o, rate in zip(observations, rates, strict=True)]


def estimate_time_offsets(
    samples: PoseSamples,
    observations: Sequence[Observation],
    board: Board,
    options: EstimateSettings,
    weights: Weights,
    T_start: Array,
    *,
    prior_sigma_s: Array,
    sweep_s: float,
) -> TimeOffsets:
    """Minimise (1).

    Args:
        samples: the poses of F captures by channel.
        observations: the same captures with the LiDAR's boards and any channel's image.
        board: its size.
        options: switches of the features.
        weights: of the cost's terms.
        T_start: (4, 4) T_cam_lidar without compensation.
        prior_sigma_s: (C,) prior standard deviation of each offset.
        sweep_s: of the LiDAR.
    """
    offset_s = _search_grid(samples, observations, T_start, prior_sigma_s, sweep_s)
    observations = deskew_points(observations, fit_motions(samples, offset_s), T_start)
    cost = _Cost(
        samples,
        [extract_features(observation, board, options.parts.features) for observation in observations],
        np.array([board_time_s(observation.lidar, sweep_s) for observation in observations]),
        board,
        weights,
        precision=np.diag(prior_sigma_s**-2.0),
    )
    offset_s, slopes = _descend(cost, offset_s, T_start)
    inverse = symmetric_inverse(slopes.hessian + cost.precision)
    few = len(observations) / max(len(observations) - len(offset_s) - 6, 1)
    cov = inverse @ (few * slopes.gradients.T @ slopes.gradients + cost.precision) @ inverse
    # Uninformative captures scatter little: the variance must not be below that from the curvature of (1).
    widen = np.sqrt(np.maximum(np.diag(inverse) / np.diag(cov), 1.0))
    return TimeOffsets(samples.channels, offset_s, np.asarray(widen[:, None] * cov * widen), slopes.T_rates)


@dataclass(frozen=True, eq=False)
class _Cost:
    """Equation (1) for F captures, whose boards the LiDAR saw at times (F,) after their scans' timestamps."""

    samples: PoseSamples
    features: Sequence[CaptureFeatures]
    times_s: Array
    board: Board
    weights: Weights
    precision: Array

    def at(self, offset_s: Array, T_start: Array) -> "_Evaluation":
        """Solve for the extrinsics at offsets (C,), from T_cam_lidar (4, 4) nearby."""
        motions = fit_motions(self.samples, offset_s)
        poses = zip(self.features, motions.at(self.times_s), motions.cov_at(self.times_s), strict=True)
        placed = [place_features(f, T_cam_board, cov, self.board) for f, T_cam_board, cov in poses]
        problem = Problem(placed, self.board, self.weights)
        solution = problem.solve(np.ones((1, problem.n_captures)), T_start, 2)
        plane, edge = problem.errors(solution.x)
        cost = self.weights.plane * plane[0] ** 2 + self.weights.edge * edge[0] ** 2
        return _Evaluation(cost, motions, solution.T[0], float(offset_s @ self.precision @ offset_s))


@dataclass(frozen=True, eq=False)
class _Evaluation:
    """Equation (1) at one choice of offsets: c_k (F,), motions, T_cam_lidar (4, 4), the offsets' prior."""

    cost: Array
    motions: BoardMotions
    T: Array
    prior: float

    def by_capture(self, unit: float) -> Array:
        """Compute the terms (F,) of the captures, halved."""
        return np.asarray(_rho(self.cost / unit) + _rho(self.motions.misfit) + self.motions.log_volume) / 2

    def total(self, unit: float) -> float:
        return float(np.sum(self.by_capture(unit))) + self.prior / 2


def _rho(squared: Array) -> Array:
    return np.asarray(_ROBUST * np.log1p(squared / _ROBUST))


@dataclass(frozen=True, eq=False)
class _Slopes:
    """Derivatives of half of (1), without its prior, by the offsets.

    Attributes:
        gradients: (F, C) of each capture.
        hessian: (C, C) of all.
        T_rates: (6, C) of the extrinsics' tangent.
    """

    gradients: Array
    hessian: Array
    T_rates: Array


def _descend(cost: _Cost, offset_s: Array, T_start: Array) -> tuple[Array, _Slopes]:
    """Minimise (1) by Newton steps, shortened if the cost rises: the offsets (C,), slopes near them."""
    here = cost.at(offset_s, T_start)
    for _ in range(_N_ITERATIONS):
        unit = float(np.median(here.cost)) / _FREEDOMS
        slopes = _differentiate(cost, offset_s, here, unit)
        gradient = slopes.gradients.sum(axis=0) + cost.precision @ offset_s
        step = symmetric_inverse(slopes.hessian + cost.precision) @ gradient
        step *= min(1.0, _GRID_S / max(float(np.max(np.abs(step))), 1e-9))
        if np.max(np.abs(step)) < _CONVERGED_S:
            break
        there = cost.at(offset_s - step, here.T)
        while there.total(unit) > here.total(unit) and np.max(np.abs(step)) > _CONVERGED_S:
            step /= 3
            there = cost.at(offset_s - step, here.T)
        if there.total(unit) > here.total(unit):
            break
        offset_s, here = offset_s - step, there
    return offset_s, slopes


def _differentiate(cost: _Cost, offset_s: Array, here: _Evaluation, unit: float) -> _Slopes:
    """Differentiate numerically at offsets (C,); costs of captures count in units of `unit`."""
    n = len(offset_s)
    steps = _STEP_S * np.eye(n)
    middle = here.by_capture(unit)
    ahead, behind = ([cost.at(offset_s + sign * step, here.T) for step in steps] for sign in (1, -1))
    up, down = ([e.by_capture(unit) for e in side] for side in (ahead, behind))
    g = np.stack([(a - b) / (2 * _STEP_S) for a, b in zip(up, down, strict=True)], axis=1)
    H = np.zeros((n, n))
    for i in range(n):
        H[i, i] = float(np.sum(up[i] + down[i] - 2 * middle)) / _STEP_S**2
        for j in range(i):
            corner = cost.at(offset_s + steps[i] + steps[j], here.T).by_capture(unit)
            H[i, j] = H[j, i] = float(np.sum(corner - up[i] - up[j] + middle)) / _STEP_S**2
    rates = [difference(a.T, b.T) / (2 * _STEP_S) for a, b in zip(ahead, behind, strict=True)]
    # Far from the minimum the curvature may be negative.
    values, vectors = np.linalg.eigh(H)
    return _Slopes(g, np.asarray((vectors * np.abs(values)) @ vectors.T), np.stack(rates, axis=1))


def _search_grid(
    samples: PoseSamples, observations: Sequence[Observation], T: Array, prior_sigma_s: Array, sweep_s: float
) -> Array:
    """Find the offsets (C,) with the boards' middles closest to the camera's planes, on a coarse grid."""
    lidars = [observation.lidar for observation in observations]
    times_s = np.array([board_time_s(lidar, sweep_s) for lidar in lidars])
    middles = np.array([lidar.points.mean(axis=0) for lidar in lidars])
    ticks = np.arange(-_REACH_S, _REACH_S + _GRID_S / 2, _GRID_S)
    best, best_cost = np.zeros(len(samples.channels)), np.inf
    for ticks_s in product(ticks, repeat=len(samples.channels)):
        offset_s = np.array(ticks_s)
        motions = fit_motions(samples, offset_s)
        T_cam_board = motions.at(times_s)
        depth = along_normals(T_cam_board[:, :3, 2], T_cam_board[:, :3, 3], middles, T)
        # The extrinsics adapt: what their six small motions explain is no residual.
        J = differentiate(T_cam_board[:, :3, 2], middles @ T[:3, :3].T)
        misfit = np.abs(depth - J @ np.linalg.lstsq(J, depth, rcond=None)[0])
        cost = 2 * len(misfit) * np.log(np.median(misfit) + 1e-3)
        cost += np.sum(_rho(motions.misfit) + motions.log_volume)
        cost += np.sum((offset_s / prior_sigma_s) ** 2)
        if cost < best_cost:
            best, best_cost = offset_s, float(cost)
    return best
