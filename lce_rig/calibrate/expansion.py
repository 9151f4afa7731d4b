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

SHIFT, SCALE, FIRST_RING = 6, 7, 8
"""Places in x after the tangent (translation m, rotation rad): edge shift m, scale, range offsets m."""

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
        plane_sigma_m, end_sigma_m: errors by which planes and ring ends are weighed.
        has_scale: whether x has the camera's scale in its place; else what follows the tangent is all alike.
    """

    T_cam_lidar: Array
    gradients: Array
    hessians: Array
    prior: Array
    placement: NDArray[np.intp]
    centres: Array
    plane_sigma_m: float
    end_sigma_m: float
    has_scale: bool = True

    @cached_property
    def groups(self) -> Array:
        """(G, F): 1 where a capture shows a placement."""
        numbers = np.arange(int(self.placement.max()) + 1)
        return np.asarray(numbers[:, None] == self.placement, dtype=np.float64)

    def solve(self, shares: Array, *, is_scale_free: bool = False) -> Array:
        """Compute (1) for B shares (B, F): unknowns (B, p), the camera's scale 0 unless it is free."""
        return self._solve(shares, is_scale_free)[0]

    def covariance(self, *, is_scale_free: bool = False) -> Array:
        """Compute the covariance (p, p) of all captures' unknowns if every error is independent."""
        return np.asarray(self._solve(np.ones((1, len(self.gradients))), is_scale_free)[1][0])

    def _solve(self, shares: Array, is_scale_free: bool) -> tuple[Array, Array]:
        p = self.gradients.shape[1]
        free = np.array([k for k in range(p) if k != SCALE or is_scale_free or not self.has_scale])
        rows, cols = free[:, None], free[None]
        H = np.tensordot(shares, self.hessians[:, rows, cols], axes=1) + self.prior[rows, cols]
        inverse = symmetric_inverse(H)
        x, cov = np.zeros((len(shares), p)), np.zeros((len(shares), p, p))
        x[:, free] = -(inverse @ (shares @ self.gradients[:, free])[..., None])[..., 0]
        cov[:, rows, cols] = inverse
        return x, cov

    def settled(self) -> "Expansion":
        """Hold what captures share at its estimate: an expansion of the extrinsic alone, at its optimum."""
        x = self.solve(np.ones((1, len(self.gradients))))[0]
        return replace(
            self,
            T_cam_lidar=perturb(self.T_cam_lidar, x[:6]),
            gradients=(self.gradients + self.hessians @ x)[:, :6],
            hessians=self.hessians[:, :6, :6],
            prior=np.zeros((6, 6)),
        )


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
    rings = np.unique(np.concatenate([seen.lidar.ring for seen in observations]))
    p = FIRST_RING + len(rings)
    planes = [
        _plane_rows(f, seen.lidar, rings, T_cam_lidar) for f, seen in zip(features, observations, strict=True)
    ]
    ends = [end_rows(f, T_cam_lidar, board, p) for f in features]
    plane_sigma_m = max(float(np.median([_distance(f, T_cam_lidar) for f in features])), _PLANE_FLOOR_M)
    beyond = np.concatenate([r for r, _ in ends])
    # Ring ends reach beyond the plate by the beam's width, which is no error.
    end_sigma_m = max(1.4826 * float(np.median(np.abs(beyond - np.median(beyond)))), _END_FLOOR_M)
    gradients, hessians = np.zeros((len(features), p)), np.zeros((len(features), p, p))
    for k, parts in enumerate(zip(planes, ends, strict=True)):
        by_plane = PLANE_FREEDOMS / (plane_sigma_m**2 * max(len(parts[0][0]), 1))
        for (r, J), weight in zip(parts, (by_plane, 1 / end_sigma_m**2), strict=True):
            gradients[k] += weight * r @ J
            hessians[k] += weight * J.T @ J
    return Expansion(
        T_cam_lidar,
        gradients,
        hessians,
        _prior(len(rings), laser_bias_sigma_m, range_offset_sigma_m),
        group_placements(observations),
        np.array([f.centre for f in features]),
        plane_sigma_m,
        end_sigma_m,
    )


def _prior(n_rings: int, laser_m: float, offset_m: float) -> Array:
    """Write priors as information (p, p): of the edge shift, of offsets about their mean, of the mean."""
    prior = np.zeros((FIRST_RING + n_rings, FIRST_RING + n_rings))
    prior[SHIFT, SHIFT] = 1 / EDGE_SHIFT_SIGMA_M**2
    cov = max(laser_m, _RANGE_FLOOR_M) ** 2 * (np.eye(n_rings) - 1 / n_rings)
    prior[FIRST_RING:, FIRST_RING:] = np.linalg.inv(cov + max(offset_m, _RANGE_FLOOR_M) ** 2)
    return prior


def _plane_rows(
    f: CaptureFeatures, lidar: LidarBoard, rings: NDArray[np.int16], T: Array
) -> tuple[Array, Array]:
    """Write n . ((1 - s) g - R (p - b u) - t) for each point as measured: values, derivatives (N, p)."""
    points = np.asarray(lidar.points, dtype=np.float64)
    turned = points @ T[:3, :3].T
    J = np.zeros((len(points), FIRST_RING + len(rings)))
    J[:, :3] = -f.normal
    J[:, 3:6] = -np.cross(turned, f.normal)
    J[:, SCALE] = -f.normal @ f.centre
    rays = turned / np.linalg.norm(points, axis=1, keepdims=True)
    J[np.arange(len(points)), FIRST_RING + np.searchsorted(rings, lidar.ring)] = rays @ f.normal
    return np.asarray((f.centre - turned - T[:3, 3]) @ f.normal), J


def end_rows(f: CaptureFeatures, T: Array, board: Board, p: int) -> tuple[Array, Array]:
    """Write m . ((1 - s) g + a - R q - t) + d for each ring end and its nearest edge: (M,) and (M, p)."""
    turned = f.edge_points @ T[:3, :3].T
    edge = board.nearest_edge(transform(f.T_board_cam @ T, f.edge_points))
    normals, anchors = f.edge_normals[edge], f.edge_anchors[edge]
    J = np.zeros((len(turned), p))
    J[:, :3] = -normals
    J[:, 3:6] = -np.cross(turned, normals)
    J[:, SHIFT] = 1
    J[:, SCALE] = -normals @ f.centre
    return np.asarray(np.sum((anchors - turned - T[:3, 3]) * normals, axis=1)), J


def _distance(f: CaptureFeatures, T: Array) -> float:
    """Measure how far the LiDAR's plane lies from the camera's, rms over the board, m."""
    points = transform(T, f.plane_points)
    return float(np.sqrt(np.mean(((points - f.centre) @ f.normal) ** 2)))
