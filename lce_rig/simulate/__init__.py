"""The simulated rig: captures of any profile with exact truth, errors and clutter like real ones."""

from lce_rig.simulate.options import CameraNoise, EventNoise, HandMotion, LidarNoise, SimulationOptions
from lce_rig.simulate.sampling import (
    SimulatedCapture,
    SimulatedRecording,
    board_time_ns,
    capture_truth,
    recording_truth,
    simulate_captures,
    simulate_recording,
)
from lce_rig.simulate.stage import rig_truth, truth_extrinsics

__all__ = [
    "CameraNoise",
    "EventNoise",
    "HandMotion",
    "LidarNoise",
    "SimulatedCapture",
    "SimulatedRecording",
    "SimulationOptions",
    "board_time_ns",
    "capture_truth",
    "recording_truth",
    "rig_truth",
    "simulate_captures",
    "simulate_recording",
    "truth_extrinsics",
]
