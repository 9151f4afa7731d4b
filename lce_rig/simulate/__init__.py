"""The simulated rig: captures of any profile with exact truth, errors and clutter like real ones."""

from lce_rig.simulate.captures import SimulatedCapture, simulate_captures
from lce_rig.simulate.options import CameraNoise, EventNoise, HandMotion, LidarNoise, SimulationOptions
from lce_rig.simulate.simulated_recording import SimulatedRecording, simulate_recording
from lce_rig.simulate.stage import truth_extrinsics
from lce_rig.simulate.truth import board_time_ns, capture_truth, recording_truth, rig_truth

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
