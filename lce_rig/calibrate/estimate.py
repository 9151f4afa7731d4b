"""The result of a calibration."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field

from lce_rig.calibrate.known_lidar import KnownLidar
from lce_rig.calibrate.quadratics import Quadratics
from lce_rig.calibrate.tolerances import Sensitivity
from lce_rig.core.calibration import CaptureResidual, Certificate, ChannelResult, Metrics
from lce_rig.core.diagnostics import Diagnostics
from lce_rig.core.findings import Refusal
from lce_rig.core.geometry import Array
from lce_rig.core.results import Observation


@dataclass(frozen=True, eq=False)
class CalibrationEstimate:
    """Extrinsics with their uncertainty, certificate and residuals.

    Attributes:
        T_cam_lidar: (4, 4), p_cam = R p_lidar + t.
        cov: (6, 6), tangent (translation m, rotation rad), axes of the camera: from the noise of the captures
            and from the sensors' errors that are common to all of them. Errors of the profile's lens
            and board are not in it, but in `sensitivities`.
        certificate: of Algorithm 1's final cost over all captures used, from whose solution other methods
            start; its gap is infinite if there is none.
        metrics: errors over all captures used, of the boards as measured.
        used: names of the captures used, sorted; one stands for all that hold the same scan.
        refused: why each other capture is not used.
        observations: capture -> the boards that were paired, as measured, for each capture used.
        fitted: the same as used in the method's cost: Algorithm 1 moves ring ends by the background's shift.
        residuals: one per capture used, in the order of `used`.
        held_out_m: mean over captures of `CaptureResidual.held_out_m`.
        lever_m: rms distance of the boards from the camera.
        diagnostics: further figures.
        method: that found it, as `CalibrateOptions.method`.
        sensitivities: how far errors of the profile's lens and board move the result; empty without
            `EstimateSettings.tolerances`.
        cost: the method's own cost about its result, capture by capture, in the extrinsics (and those of
            cameras estimated with it) alone, boards' poses eliminated; None if the method has none.
        lidar: constant errors of the LiDAR that were estimated with it; None if the method knows none.
        estimated_with: cameras whose extrinsics were estimated together with this one.
        same_scan: the captures that hold the same scan, by the one that stands for them; others are alone.
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
    lever_m: float
    diagnostics: Diagnostics
    method: str = "paper"
    sensitivities: tuple[Sensitivity, ...] = ()
    cost: Quadratics | None = None
    lidar: KnownLidar | None = None
    estimated_with: tuple[str, ...] = ()
    same_scan: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    channels: tuple[ChannelResult, ...] = ()
    channel_difference: Array | None = None
    channel_difference_cov: Array | None = None

    def captures_of(self, names: Iterable[str]) -> set[str]:
        """Name every capture that holds the scan of one of the captures named."""
        return {each for name in names for each in self.same_scan.get(name, (name,))}
