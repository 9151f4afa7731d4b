"""A simulated DAVIS and VLP-16 before a board that a hand moves slowly, made once and shared by the tests."""

from dataclasses import replace
from functools import cache

from lce_rig.core.data import Events
from lce_rig.io.ros.bag_recorder import BagRecorder
from lce_rig.rig import load_rig
from lce_rig.simulate import HandMotion, SimulationOptions, simulate_recording
from lce_rig.simulate.sampling import stamp_of
from tests.exact_lidar import EXACT
from tests.shared import compute_once

DURATION_S = 1.8
# What comes before is there for its events only.
_FIRST_SCAN_NS = 1_150_000_000
#: Thin beams, a board that hangs in the air and no smear: quick to make.
OPTIONS = SimulationOptions(
    carrier="none",
    lidar=replace(EXACT, range_sigma_m=0.008),
    distance_m=(1.5, 2.2),
    frame_every_s=0.1,
    exposure_s=0.0,
    hand=HandMotion(speed_mps=(0.05, 0.4), rest_s=60.0),
)


@cache
def rig():
    return load_rig("rles")


@cache
def recording():
    return simulate_recording(rig(), duration_s=DURATION_S, seed=2, options=OPTIONS)


@cache
def samples():
    """Events of nearly two seconds, and the scans and frames at their end."""
    return compute_once("moves", _sample)


def _sample():
    start_ns = recording().start_ns
    return tuple(s for s in recording() if isinstance(s, Events) or stamp_of(s) >= start_ns + _FIRST_SCAN_NS)


def events():
    return [s for s in samples() if isinstance(s, Events)]


def without(*kinds):
    return [s for s in samples() if not isinstance(s, kinds)]


def bag(path, samples):
    """Write samples as a bag."""
    with BagRecorder(path, rig()) as recorder:
        for sample in samples:
            recorder.write(sample)
    return path
