"""The common apex of the cones that a spinning LiDAR's lasers sweep.

Each laser sweeps a cone about the rotor's axis. Seen from the apex, the returns of a ring have the same
elevation. Seen from elsewhere, the elevation of near returns differs from that of far ones.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lce_rig.core.geometry import SIGMA_PER_MAD, Array, exp_so3

# Noise of a return's elevation: of the beam's angle, rad, and of its origin in the sensor, m.
_SIGMA_RAD, _SIGMA_M = np.radians(0.1), 0.01
# Number of random returns used: the estimate takes 5 ms, and its error stays below 1 cm.
_N_POINTS = 2000
_MIN_RINGS, _MIN_POINTS = 4, 200
_MIN_DISTANCE_M = 0.05
_MAX_STEPS, _CONVERGED = 40, 1e-4
# Largest change per step of apex, m, and axis, rad: full steps from afar diverge.
_LONGEST_STEP = np.repeat([0.5, 0.1], [3, 2])
# Huber's constant, in robust standard deviations.
_HUBER = 2.5
# Number of first steps without outlier weights: about the frame's origin every return may look like one.
_PLAIN_STEPS = 5
# Minimum ratio of the elevations' scatter about the frame's origin to that about another apex.
_MIN_RATIO = 2.0
_SIGNIFICANT = 5.0
MAX_APEX_M = 0.1
"""Largest distance of the apex from the origin in a LiDAR's own frame: an Ouster OS1, with its frame at the
base, has 37 mm, nine other recordings have below 1 mm. Errors of the extrinsics grow with this distance."""


@dataclass(frozen=True, eq=False)
class Apex:
    """The common apex of a scan's rings.

    Attributes:
        position_m: (3,) in the frame of the points.
        sigma_m: largest standard deviation of the position.
        rms_rad: scatter of a ring's elevations, seen from the apex.
        rms_at_origin_rad: the same about the frame's origin.
    """

    position_m: Array
    sigma_m: float
    rms_rad: float
    rms_at_origin_rad: float

    def is_beyond(self, limit_m: float) -> bool:
        """Check whether the apex lies significantly farther than a limit from the frame's origin."""
        distance_m = float(np.linalg.norm(self.position_m))
        is_better = self.rms_at_origin_rad > _MIN_RATIO * self.rms_rad
        return is_better and distance_m - _SIGNIFICANT * self.sigma_m > limit_m


def find_apex(points: NDArray[np.float32], ring: NDArray[np.int16]) -> Apex | None:
    """Fit apex and axis of the rings of one scan robustly, with free elevations of the lasers.

    Args:
        points: (N, 3) m, in any frame.
        ring: (N,) laser of each point.

    Returns:
        None if there are too few points, or they do not determine the apex.
    """
    if len(points) > _N_POINTS:
        drawn = np.random.default_rng(0).integers(0, len(points), _N_POINTS)
        points, ring = points[drawn], ring[drawn]
    lasers, laser = np.unique(ring, return_inverse=True)
    if len(points) < _MIN_POINTS or len(lasers) < _MIN_RINGS:
        return None
    apex, to_axis = np.zeros(3), np.eye(3)
    soft, rms_at_origin = np.ones(len(points)), None
    for step in range(_MAX_STEPS):
        local = (points - apex) @ to_axis.T
        flat_m = np.maximum(np.hypot(local[:, 0], local[:, 1]), _MIN_DISTANCE_M)
        range_m = np.hypot(flat_m, local[:, 2])
        outward = local[:, :2] / flat_m[:, None]
        sine, cosine = local[:, 2] / range_m, flat_m / range_m
        sigma = np.hypot(_SIGMA_RAD, _SIGMA_M / range_m)
        # Derivatives of the elevation by the apex, and by rotations of the axis about x and y.
        of_apex = np.column_stack([sine[:, None] * outward, -cosine]) @ to_axis / range_m[:, None]
        J = np.column_stack([of_apex, outward])
        elevation = np.arctan2(local[:, 2], flat_m)
        scaled = _about_means(elevation, laser, soft / sigma**2) / sigma
        if step >= _PLAIN_STEPS:
            spread = max(SIGMA_PER_MAD * float(np.median(np.abs(scaled))), 1e-6)
            soft = np.minimum(1.0, _HUBER * spread / np.maximum(np.abs(scaled), 1e-12))
        weight = soft / sigma**2
        error, J = _about_means(elevation, laser, weight), _about_means(J, laser, weight)
        rms = float(np.sqrt(np.average(error**2, weights=weight)))
        rms_at_origin = rms if rms_at_origin is None else rms_at_origin
        normal = J.T @ (J * weight[:, None])
        if np.linalg.cond(normal) > 1e10:
            return None
        change = -np.linalg.solve(normal, J.T @ (weight * error))
        if step > _PLAIN_STEPS and np.abs(change).max() < _CONVERGED:
            break
        change = change / max(1.0, float((np.abs(change) / _LONGEST_STEP).max()))
        apex = apex + change[:3]
        to_axis = exp_so3(np.array([change[4], -change[3], 0.0])) @ to_axis
    else:
        return None
    # Scaled by the actual errors: a scan with exact beams determines its apex exactly.
    cov = np.linalg.inv(normal) * max(float(np.average((error / sigma) ** 2, weights=soft)), 1e-6)
    sigma_m = float(np.sqrt(np.linalg.eigvalsh(cov[:3, :3])[-1]))
    return Apex(apex, sigma_m, rms, float(rms_at_origin or 0.0))


def _about_means(values: Array, group: NDArray[np.intp], weight: Array) -> Array:
    """Subtract the weighted mean of each group (N,) from values (N,) or (N, D)."""
    total = np.bincount(group, weight)
    columns = values if values.ndim == 2 else values[:, None]
    means = [np.bincount(group, weight * column) / total for column in columns.T]
    return np.asarray((columns - np.column_stack(means)[group]).reshape(values.shape))
