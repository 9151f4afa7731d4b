"""The covariance to expect of an extrinsic from some placements, and from one more."""

from dataclasses import dataclass

import numpy as np

from lce_rig.collect.guidance.evidence import N_UNKNOWNS, Evidence, weigh_placements
from lce_rig.collect.guidance.sensor_noise import ErrorModel, SensorModel
from lce_rig.core.geometry import Array
from lce_rig.solvers.covariance import symmetric_inverse, systematic_covariances

# What is known a priori (a rough extrinsic), so that no direction is ever infinitely uncertain.
PRIOR_SIGMA_M, PRIOR_SIGMA_RAD = 1.0, 0.5


@dataclass(frozen=True, eq=False)
class Precision:
    """Covariances to expect of extrinsics, tangent (translation m, rotation rad), axes of the camera.

    Attributes:
        scatter: (..., 6, 6) what differs from capture to capture.
        lasers: (..., 6, 6) what the lasers' constant errors about their mean add.
        offset: (..., 6, 6) what that mean adds.
    """

    scatter: Array
    lasers: Array
    offset: Array

    @property
    def cov(self) -> Array:
        """All of it (..., 6, 6)."""
        return self.scatter + self.lasers + self.offset

    @property
    def improvable(self) -> Array:
        """What further placements can shrink (..., 6, 6).

        An offset common to all ranges moves the extrinsic along the line of sight wherever boards stand.
        """
        return self.scatter + self.lasers

    def claimed(self, n_captures: int) -> Array:
        """Predict the covariance (..., 6, 6) that the calibration will state after so many captures.

        It estimates the scatter from the captures themselves, and makes up for how few they are (as
        `Quadratics.jackknife_covariance` does).
        """
        few = (n_captures - 1) / max(n_captures - N_UNKNOWNS - 2, 2)
        return np.asarray(max(few, 1.0) * self.scatter + self.lasers + self.offset)


def predict_covariance(model: SensorModel, T_cam_board: Array, T_cam_lidar: Array) -> Array:
    """Predict the covariance (6, 6) of T_cam_lidar from captures of boards at places T_cam_board (N, 4, 4).

    Args:
        model: the sensors.
        T_cam_board: (N, 4, 4); N may be 0.
        T_cam_lidar: (4, 4) rough extrinsic: the profile's nominal, or an estimate.
    """
    return combine(weigh_placements(model, T_cam_board, T_cam_lidar), model.errors).cov


def combine(held: Evidence, errors: ErrorModel) -> Precision:
    """Predict (6, 6) from all placements together, equation (1) of `evidence`."""
    return _precision(held.hessian.sum(axis=0), held.noise.sum(axis=0), held.drift.sum(axis=0), errors)


def combine_with_each(held: Evidence, more: Evidence, errors: ErrorModel) -> Precision:
    """Predict (N, 6, 6) from the placements held and one more, each of N others in turn."""
    return _precision(
        held.hessian.sum(axis=0) + more.hessian,
        held.noise.sum(axis=0) + more.noise,
        held.drift.sum(axis=0) + more.drift,
        errors,
    )


def sigmas(cov: Array) -> tuple[Array, Array]:
    """Summarise covariances (..., 6, 6) as results do: root of the summed variances.

    Returns:
        Of the rotation in rad and of the translation in m, (...).
    """
    variances = np.diagonal(cov, axis1=-2, axis2=-1)
    return np.sqrt(variances[..., 3:].sum(axis=-1)), np.sqrt(variances[..., :3].sum(axis=-1))


def shortfall(model: SensorModel, cov: Array) -> Array:
    """Measure how far covariances (..., 6, 6) are from the profile's target, (...).

    It is the root of the summed squares of the rotation's and the translation's deviation, each in units of
    its target: the worse of the two rules, and of two placements that help it alike the one that also helps
    the other is better.
    """
    rotation, translation = sigmas(cov)
    return np.asarray(np.hypot(rotation / model.target_sigma_rad, translation / model.target_sigma_m))


def _precision(hessian: Array, noise: Array, drift: Array, errors: ErrorModel) -> Precision:
    prior = np.diag(np.repeat([PRIOR_SIGMA_M, PRIOR_SIGMA_RAD, errors.edge_shift_m], [3, 3, 1]) ** -2.0)
    inverse = symmetric_inverse(hessian + prior)
    # The prior's own error counts where captures leave a direction open.
    scatter = inverse @ (noise + prior) @ inverse
    lasers, offset = systematic_covariances(inverse @ drift, errors.laser_bias_m, errors.range_offset_m)
    return Precision(scatter[..., :6, :6], lasers[..., :6, :6], offset[..., :6, :6])
