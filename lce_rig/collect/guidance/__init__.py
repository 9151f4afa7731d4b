"""Where to hold the board next, and how well the extrinsic is going to be known."""

from lce_rig.collect.guidance.candidates import SensorPlace, is_reachable, spread_candidates
from lce_rig.collect.guidance.coverage import Coverage, measure_coverage
from lce_rig.collect.guidance.evidence import Evidence, weigh_placements
from lce_rig.collect.guidance.instructions import (
    HeldPose,
    Instruction,
    build_pose,
    describe_pose,
    instruct,
    is_there,
    say,
)
from lce_rig.collect.guidance.outline import outline_px
from lce_rig.collect.guidance.person import Person
from lce_rig.collect.guidance.planner import Guidance, Novelty, Planner
from lce_rig.collect.guidance.precision import Precision, combine, predict_covariance, sigmas
from lce_rig.collect.guidance.sensor_noise import ErrorModel, SensorModel, model_sensors

__all__ = [
    "Coverage",
    "ErrorModel",
    "Evidence",
    "Guidance",
    "HeldPose",
    "Instruction",
    "Novelty",
    "Person",
    "Planner",
    "Precision",
    "SensorModel",
    "SensorPlace",
    "build_pose",
    "combine",
    "describe_pose",
    "instruct",
    "is_reachable",
    "is_there",
    "measure_coverage",
    "model_sensors",
    "outline_px",
    "predict_covariance",
    "say",
    "sigmas",
    "spread_candidates",
    "weigh_placements",
]
