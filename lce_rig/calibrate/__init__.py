"""Extrinsic calibration of one camera and one LiDAR from pairs of detected boards."""

from lce_rig.calibrate.calibrate import fit_extrinsic
from lce_rig.calibrate.channels import calibrate_channels
from lce_rig.calibrate.estimate import CalibrationEstimate
from lce_rig.calibrate.metrics import capture_residual, error_to_reference
from lce_rig.calibrate.options import CalibrateOptions, CaptureCandidates
from lce_rig.calibrate.shared_scans import Clocks

__all__ = [
    "CalibrateOptions",
    "CalibrationEstimate",
    "CaptureCandidates",
    "Clocks",
    "calibrate_channels",
    "capture_residual",
    "error_to_reference",
    "fit_extrinsic",
]
