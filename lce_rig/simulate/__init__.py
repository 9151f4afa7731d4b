"""The simulated rig: captures of any profile with exact truth, errors and clutter like real ones."""

from lce_rig.simulate.captures import SimulatedCapture, simulate_captures, truth_extrinsics
from lce_rig.simulate.options import CameraNoise, LidarNoise, SimulationOptions

__all__ = [
    "CameraNoise",
    "LidarNoise",
    "SimulatedCapture",
    "SimulationOptions",
    "simulate_captures",
    "truth_extrinsics",
]
