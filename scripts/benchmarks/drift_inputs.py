"""Inputs that drift must not take for unchanged extrinsics, and a minute of recording against the clock."""

import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

from benchmarks.tables import print_head, print_row
from lce_rig.core.data import Image, Scan
from lce_rig.core.geometry import Array, exp_so3, perturb
from lce_rig.core.results import Calibration
from lce_rig.export.result import SavedResult, read_result, write_result
from lce_rig.io.ros.bag_recorder import BagRecorder
from lce_rig.pipeline.drift import PairDrift, judge
from lce_rig.pipeline.scene_captures import SceneCaptures
from lce_rig.rig import Rig, load_rig
from lce_rig.simulate import SimulatedCapture, simulate_captures, truth_extrinsics
from lce_rig.timing.scan_pairing import Frame

Corruption = Callable[[Image, Scan, np.random.Generator], tuple[Image, Scan]]
_SEED, _N_CAPTURES, _MINUTE_S, _PERIOD_NS = 2, 6, 60, 100_000_000


def _of_image(change: Callable[[Array, np.random.Generator], Array]) -> Corruption:
    def corrupt(image: Image, scan: Scan, rng: np.random.Generator) -> tuple[Image, Scan]:
        pixels = np.clip(change(image.grey.astype(np.float64), rng), 0, 255).astype(np.uint8)
        return replace(image, pixels=pixels), scan

    return corrupt


def _featureless(image: Image, scan: Scan, rng: np.random.Generator) -> tuple[Image, Scan]:
    """Stand in an empty round room: walls of 6 m radius, a floor without a print."""
    rays = scan.points / np.linalg.norm(scan.points, axis=1, keepdims=True)
    range_m = np.minimum(6.0 / np.hypot(rays[:, 0], rays[:, 1]), 1.0 / np.maximum(-rays[:, 2], 1e-3))
    points = (rays * range_m[:, None]).astype(np.float32)
    grey = 120 + rng.normal(0, 2, image.grey.shape)
    even = replace(scan, points=points, intensity=np.full_like(scan.intensity, 40.0))
    return replace(image, pixels=grey.astype(np.uint8)), even


def _rain(image: Image, scan: Scan, rng: np.random.Generator) -> tuple[Image, Scan]:
    """Let drops return a fifth of the beams from anywhere before what they should meet."""
    is_drop = rng.random(len(scan.points)) < 0.2
    share = np.where(is_drop, rng.uniform(0.1, 1.0, len(scan.points)), 1.0)
    points = (scan.points * share[:, None]).astype(np.float32)
    return image, replace(scan, points=points)


def _tilted(image: Image, scan: Scan, _: np.random.Generator) -> tuple[Image, Scan]:
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


def judge_corrupted(
    rig: Rig, captures: list[SimulatedCapture], deployed: Calibration, corrupt: Corruption
) -> PairDrift:
    """Judge extrinsics by corrupted captures."""
    rng = np.random.default_rng(0)
    result = SavedResult(rig.name, "a benchmark", (deployed,), {})
    taken = SceneCaptures(rig, result, "the simulated room")
    for capture in captures:
        image, scan = corrupt(capture.images[0], capture.scans[0], rng)
        taken.take_frame(Frame(scan.stamp_ns or 0, (image,), (scan,)))
    (pair,) = judge(rig, result, taken).pairs
    return pair


def bench_drift_inputs() -> None:
    """Print the tables of docs/benchmarks.md."""
    rig = load_rig("rlfs")
    captures = list(simulate_captures(rig, n_captures=_N_CAPTURES, seed=_SEED))
    with tempfile.TemporaryDirectory() as folder:
        truth = _deployed(rig, truth_extrinsics(rig, _SEED)["cam", "lidar"])
        print_head("input", "state", "first finding")
        cases = {"none": lambda image, scan, rng: (image, scan), **CORRUPTIONS}
        for name, corrupt in cases.items():
            pair = judge_corrupted(rig, captures, truth, corrupt)
            print_row(name, pair.state, pair.summary.code)
        other = _deployed(rig, truth_extrinsics(rig, _SEED + 1)["cam", "lidar"])
        pair = judge_corrupted(rig, captures, other, cases["none"])
        print_row("another rig's result", pair.state, pair.summary.code)
        _bench_minute(rig, captures, truth, Path(folder))


def _deployed(rig: Rig, T_cam_lidar: Array) -> Calibration:
    from lce_rig.core.results import Certificate, Metrics

    cov = np.diag([0.003] * 3 + [0.0015] * 3) ** 2
    return Calibration(
        camera=next(iter(rig.cameras)),
        channels=("frames",),
        lidar=next(iter(rig.lidars)),
        T_cam_lidar=perturb(T_cam_lidar, np.zeros(6)),
        cov=cov,
        certificate=Certificate(True, 1e-9),
        metrics=Metrics(0.008, 0.006, 0.1),
        n_captures=10,
        n_detected=10,
        captures_used=("000000",),
        captures_refused={},
        verdict="pass",
    )


def _bench_minute(rig: Rig, captures: list[SimulatedCapture], deployed: Calibration, folder: Path) -> None:
    """Time the command on a bag of a minute, images of 1280x720 and scans ten times a second."""
    bag, result = folder / "minute.bag", folder / "result.json"
    start_ns = captures[0].scans[0].stamp_ns or 0
    with BagRecorder(bag, rig) as recorder:
        for k in range(_MINUTE_S * 1_000_000_000 // _PERIOD_NS):
            capture, stamp_ns = captures[k // 100 % len(captures)], start_ns + k * _PERIOD_NS
            recorder.write(replace(capture.scans[0], stamp_ns=stamp_ns, host_ns=None))
            recorder.write(replace(capture.images[0], stamp_ns=stamp_ns + _PERIOD_NS // 2, host_ns=None))
    write_result(result, rig.name, [deployed])
    assert read_result(result).pairs
    command = [sys.executable, "-m", "lce_rig", "drift", str(bag), "--rig", "rlfs", "--result", str(result)]
    began_s = time.monotonic()
    code = subprocess.run(command, check=False).returncode
    took_s = time.monotonic() - began_s
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    size_gb = bag.stat().st_size / 1e9
    print(
        f"\na minute ({size_gb:.1f} GB): {took_s:.1f} s, processor {used.ru_utime + used.ru_stime:.1f} s, "
        f"peak memory {used.ru_maxrss / 1024:.0f} MB, exit code {code}"
    )
