"""The cost of a result with independent weights, for all checks that leave captures out.

It is built from points, planes and ring ends, for any method. The unknowns are the extrinsics, the edge shift
and the range offset of each laser, with priors; without the latter two, their effects would look like
disagreement between captures.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from lce_rig.calibrate.observations import group_placements
from lce_rig.calibrate.plane_and_ends import (
    EDGE_SHIFT_SIGMA_M,
    PLANE_FREEDOMS,
    CaptureFeatures,
    differentiate,
    end_residuals,
    end_rows,
    extract_features,
    plane_residuals,
)
from lce_rig.calibrate.quadratics import Quadratics, jackknife_scatter
from lce_rig.core.board import Board
from lce_rig.core.geometry import Array
from lce_rig.core.results import LidarBoard, Observation

SHIFT, FIRST_RING, SCALE = 6, 7, -1
PATTERN = (-3, -2)
"""Indices in the x of `expand`, after the tangent (translation m, rotation rad): edge shift m, range offset m
of each ring, the pattern's x and y on the plate m, and last the camera's scale."""
OF_PROFILE = (*PATTERN, SCALE)
"""What the profile states, and checks of the captures hold fixed."""

# Errors of a board's plane and of its ring ends are at least as large as this.
_PLANE_FLOOR_M, _END_FLOOR_M = 0.001, 0.002
# Minimum range error of lasers, if a profile states none.
_RANGE_FLOOR_M = 0.0005


def expand(
    observations: Sequence[Observation],
    board: Board,
    T_cam_lidar: Array,
    *,
    laser_bias_sigma_m: float,
    range_offset_sigma_m: float,
    sigmas: "FeatureSigmas | None" = None,
    rings: NDArray[np.int16] | None = None,
) -> Quadratics:
    """Expand the cost of captures about given extrinsics.

    A capture counts 3 / sigma_plane^2 times the mean square over its points, and the square of each ring end
    over sigma_end^2, with both sigmas estimated from the captures.

    Args:
        observations: one a capture.
        board: the board.
        T_cam_lidar: (4, 4).
        laser_bias_sigma_m: standard deviation a priori of the lasers' range offsets about their mean.
        range_offset_sigma_m: of that mean.
        sigmas: of planes and ring ends; None estimates them from these captures.
        rings: (L,) whose offsets are unknowns; None for those that occur.
    """
    features = [extract_features(seen, board) for seen in observations]
    sigmas = sigmas or feature_sigmas(features, T_cam_lidar)
    if rings is None:
        rings = np.unique(np.concatenate([seen.lidar.ring for seen in observations]))
    p = FIRST_RING + len(rings) + len(OF_PROFILE)
    gradients, hessians = np.zeros((len(features), p)), np.zeros((len(features), p, p))
    for k, (f, seen) in enumerate(zip(features, observations, strict=True)):
        r_plane, J_plane = plane_rows(f, T_cam_lidar, seen.lidar, rings)
        r_end, by_end, edge = end_rows(f, T_cam_lidar)
        J_end = np.zeros((len(r_end), p))
        J_end[:, [*range(FIRST_RING), SCALE]] = by_end
        # A pattern that sits farther right has the plate's edges farther left.
        J_end[:, PATTERN] = -board.edges()[1][edge, :2]
        by_plane = PLANE_FREEDOMS / (sigmas.plane_m**2 * max(len(r_plane), 1))
        for r, J, weight in ((r_plane, J_plane, by_plane), (r_end, J_end, 1 / sigmas.end_m**2)):
            gradients[k] += weight * r @ J
            hessians[k] += weight * J.T @ J
    prior = priors_of_constants(len(rings), laser_bias_sigma_m, range_offset_sigma_m)
    return Quadratics(gradients, hessians, prior, np.zeros(p), group_placements(observations))


def scale_of(expansion: Quadratics) -> tuple[float, float]:
    """Estimate the camera's distances over the LiDAR's, less 1, by single errors and by leave-one-out.

    Args:
        expansion: by `expand`, with all unknowns free.

    Returns:
        The scale without a prior, and its standard deviation.
    """
    (scale,), ((variance,),) = _estimate(expansion.hold(PATTERN), (SCALE,))
    return float(scale), float(np.sqrt(variance))


def pattern_of(expansion: Quadratics) -> tuple[Array, Array]:
    """Estimate how far the pattern sits from its place on the plate: (2,) right and up, m; covariance (2, 2).

    Planes of tilted boards place the LiDAR without it, ring ends only with it.

    Args:
        expansion: by `expand`, with all unknowns free.
    """
    return _estimate(expansion, PATTERN)


def _estimate(expansion: Quadratics, unknowns: tuple[int, ...]) -> tuple[Array, Array]:
    """Estimate some unknowns (n,) with the covariance (n, n) of single errors and of leave-one-out."""
    without = expansion.without_each()[:, unknowns]
    scatter = jackknife_scatter(without - without.mean(axis=0))
    return expansion.optimum()[[*unknowns]], expansion.covariance()[np.ix_(unknowns, unknowns)] + scatter


def plane_rows(
    f: CaptureFeatures, T: Array, lidar: LidarBoard, rings: NDArray[np.int16]
) -> tuple[Array, Array]:
    """Linearise the plane's residual for points as measured: values, derivatives by the x of `expand`.

    A ring's rays are its offset too long; the scale s shrinks the camera's distances to (1 - s) g.
    """
    points = np.asarray(lidar.points, dtype=np.float64)
    J = np.zeros((len(points), FIRST_RING + len(rings) + len(OF_PROFILE)))
    J[:, :SHIFT] = differentiate(f.normal, points @ T[:3, :3].T)
    rays = points / np.linalg.norm(points, axis=1, keepdims=True)
    J[np.arange(len(points)), FIRST_RING + np.searchsorted(rings, lidar.ring)] = rays @ T[:3, :3].T @ f.normal
    J[:, SCALE] = -f.normal @ f.centre
    return plane_residuals(f, T, points), J


def priors_of_constants(n_rings: int, laser_m: float, offset_m: float) -> Array:
    """Write priors as information (p, p): of the edge shift, of offsets about their mean, of the mean."""
    p = FIRST_RING + n_rings + len(OF_PROFILE)
    prior = np.zeros((p, p))
    prior[SHIFT, SHIFT] = 1 / EDGE_SHIFT_SIGMA_M**2
    cov = max(laser_m, _RANGE_FLOOR_M) ** 2 * (np.eye(n_rings) - 1 / n_rings)
    prior[FIRST_RING : PATTERN[0], FIRST_RING : PATTERN[0]] = np.linalg.inv(
        cov + max(offset_m, _RANGE_FLOOR_M) ** 2
    )
    return prior


class FeatureSigmas(NamedTuple):
    """Standard deviations for the weights of planes and ring ends, from their distances.

    Attributes:
        plane_m: of a capture's plane, rms over the board.
        end_m: of a ring end.
    """

    plane_m: float
    end_m: float


def feature_sigmas(features: Sequence[CaptureFeatures], T_cam_lidar: Array) -> FeatureSigmas:
    """Return the typical errors of captures' planes and ring ends under extrinsics (4, 4)."""
    planes_m = [np.sqrt(np.mean(plane_residuals(f, T_cam_lidar) ** 2)) for f in features]
    inside_m = np.concatenate([end_residuals(f, T_cam_lidar)[0] for f in features])
    # Ring ends reach beyond the plate by the beam's width, which is no error.
    end_m = 1.4826 * float(np.median(np.abs(inside_m - np.median(inside_m))))
    return FeatureSigmas(max(float(np.median(planes_m)), _PLANE_FLOOR_M), max(end_m, _END_FLOOR_M))


def capture_costs(f: CaptureFeatures, T_cam_lidar: Array, sigmas: FeatureSigmas) -> Array:
    """Sum the squares of a capture's residuals under extrinsics (B, 4, 4): (B,).

    The mean square over the plane's points counts `PLANE_FREEDOMS` / sigma^2, each ring end 1 / sigma^2 after
    their mean is subtracted: they reach beyond the plate by the beam's width, alike on all sides.
    """
    plane_m = plane_residuals(f, T_cam_lidar)
    inside_m, _ = end_residuals(f, T_cam_lidar)
    own_m = inside_m - inside_m.mean(axis=1, keepdims=True) if inside_m.shape[1] else inside_m
    by_plane = PLANE_FREEDOMS * np.mean(plane_m**2, axis=1) / sigmas.plane_m**2
    return np.asarray(by_plane + np.sum(own_m**2, axis=1) / sigmas.end_m**2)
