"""Extrinsic calibration of one camera channel and one LiDAR from pairs of detected boards."""

from lce_rig.calibrate.calibrate import calibrate
from lce_rig.calibrate.estimate import CalibrationEstimate, CaptureResidual
from lce_rig.calibrate.metrics import capture_residual, error_to_reference
from lce_rig.calibrate.options import CalibrateOptions, CaptureCandidates

__all__ = [
    "CalibrateOptions",
    "CalibrationEstimate",
    "CaptureCandidates",
    "CaptureResidual",
    "calibrate",
    "capture_residual",
    "error_to_reference",
]
