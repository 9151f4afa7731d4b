"""Extrinsic calibration of one camera and one LiDAR from pairs of detected boards."""

from lce_rig.calibrate.channels import calibrate_channels
from lce_rig.calibrate.estimate import CalibrationEstimate
from lce_rig.calibrate.methods import fit_extrinsic
from lce_rig.calibrate.metrics import capture_residual, error_to_reference
from lce_rig.calibrate.options import Algorithm1Parts, CalibrateOptions, CaptureCandidates, EstimateSettings
from lce_rig.calibrate.shared_scans import Clocks

__all__ = [
    "Algorithm1Parts",
    "CalibrateOptions",
    "CalibrationEstimate",
    "CaptureCandidates",
    "Clocks",
    "EstimateSettings",
    "calibrate_channels",
    "capture_residual",
    "error_to_reference",
    "fit_extrinsic",
]
