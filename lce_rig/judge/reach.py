"""Combined effect of errors of extrinsics and intrinsics on a point measured by the LiDAR.

A point p = R q + t in the camera frame moves with the extrinsics by [I, -(p - t)^] times their tangent, as a
rotation moves it about the LiDAR's origin; its pixel moves with the intrinsics as well. Both errors are
correlated: a wrong principal point turns the extrinsics, so that pixels hardly move.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from lce_rig.core.calibration import MOTIONS, Calibration, PointUncertainty
from lce_rig.core.camera import Intrinsics
from lce_rig.core.geometry import Array, PoseDifference, perturb, skew
from lce_rig.lens.difference import turn_of_lens
from lce_rig.lens.models import LensModel, model_of

USUAL_M = 10.0
"""Distance of the point whose uncertainty a summary states."""
DISTANCES_M = (5.0, USUAL_M, 20.0)
"""Distances of the points whose uncertainty is reported: beyond the boards, where rotation errors grow."""
CHANGED_CHI2 = 27.86
"""Least chi-squared of changed extrinsics: a chance of 1e-4, as of explanations."""
# Smallest part along an eigen-direction that is named, standard deviations.
_NAMED_SIGMAS = 2.0
# Beyond some radius the distortion is undefined; corners are moved to that radius.
_INWARDS = np.arange(40) / 40


@dataclass(frozen=True, eq=False)
class JointDifference(PoseDifference):
    """Difference of two extrinsics with its covariance, along the eigenvectors of the latter.

    Attributes:
        lever_m: rms distance of the boards, which makes angles comparable with distances.
    """

    lever_m: float

    @property
    def is_changed(self) -> bool:
        """Whether the difference is a change beyond chance."""
        return self.chi2 > CHANGED_CHI2

    @property
    def significant(self) -> Array:
        """The part (6,) of the difference along eigen-directions in which it is significant.

        Boards at one distance do not separate pitch from height: a change of either appears along the
        direction of both.
        """
        variances, directions = self.directions
        along = (self.scale * self.tangent) @ directions
        # At least the most significant one.
        least = min(_NAMED_SIGMAS**2, float(np.max(along**2 / variances)))
        return np.asarray(directions @ np.where(along**2 >= least * variances, along, 0.0) / self.scale)

    @property
    def main_axes(self) -> tuple[str, ...]:
        """Names of the axes with more than an even share of the significant part."""
        shares = (self.scale * self.significant) ** 2
        return tuple(np.array(MOTIONS)[shares > shares.mean()].tolist())

    @property
    def scale(self) -> Array:
        """Displacement (6,) of the boards, m, per unit of each axis."""
        return np.asarray(np.r_[np.ones(3), np.full(3, self.lever_m)])

    @property
    def directions(self) -> tuple[Array, Array]:
        """Variances (6,) of the covariance, m^2, from the smallest; eigen-directions (6, 6) in columns."""
        variances, directions = np.linalg.eigh(self.cov * np.outer(self.scale, self.scale))
        return variances, directions


def covariance_alone(calibration: Calibration) -> Array:
    """Compute the covariance (6, 6) of `T_cam_lidar` for use without the result's intrinsics.

    Sessions have their own intrinsics each: where matrices are compared, the rotation by which the errors of
    the intrinsics are compensated counts in full.
    """
    c = calibration
    if c.intrinsics is None or c.intrinsics_cov is None or c.intrinsics_cross_cov is None:
        return c.cov
    turn = turn_of_lens(c.intrinsics)
    M = np.hstack([np.eye(6), np.vstack([np.zeros_like(turn), -turn])])
    return np.asarray(M @ with_lens(c.cov, c.intrinsics_cross_cov, c.intrinsics_cov) @ M.T)


def equivalent_extrinsics(calibration: Calibration, lens: Intrinsics) -> Array:
    """Convert a result's extrinsics for use with other intrinsics.

    With `lens`, the returned extrinsics project points to the same pixels as the result's extrinsics and
    intrinsics do, up to the difference that no rotation absorbs.

    Args:
        calibration: the result; without fitted intrinsics its extrinsics are returned unchanged.
        lens: intrinsics of the same camera model.

    Returns:
        T_cam_lidar (4, 4).
    """
    fitted, model = calibration.intrinsics, model_of(lens)
    if fitted is None:
        return calibration.T_cam_lidar
    turn = turn_of_lens(lens) @ (model.vector(fitted) - model.vector(lens))
    return perturb(calibration.T_cam_lidar, np.append(np.zeros(3), turn))


def with_lens(cov: Array, cross: Array, cov_lens: Array) -> Array:
    """Join the covariances of extrinsics (6, 6) and intrinsics (P, P) to (6 + P, 6 + P)."""
    return np.block([[cov, cross], [cross.T, cov_lens]])


def point_uncertainties(
    T_cam_lidar: Array, cov: Array, lens: Intrinsics, distances_m: Sequence[float] = DISTANCES_M
) -> tuple[PointUncertainty, ...]:
    """Propagate a covariance to points in the middle and in the corners of the image.

    Args:
        T_cam_lidar: (4, 4).
        cov: (6, 6) tangent (translation m, rotation rad), or (6 + P, 6 + P) `with_lens`.
        lens: intrinsics of the camera.
        distances_m: distances of the points.

    Returns:
        One for each distance, with the worst of the four corners.
    """
    middle = [(lens.width_px - 1) / 2, (lens.height_px - 1) / 2]
    rays = lens.unproject(np.concatenate([[middle], outermost_pixels(lens)]))
    model, turn, found = model_of(lens), turn_of_lens(lens), []
    for distance_m in distances_m:
        sigmas = [
            _sigmas(distance_m * ray, T_cam_lidar[:3, 3], cov, model.vector(lens), model, turn)
            for ray in rays
        ]
        corner_px, corner_m = np.max(sigmas[1:], axis=0)
        found.append(PointUncertainty(distance_m, *sigmas[0], float(corner_px), float(corner_m)))
    return tuple(found)


def outermost_pixels(lens: Intrinsics) -> Array:
    """Find the image's corners (4, 2), or the limits of the lens model on the way to them."""
    w, h = lens.width_px - 1.0, lens.height_px - 1.0
    middle = np.array([w / 2, h / 2])
    corners = []
    for corner in np.array([[0, 0], [w, 0], [0, h], [w, h]]):
        on_the_way = corner + _INWARDS[:, None] * (middle - corner)
        is_drawn = np.isfinite(lens.unproject(on_the_way)).all(axis=1)
        corners.append(on_the_way[int(np.argmax(is_drawn))])
    return np.array(corners)


def _sigmas(
    point: Array, t: Array, cov: Array, lens: Array, model: LensModel, turn: Array
) -> tuple[float, float]:
    """Compute the expected size of a point's error in the image, px, and in space, m."""
    by_tangent = np.concatenate([np.eye(3), -skew(point - t)], axis=1)
    _, by_point, by_lens = model.project(lens, point)
    # The tangent contains the rotation `turn` by the intrinsics' errors already.
    by_lens = by_lens - by_point @ by_tangent[:, 3:] @ turn
    by_all = np.concatenate([by_point @ by_tangent, by_lens], axis=1)[:, : len(cov)]
    cov_px, cov_point = by_all @ cov @ by_all.T, by_tangent @ cov[:6, :6] @ by_tangent.T
    return float(np.sqrt(np.trace(cov_px))), float(np.sqrt(np.trace(cov_point)))
