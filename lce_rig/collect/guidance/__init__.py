"""Where to hold the board next, and how well the extrinsic is going to be known."""

from lce_rig.collect.guidance.candidates import SensorPlace, is_reachable, spread_candidates
from lce_rig.collect.guidance.evidence import (
    combine,
    sigmas,
    weigh_placements,
)
from lce_rig.collect.guidance.instructions import (
    HeldPose,
    Instruction,
    Person,
    build_pose,
    describe_pose,
    instruct,
    is_there,
    say,
)
from lce_rig.collect.guidance.planner import Coverage, Guidance, Planner, measure_coverage
from lce_rig.collect.guidance.sensor_noise import SensorModel, model_sensors, outline_px

__all__ = [
    "Coverage",
    "Guidance",
    "HeldPose",
    "Instruction",
    "Person",
    "Planner",
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
    "say",
    "sigmas",
    "spread_candidates",
    "weigh_placements",
]
