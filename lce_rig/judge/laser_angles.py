"""The lasers' azimuths and elevations by the boards: a wrong model or beam table shifts rings on the plate.

Each ring's errors of azimuth a and elevation e join the unknowns of `local_quadratic`. With q = r u(a, e), a
residual n . (g - R q - t) changes by -n . R dq/da and -n . R dq/de. The place of the lens, which depends on
the range as angles do not, and the ranges' offsets are unknowns with priors.
"""

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from lce_rig.calibrate.likelihood.levels import Priors
from lce_rig.calibrate.likelihood.rays import lens_fields, turn_rays
from lce_rig.calibrate.plane_and_ends import PLANE_FREEDOMS, end_rows, extract_features
from lce_rig.core.board import Board
from lce_rig.core.findings import Finding
from lce_rig.core.geometry import Array
from lce_rig.core.results import Observation
from lce_rig.judge.findings import LASER_ANGLES
from lce_rig.judge.local_quadratic import FIRST_RING, feature_sigmas, plane_rows, priors_of_constants
from lce_rig.rig import LidarSettings

# Angles are known no better than this before the boards are seen.
_LOOSE_RAD = np.radians(1.0)
# Ring ends beyond so many deviations are of something else.
_OUTLIER = 4.0
# Lasers on recordings differ from their data sheet by up to 0.08 deg rms in elevation, 0.14 in azimuth.
_MAX_DEG = 0.16
_CHANCE = 1e-4
_PLATE_M = 0.03


def estimate_angles(
    observations: Sequence[Observation], board: Board, T_cam_lidar: Array, lidar: LidarSettings
) -> dict[str, float]:
    """Estimate how far the lasers' angles are from the scans', beyond their noise.

    Args:
        observations: F captures.
        board: the board.
        T_cam_lidar: (4, 4) the result.
        lidar: its range error settings.

    Returns:
        Rms over rings of the errors about their mean in deg, by "azimuth" and "elevation": the noise is
        subtracted, rings count by their information; 0 where noise alone explains them.
    """
    from scipy.special import chdtrc

    features = [extract_features(seen, board) for seen in observations]
    sigmas = feature_sigmas(features, board, T_cam_lidar)
    rings = np.unique(np.concatenate([seen.lidar.ring for seen in observations]))
    L, R = len(rings), T_cam_lidar[:3, :3]
    lens = FIRST_RING + L
    angles = lens + 3
    # The plate may be wider, and less high, than the profile has it.
    is_of_width = 2 * np.abs(board.edges()[1][:, 0]) - 1
    H, g = np.zeros((angles + 2 * L, angles + 2 * L)), np.zeros(angles + 2 * L)

    def by_angles(points: Array, ring: NDArray[np.int16], normals: Array) -> Array:
        """Differentiate residuals (N,) by lens (2), each ring's azimuth and elevation (2 L), in 3 + 2 L."""
        moves = np.concatenate([lens_fields(points), turn_rays(points)], axis=2)
        along = np.broadcast_to(normals @ R, points.shape)
        lateral, vertical, azimuth, elevation = -np.einsum("nij,ni->jn", moves, along)
        own = np.searchsorted(rings, ring)[:, None] == np.arange(L)
        of_rings = own * azimuth[:, None], own * elevation[:, None]
        return np.column_stack([lateral, vertical, np.zeros(len(points)), *of_rings])

    for f, seen in zip(features, observations, strict=True):
        points = np.asarray(seen.lidar.points, dtype=np.float64)
        r_plane, J_plane = plane_rows(f, T_cam_lidar, seen.lidar, rings)
        J = np.hstack([J_plane[:, :lens], by_angles(points, seen.lidar.ring, f.normal)])
        weight = PLANE_FREEDOMS / (sigmas.plane_m**2 * max(len(points), 1))
        H, g = H + weight * J.T @ J, g + weight * r_plane @ J
        r_end, J_end, edge = end_rows(f, T_cam_lidar, board)
        no_ranges = np.zeros((len(r_end), L))
        by_ring = by_angles(f.edge_points, seen.lidar.edge_ring, f.edge_normals[edge])
        by_ring[:, 2] = is_of_width[edge]
        J = np.hstack([J_end[:, :FIRST_RING], no_ranges, by_ring])
        is_end = np.abs(r_end - np.median(r_end)) < _OUTLIER * sigmas.end_m
        H, g = H + J[is_end].T @ J[is_end] / sigmas.end_m**2, g + r_end[is_end] @ J[is_end] / sigmas.end_m**2
    priors = Priors()
    of_constants = priors_of_constants(L, lidar.laser_bias_sigma_m, lidar.range_offset_sigma_m)
    H[:lens, :lens] += of_constants[:lens, :lens]
    known = [priors.lateral_m, priors.vertical_m, _PLATE_M, *np.full(2 * L, _LOOSE_RAD)]
    H[lens:, lens:] += np.diag(1 / np.square(known))
    cov = np.linalg.inv(H)
    x = -cov @ g
    sizes = {}
    for name, start in (("azimuth", angles), ("elevation", angles + L)):
        own = slice(start, start + L)
        weights = 1 / np.diag(cov)[own]
        about_mean = np.eye(L) - weights / weights.sum()
        errors, variances = about_mean @ x[own], np.diag(about_mean @ cov[own, own] @ about_mean.T)
        excess = np.sum((errors**2 - variances) / variances**2) / np.sum(1 / variances**2)
        is_sure = chdtrc(L, x[own] @ np.linalg.solve(cov[own, own], x[own])) < _CHANCE
        sizes[name] = float(np.degrees(np.sqrt(max(excess, 0.0)))) if is_sure else 0.0
    return sizes


def angle_findings(sizes: Mapping[str, float]) -> list[Finding]:
    """Find lasers whose angles are not those of the scans."""
    return [
        LASER_ANGLES(angle=name, rms_deg=rms_deg, limit_deg=_MAX_DEG)
        for name, rms_deg in sizes.items()
        if rms_deg > _MAX_DEG
    ]
