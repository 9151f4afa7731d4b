"""A result's cost to second order, capture by capture: what any share of the captures would have given.

Every check that leaves captures out needs to know how each of them pulls at the result. Half the gradient g_k
and half the Hessian H_k of each capture's cost say it for all shares w of the captures at once:

    x(w) = -(P + sum_k w_k H_k)^-1 sum_k w_k g_k                                                         (1)

The cost is made anew from points, planes and ring ends, whatever method found the extrinsic, so that it is a
second opinion. Unknown beside the extrinsic are the edge shift and the range offset of each laser, with
priors P: otherwise these would look like disagreement between captures.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from lce_rig.calibrate.features import CaptureFeatures, extract_features
from lce_rig.calibrate.options import EDGE_SHIFT_SIGMA_M, CalibrateOptions
from lce_rig.calibrate.placements import group_placements
from lce_rig.core.board import Board
from lce_rig.core.geometry import Array, perturb, transform
from lce_rig.core.results import LidarBoard, Observation
from lce_rig.solvers.covariance import symmetric_inverse

SHIFT, FIRST_RING, SCALE = 6, 7, -1
"""Places in the x of `expand`, after the tangent (translation m, rotation rad): edge shift m, range offset m
of each ring, and last the camera's scale."""

# Errors of a board's plane and of its ring ends are at least as large as this.
_PLANE_FLOOR_M, _END_FLOOR_M = 0.001, 0.002
PLANE_FREEDOMS = 3
# Where a profile states no error of the lasers, their ranges are still no better than this.
_RANGE_FLOOR_M = 0.0005


@dataclass(frozen=True, eq=False)
class Expansion:
    """F captures about an extrinsic.

    Attributes:
        T_cam_lidar: (4, 4) that it is about.
        gradients: (F, p) g_k.
        hessians: (F, p, p) H_k.
        prior: (p, p) P.
        placement: (F,) number of the board placement that a capture shows.
        centres: (F, 3) middle of the board, frame camera, m.
    """

    T_cam_lidar: Array
    gradients: Array
    hessians: Array
    prior: Array
    placement: NDArray[np.intp]
    centres: Array

    @cached_property
    def groups(self) -> Array:
        """(G, F): 1 where a capture shows a placement."""
        numbers = np.arange(int(self.placement.max()) + 1)
        return np.asarray(numbers[:, None] == self.placement, dtype=np.float64)

    def solve(self, shares: Array) -> Array:
        """Compute (1) for B shares (B, F): unknowns (B, p)."""
        H = np.tensordot(shares, self.hessians, axes=1) + self.prior
        return np.asarray(-(symmetric_inverse(H) @ (shares @ self.gradients)[..., None])[..., 0])

    def optimum(self) -> Array:
        """Compute (1) for all captures: (p,)."""
        return np.asarray(self.solve(np.ones((1, len(self.gradients))))[0])

    def without_each(self) -> Array:
        """Compute (1) without each of the placements: (G, p)."""
        return self.solve(1 - self.groups)

    def covariance(self) -> Array:
        """Compute the covariance (p, p) of all captures' unknowns if every error is independent."""
        return symmetric_inverse(self.hessians.sum(axis=0) + self.prior)

    def hold(self, unknown: int) -> "Expansion":
        """Hold an unknown beside the tangent where it is: an expansion in the others."""
        return replace(
            self,
            gradients=np.delete(self.gradients, unknown, axis=1),
            hessians=np.delete(np.delete(self.hessians, unknown, axis=1), unknown, axis=2),
            prior=np.delete(np.delete(self.prior, unknown, axis=0), unknown, axis=1),
        )

    def settled(self) -> "Expansion":
        """Hold what captures share at its estimate: an expansion of the extrinsic alone, at its optimum."""
        x = self.optimum()
        return replace(
            self,
            T_cam_lidar=perturb(self.T_cam_lidar, x[:6]),
            gradients=(self.gradients + self.hessians @ x)[:, :6],
            hessians=self.hessians[:, :6, :6],
            prior=np.zeros((6, 6)),
        )


@dataclass(frozen=True)
class FeatureSigmas:
    """Errors by which planes and ring ends are weighed: how far they lie from the camera's.

    Attributes:
        plane_m: of a capture's plane, rms over the board.
        end_m: of a ring end.
    """

    plane_m: float
    end_m: float


def feature_sigmas(features: Sequence[CaptureFeatures], board: Board, T_cam_lidar: Array) -> FeatureSigmas:
    """Take the typical errors of captures' planes and ring ends under an extrinsic (4, 4)."""
    plane_m = float(np.median([_distance(f, T_cam_lidar) for f in features]))
    beyond = np.concatenate([end_rows(f, T_cam_lidar, board)[0] for f in features])
    # Ring ends reach beyond the plate by the beam's width, which is no error.
    end_m = 1.4826 * float(np.median(np.abs(beyond - np.median(beyond))))
    return FeatureSigmas(max(plane_m, _PLANE_FLOOR_M), max(end_m, _END_FLOOR_M))


