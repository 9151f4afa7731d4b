"""Do camera and LiDAR agree on distances? A constant factor between them: wrong squares or intrinsics."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from lce_rig.core.geometry import Array
from lce_rig.core.results import Observation


@dataclass(frozen=True)
class ScaleCheck:
    """Camera distances over LiDAR distances.

    Attributes:
        ratio: 1 where both agree; above 1 the camera sees the boards farther away.
        sigma: standard deviation of the ratio.
    """

    ratio: float
    sigma: float

    def is_off(self, tolerance: float) -> bool:
        """Tell whether the ratio is off by more than the tolerance, three standard deviations sure."""
        return abs(self.ratio - 1) - 3 * self.sigma > tolerance


def compare_scales(observations: Sequence[Observation]) -> ScaleCheck:
    """Fit s, R and t of t_cam = s R p_lidar + t to the boards' centres, s in closed form.

    Board centres of the LiDAR come from its own template, so that no extrinsic is needed. The
    deviation of s is its jackknife over captures.

    Args:
        observations: at least 4.

    References:
        Umeyama, Least-squares estimation of transformation parameters between two point patterns, PAMI 1991.
    """
    cam = np.stack([seen.image.T_cam_board[:3, 3] for seen in observations])
    lidar = np.stack([seen.lidar.T_lidar_board[:3, 3] for seen in observations])
    n = len(cam)
    every = ~np.eye(n, dtype=bool)
    without = np.array([_scale(cam[keep], lidar[keep]) for keep in every])
    sigma = float(np.sqrt((n - 1) / n * np.sum((without - without.mean()) ** 2)))
    return ScaleCheck(_scale(cam, lidar), sigma)


def _scale(cam: Array, lidar: Array) -> float:
    """Umeyama's scale, symmetrised: the geometric mean of both directions of the fit, unbiased by noise."""
    a, b = cam - cam.mean(axis=0), lidar - lidar.mean(axis=0)
    return float(np.sqrt(np.sum(a * a) / np.sum(b * b)))
