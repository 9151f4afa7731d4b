"""Time offsets of each channel's images, estimated from moving boards.

The cost of Algorithm 1 is a function of the channels' time offsets o: each o gives every capture another pose
of the board at the time the LiDAR saw it (`board_motion`), and the extrinsics are solved again,

    C(o) = min_T sum_k rho(c_k(T, o) / u) + rho(m_k(o)) + l_k(o) + sum_c (o_c / sigma_c)^2                (1)

with c_k the cost of capture k, u its typical size, m_k + l_k = -2 ln p of its images' poses (offsets of two
channels that nearly agree would need boards faster than hands), and rho bounding the influence of one
capture.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from itertools import product

import numpy as np

from lce_rig.calibrate.algorithm_1.algorithm import Algorithm1
from lce_rig.calibrate.algorithm_1.moments import Problem, Weights
from lce_rig.calibrate.motion.board_motion import (
    BoardMotions,
    PoseSamples,
    board_time_s,
    compensate,
    deskew_points,
    fit_motions,
)
from lce_rig.calibrate.observations import Clocks, SharedScan
from lce_rig.calibrate.plane_and_ends import (
    CaptureFeatures,
    differentiate,
    extract_features,
)
from lce_rig.calibrate.quadratics import symmetric_inverse
from lce_rig.core.board import Board
from lce_rig.core.geometry import Array, difference, transform
from lce_rig.core.results import Observation

MIN_MOVING = 6
"""Fewer captures with images of several times do not determine time offsets."""
# Ratio of mean squared rates to noise above which boards moved.
_MOVED = 1.0
# Prior standard deviations of time offsets, s: for a profile without a tolerance, and for images without
# timestamps, which may have been taken at any time around the scan.
_TOLERANCE_S, _NO_STAMPS_SIGMA_S = 0.05, 0.15
# Offsets searched, and step of the grid, s; step of numerical differences.
_REACH_S, _GRID_S = 0.2, 0.04
_STEP_S = _GRID_S / 10
_N_ITERATIONS = 6
_CONVERGED_S = _STEP_S / 8
# Squared term of a capture at which its weight is halved; it has three to six degrees of freedom.
_ROBUST = 12.0
_FREEDOMS = 3


@dataclass(frozen=True, eq=False)
class Motion:
    """The boards of F scans, and their motion between the scan and its images.

    Attributes:
        scans: scans with their images.
        samples: poses of the board in these.
        T_cam_lidar: (4, 4), accurate to a few degrees; it only rotates the rates of motion.
        sweep_s: duration of a revolution of the LiDAR.
        offset_s: (C,) from the timestamps of each channel's images to the LiDAR's time, in the order of
            `PoseSamples.channels`; None where boards stood still.
        cov: (C, C) s^2, from the scatter between captures.
        sensitivity: (6, C) change of the extrinsics (m, rad) per second of each offset.
    """

    scans: Sequence[SharedScan]
    samples: PoseSamples
    T_cam_lidar: Array
    sweep_s: float
    offset_s: Array | None = None
    cov: Array = field(default_factory=lambda: np.zeros((0, 0)))
    sensitivity: Array = field(default_factory=lambda: np.zeros((6, 0)))

    @property
    def is_seen_by_each(self) -> bool:
        """Whether channels can be compared: boards stood still, or one channel alone shows their motion."""
        return self.offset_s is None or bool(np.mean(self.samples.is_followed.any(axis=1)) > 0.5)

    def observations(self, only: str | None = None) -> list[Observation]:
        """Pair each scan with the board's pose at its time, from all channels or positioned by one alone."""
        kept = [k for k, scan in enumerate(self.scans) if only is None or only in scan.images]
        observations = [self.scans[k].observation(only) for k in kept]
        if self.offset_s is None:
            return observations
        motions = fit_motions(self.samples.select(kept), self.offset_s, only)
        return compensate(observations, motions, self.T_cam_lidar, self.sweep_s)

    def widened(self, cov: Array) -> Array:
        """Add the effect of the time offsets' uncertainty to a covariance (6, 6) of the extrinsics."""
        return np.asarray(cov + self.sensitivity @ self.cov @ self.sensitivity.T)