def expand(
    observations: Sequence[Observation],
    board: Board,
    T_cam_lidar: Array,
    *,
    laser_bias_sigma_m: float,
    range_offset_sigma_m: float,
) -> Expansion:
    """Expand the cost of captures about an extrinsic.

    A capture counts 3 / sigma_plane^2 times the mean square over its points, and the square of each ring end
    over sigma_end^2, with both sigmas from the captures themselves.

    Args:
        observations: one a capture.
        board: the board.
        T_cam_lidar: (4, 4).
        laser_bias_sigma_m: standard deviation a priori of the lasers' range offsets about their mean.
        range_offset_sigma_m: of that mean.
    """
    features = [extract_features(seen, board, CalibrateOptions()) for seen in observations]
    sigmas = feature_sigmas(features, board, T_cam_lidar)
    rings = np.unique(np.concatenate([seen.lidar.ring for seen in observations]))
    p = FIRST_RING + len(rings) + 1
    gradients, hessians = np.zeros((len(features), p)), np.zeros((len(features), p, p))
    for k, (f, seen) in enumerate(zip(features, observations, strict=True)):
        r_plane, J_plane = _plane_rows(f, seen.lidar, rings, T_cam_lidar)
        r_end, by_end = end_rows(f, T_cam_lidar, board)
        J_end = np.zeros((len(r_end), p))
        J_end[:, [*range(FIRST_RING), SCALE]] = by_end
        by_plane = PLANE_FREEDOMS / (sigmas.plane_m**2 * max(len(r_plane), 1))
        for r, J, weight in ((r_plane, J_plane, by_plane), (r_end, J_end, 1 / sigmas.end_m**2)):
            gradients[k] += weight * r @ J
            hessians[k] += weight * J.T @ J
    return Expansion(
        T_cam_lidar,
        gradients,
        hessians,
        _prior(len(rings), laser_bias_sigma_m, range_offset_sigma_m),
        group_placements(observations),
        np.array([f.centre for f in features]),
    )


def _prior(n_rings: int, laser_m: float, offset_m: float) -> Array:
    """Write priors as information (p, p): of the edge shift, of offsets about their mean, of the mean."""
    prior = np.zeros((FIRST_RING + n_rings + 1, FIRST_RING + n_rings + 1))
    prior[SHIFT, SHIFT] = 1 / EDGE_SHIFT_SIGMA_M**2
    cov = max(laser_m, _RANGE_FLOOR_M) ** 2 * (np.eye(n_rings) - 1 / n_rings)
    prior[FIRST_RING:SCALE, FIRST_RING:SCALE] = np.linalg.inv(cov + max(offset_m, _RANGE_FLOOR_M) ** 2)
    return prior


def _plane_rows(
    f: CaptureFeatures, lidar: LidarBoard, rings: NDArray[np.int16], T: Array
) -> tuple[Array, Array]:
    """Write n . ((1 - s) g - R (p - b u) - t) for each point as measured: values, derivatives (N, p)."""
    points = np.asarray(lidar.points, dtype=np.float64)
    turned = points @ T[:3, :3].T
    J = np.zeros((len(points), FIRST_RING + len(rings) + 1))
    J[:, :3] = -f.normal
    J[:, 3:6] = -np.cross(turned, f.normal)
    J[:, SCALE] = -f.normal @ f.centre
    rays = turned / np.linalg.norm(points, axis=1, keepdims=True)
    J[np.arange(len(points)), FIRST_RING + np.searchsorted(rings, lidar.ring)] = rays @ f.normal
    return np.asarray((f.centre - turned - T[:3, 3]) @ f.normal), J


def end_rows(f: CaptureFeatures, T: Array, board: Board) -> tuple[Array, Array]:
    """Write m . ((1 - s) g + a - R q - t) + d for each ring end and its nearest edge.

    Returns:
        Values (M,), and their derivatives (M, 8) by the tangent (6), d and s.
    """
    turned = f.edge_points @ T[:3, :3].T
    edge = board.nearest_edge(transform(f.T_board_cam @ T, f.edge_points))
    normals, anchors = f.edge_normals[edge], f.edge_anchors[edge]
    J = np.ones((len(turned), 8))
    J[:, :3] = -normals
    J[:, 3:6] = -np.cross(turned, normals)
    J[:, 7] = -normals @ f.centre
    return np.asarray(np.sum((anchors - turned - T[:3, 3]) * normals, axis=1)), J


def _distance(f: CaptureFeatures, T: Array) -> float:
    """Measure how far the LiDAR's plane lies from the camera's, rms over the board, m."""
    points = transform(T, f.plane_points)
    return float(np.sqrt(np.mean(((points - f.centre) @ f.normal) ** 2)))
