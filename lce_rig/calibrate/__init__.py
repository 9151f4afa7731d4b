"""Extrinsic calibration of one camera and one LiDAR from pairs of detected boards.

`estimate` lists the method's steps. Read `observations`, `consensus`, `motion/`, `algorithm_1/`,
`likelihood/` and `uncertainty` in this order.
"""

from lce_rig.calibrate.estimate import estimate_extrinsics, fit_extrinsic
from lce_rig.calibrate.observations import Clocks
from lce_rig.calibrate.options import CalibrateOptions, EstimateSettings
from lce_rig.calibrate.result import CalibrationEstimate, capture_residual, error_to_reference

__all__ = [
    "CalibrateOptions",
    "CalibrationEstimate",
    "Clocks",
    "EstimateSettings",
    "capture_residual",
    "error_to_reference",
    "estimate_extrinsics",
    "fit_extrinsic",
]
