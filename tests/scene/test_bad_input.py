"""Inputs in which nothing can be seen, or everything is wrong: never an all-clear."""

from collections.abc import Callable
from dataclasses import replace

import cv2
import numpy as np
import pytest

from lce_rig.core.calibration import ResultFile
from lce_rig.core.data import Image, Scan
from lce_rig.core.geometry import exp_so3
from lce_rig.pipeline.watch_drift import SceneCaptures
from lce_rig.simulate import truth_extrinsics
from lce_rig.timing.scan_pairing import Frame
from tests.scene.conftest import SEED

Corruption = Callable[[Image, Scan, np.random.Generator], tuple[Image, Scan]]


def _of_image(change):
    def corrupt(image, scan, rng):
        pixels = np.clip(change(image.grey.astype(np.float64), rng), 0, 255).astype(np.uint8)
        return replace(image, pixels=pixels), scan

    return corrupt


def _featureless(image, scan, rng):
    """Put the rig into an empty round room: walls of 6 m radius, a floor without texture."""
    rays = scan.points / np.linalg.norm(scan.points, axis=1, keepdims=True)
    range_m = np.minimum(6.0 / np.hypot(rays[:, 0], rays[:, 1]), 1.0 / np.maximum(-rays[:, 2], 1e-3))
    points = (rays * range_m[:, None]).astype(np.float32)
    grey = 120 + rng.normal(0, 2, image.grey.shape)
    even = replace(scan, points=points, intensity=np.full_like(scan.intensity, 40.0))
    return replace(image, pixels=grey.astype(np.uint8)), even


def _rain(image, scan, rng):
    """Let drops return a fifth of the beams from random points in front of the true ones."""
    is_drop = rng.random(len(scan.points)) < 0.2
    share = np.where(is_drop, rng.uniform(0.1, 1.0, len(scan.points)), 1.0)
    points = (scan.points * share[:, None]).astype(np.float32)
    return image, replace(scan, points=points)


def _tilted(image, scan, _):
    """Let the LiDAR's mount have given way by 6 deg."""
    turn = exp_so3(np.radians([0.0, 6.0, 0.0])).T
    return image, replace(scan, points=(scan.points @ turn.T).astype(np.float32))


CORRUPTIONS: dict[str, Corruption] = {
    "featureless walls": _featureless,
    "night": _of_image(lambda grey, rng: grey / 60 + rng.normal(2, 1, grey.shape)),
    "covered lens": _of_image(lambda grey, rng: 6 + rng.normal(0, 1, grey.shape)),
    "lens smeared": _of_image(lambda grey, _: cv2.GaussianBlur(grey, (0, 0), 25)),
    "rain of outliers": _rain,
    "LiDAR tilted by 6 deg": _tilted,
}
"""What happens to the images and scans of unchanged extrinsics, or changes them beyond the range searched."""


def judge_corrupted(rig, captures, deployed, corrupt):
    """Judge extrinsics by corrupted captures."""
    rng = np.random.default_rng(0)
    result = ResultFile(rig=rig.name, pairs=(deployed,))
    taken = SceneCaptures(rig, result, "the simulated room")
    for capture in captures:
        image, scan = corrupt(capture.images[0], capture.scans[0], rng)
        taken.take_frame(Frame(scan.stamp_ns or 0, (image,), (scan,)))
    (pair,) = taken.judge().pairs
    return pair


@pytest.mark.long
@pytest.mark.parametrize("name", CORRUPTIONS)
def test_corrupted_input_never_passes_drift(seen, name):
    pair = judge_corrupted(seen.rig, seen.captures, seen.truth, CORRUPTIONS[name])
    assert pair.state != "unchanged"
    assert pair.findings[0].code.startswith("scene.") and pair.findings[0].severity != "note"


def test_another_rig_s_result_does_not_hold(seen):
    other = replace(seen.truth, T_cam_lidar=truth_extrinsics(seen.rig, SEED + 1)["cam", "lidar"])
    pair = judge_corrupted(seen.rig, seen.captures, other, lambda image, scan, _: (image, scan))
    assert pair.state != "unchanged"
