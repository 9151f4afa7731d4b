"""Joint maximum-likelihood estimate of extrinsics, board poses and the sensors' constant errors."""

from lce_rig.calibrate.likelihood.calibrate_jointly import calibrate_by_likelihood
from lce_rig.calibrate.likelihood.refine import JointEstimate, refine

__all__ = ["JointEstimate", "calibrate_by_likelihood", "refine"]
