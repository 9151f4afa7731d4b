"""The result of a calibration."""

from collections.abc import Mapping
from dataclasses import dataclass

from lce_rig.core.geometry import Array
from lce_rig.core.results import CaptureResidual, Certificate, ChannelResult, Metrics, Observation, Refusal
from lce_rig.residuals.quadratics import Quadratics


@dataclass(frozen=True, eq=False)
class CalibrationEstimate:
    """Extrinsics with their uncertainty, certificate and residuals.

    Attributes:
        T_cam_lidar: (4, 4), p_cam = R p_lidar + t.
        cov: (6, 6), tangent (translation m, rotation rad), axes of the camera: from the scatter between
            captures, and from range errors of the LiDAR that are common to all captures. It excludes errors
            of the intrinsics and of the board's size.
        certificate: of the final cost over all captures used; its gap is infinite if there is none.
        metrics: errors over all captures used, of the boards as measured.
        used: names of the captures used, sorted.
        refused: why each other capture is not used.
        observations: capture -> the boards that were paired, as measured, for each capture used.
        fitted: the same as used in the method's cost: Algorithm 1 moves ring ends by the background's shift.
        residuals: one per capture used, in the order of `used`.
        held_out_m: mean over captures of `CaptureResidual.held_out_m`.
        weak_direction: the least determined motion in words, with its standard deviation.
        diagnostics: further figures by name.
        method: that found it, as `CalibrateOptions.method`.
        expansion: the method's own cost about its result, capture by capture, in the extrinsic (and those of
            cameras estimated with it) alone; None if the method has none.
        estimated_with: cameras whose extrinsics were estimated together with this one.
        channels: the result of each channel of the camera alone; empty if they were not separated.
        channel_difference: (6,) tangent between the extrinsics of two channels; None with one channel.
        channel_difference_cov: (6, 6) of it.
    """

    T_cam_lidar: Array
    cov: Array
    certificate: Certificate
    metrics: Metrics
    used: tuple[str, ...]
    refused: Mapping[str, Refusal]
    observations: Mapping[str, Observation]
    fitted: Mapping[str, Observation]
    residuals: tuple[CaptureResidual, ...]
    held_out_m: float
    weak_direction: str
    diagnostics: Mapping[str, float]
    method: str = "paper"
    expansion: Quadratics | None = None
    estimated_with: tuple[str, ...] = ()
    channels: tuple[ChannelResult, ...] = ()
    channel_difference: Array | None = None
    channel_difference_cov: Array | None = None