def estimate_motion(
    scans: Sequence[SharedScan], samples: PoseSamples, board: Board, start: Algorithm1, clocks: Clocks
) -> Motion:
    """Minimise (1), if boards moved.

    Args:
        scans: F of them with their images.
        samples: poses of the board in these.
        board: the board's size.
        start: extrinsics and weights without compensation.
        clocks: clock settings of the sensors.
    """
    still = Motion(scans, samples, start.T_cam_lidar, clocks.sweep_s)
    moving = np.flatnonzero(samples.tells_motion).tolist()
    if len(moving) < MIN_MOVING:
        return still
    samples, scans = samples.select(moving), [scans[k] for k in moving]
    prior_sigma_s = np.zeros(len(samples.channels))
    for c, channel in enumerate(samples.channels):
        images = [(scan.images[channel], scan.lidar) for scan in still.scans if channel in scan.images]
        is_stamped = all(image.stamp_ns is not None and lidar.stamp_ns is not None for image, lidar in images)
        tolerance_s = clocks.tolerance_s.get(channel, _TOLERANCE_S)
        prior_sigma_s[c] = tolerance_s if is_stamped else _NO_STAMPS_SIGMA_S
    observations = [scan.observation() for scan in scans]
    times_s = np.array([board_time_s(observation.lidar, clocks.sweep_s) for observation in observations])
    offset_s = _search_grid(samples, observations, start.T_cam_lidar, prior_sigma_s, times_s)
    swept = deskew_points(observations, fit_motions(samples, offset_s), start.T_cam_lidar)
    cost = _Cost(
        samples,
        [extract_features(observation, board) for observation in swept],
        times_s,
        start.problem.weights,
        precision=np.diag(prior_sigma_s**-2.0),
    )
    offset_s, gradients, hessian, T_rates = cost.minimise(offset_s, start.T_cam_lidar)
    inverse = symmetric_inverse(hessian + cost.precision)
    few = len(observations) / max(len(observations) - len(offset_s) - 6, 1)
    cov = inverse @ (few * gradients.T @ gradients + cost.precision) @ inverse
    # Uninformative captures scatter little, so the variance is at least that from the curvature of (1).
    widen = np.sqrt(np.maximum(np.diag(inverse) / np.diag(cov), 1.0))
    if fit_motions(samples, offset_s).significance <= _MOVED:
        return still
    return replace(still, offset_s=offset_s, cov=widen[:, None] * cov * widen, sensitivity=T_rates)


@dataclass(frozen=True, eq=False)
class _Cost:
    """Equation (1) for F captures with boards seen by the LiDAR at times (F,) after the scan's timestamp."""

    samples: PoseSamples
    features: Sequence[CaptureFeatures]
    times_s: Array
    weights: Weights
    precision: Array

    def at(self, offset_s: Array, T_start: Array) -> "_Evaluation":
        """Solve for the extrinsics at offsets (C,), starting from a nearby T_cam_lidar (4, 4)."""
        motions = fit_motions(self.samples, offset_s)
        poses = zip(self.features, motions.at(self.times_s), motions.cov_at(self.times_s), strict=True)
        problem = Problem([replace(f, T_cam_board=T, cov=cov) for f, T, cov in poses], self.weights)
        solution = problem.solve(np.ones((1, problem.n_captures)), T_start, 2)
        plane, edge = problem.errors(solution.x)
        cost = self.weights.plane * plane[0] ** 2 + self.weights.edge * edge[0] ** 2
        return _Evaluation(cost, motions, solution.T[0], float(offset_s @ self.precision @ offset_s))

    def minimise(self, offset_s: Array, T_start: Array) -> tuple[Array, Array, Array, Array]:
        """Minimise (1) by Newton steps, shortened if the cost rises.

        Returns:
            The offsets (C,), and derivatives of half of (1) without its prior near them: gradients (F, C) of
            each capture, the Hessian (C, C) of all, the rates (6, C) of the extrinsics' tangent.
        """
        here = self.at(offset_s, T_start)
        for _ in range(_N_ITERATIONS):
            unit = float(np.median(here.cost)) / _FREEDOMS
            gradients, hessian, T_rates = self._differentiate(offset_s, here, unit)
            gradient = gradients.sum(axis=0) + self.precision @ offset_s
            step = symmetric_inverse(hessian + self.precision) @ gradient
            step *= min(1.0, _GRID_S / max(float(np.max(np.abs(step))), 1e-9))
            if np.max(np.abs(step)) < _CONVERGED_S:
                break
            there = self.at(offset_s - step, here.T)
            while there.total(unit) > here.total(unit) and np.max(np.abs(step)) > _CONVERGED_S:
                step /= 3
                there = self.at(offset_s - step, here.T)
            if there.total(unit) > here.total(unit):
                break
            offset_s, here = offset_s - step, there
        return offset_s, gradients, hessian, T_rates

    def _differentiate(self, offset_s: Array, here: "_Evaluation", unit: float) -> tuple[Array, Array, Array]:
        """Differentiate numerically at offsets (C,); costs of captures count in units of `unit`."""
        n = len(offset_s)
        steps = _STEP_S * np.eye(n)
        middle = here.by_capture(unit)
        ahead, behind = ([self.at(offset_s + sign * step, here.T) for step in steps] for sign in (1, -1))
        up, down = ([e.by_capture(unit) for e in side] for side in (ahead, behind))
        g = np.stack([(a - b) / (2 * _STEP_S) for a, b in zip(up, down, strict=True)], axis=1)
        H = np.zeros((n, n))
        for i in range(n):
            H[i, i] = float(np.sum(up[i] + down[i] - 2 * middle)) / _STEP_S**2
            for j in range(i):
                corner = self.at(offset_s + steps[i] + steps[j], here.T).by_capture(unit)
                H[i, j] = H[j, i] = float(np.sum(corner - up[i] - up[j] + middle)) / _STEP_S**2
        rates = [difference(a.T, b.T) / (2 * _STEP_S) for a, b in zip(ahead, behind, strict=True)]
        # Far from the minimum the curvature may be negative.
        values, vectors = np.linalg.eigh(H)
        return g, np.asarray((vectors * np.abs(values)) @ vectors.T), np.stack(rates, axis=1)


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


def _search_grid(
    samples: PoseSamples, observations: Sequence[Observation], T: Array, prior_sigma_s: Array, times_s: Array
) -> Array:
    """Search a grid for the offsets (C,) that bring the boards' centres closest to the camera's planes."""
    middles = np.array([observation.lidar.points.mean(axis=0) for observation in observations])
    ticks = np.arange(-_REACH_S, _REACH_S + _GRID_S / 2, _GRID_S)
    best, best_cost = np.zeros(len(samples.channels)), np.inf
    for ticks_s in product(ticks, repeat=len(samples.channels)):
        offset_s = np.array(ticks_s)
        motions = fit_motions(samples, offset_s)
        T_cam_board = motions.at(times_s)
        depth = np.sum((T_cam_board[:, :3, 3] - transform(T, middles)) * T_cam_board[:, :3, 2], axis=1)
        # The extrinsics adapt, so project their six small motions out of the residuals.
        J = differentiate(T_cam_board[:, :3, 2], middles @ T[:3, :3].T)
        misfit = np.abs(depth - J @ np.linalg.lstsq(J, depth, rcond=None)[0])
        cost = 2 * len(misfit) * np.log(np.median(misfit) + 1e-3)
        cost += np.sum(_rho(motions.misfit) + motions.log_volume)
        cost += np.sum((offset_s / prior_sigma_s) ** 2)
        if cost < best_cost:
            best, best_cost = offset_s, float(cost)
    return best
