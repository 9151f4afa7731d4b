"""The simulated rig with still boards: errors against exact truth over many seeds."""

from collections.abc import Iterator

import numpy as np

from benchmarks.tables import print_head, print_row, rms
from lce_rig.core.geometry import difference
from lce_rig.detect.detection import Detections, ImageDetection, LidarDetection
from lce_rig.detect.finder import BoardFinder
from lce_rig.judge.reach import covariance_alone
from lce_rig.pipeline.calibration import calibrate_detections
from lce_rig.rig import load_rig


def bench_simulated(n_seeds: int, n_captures: int = 30) -> None:
    """Tabulate errors against exact truth."""
    head = "rig, seeds, captures, found by both, rms deg, rms mm, reported deg / mm, NEES, not passed"
    print_head(*head.split(", "))
    for name in ("rlfs",):
        rows = list(_simulated_runs(name, n_seeds, n_captures))
        deg, mm, nees, sigma_deg, sigma_mm, found, passed = np.array(rows).T
        print_row(
            name,
            n_seeds,
            n_captures,
            f"{int(found.sum())} of {n_seeds * n_captures}",
            f"{rms(deg):.4f}",
            f"{rms(mm):.2f}",
            f"{rms(sigma_deg):.4f} / {rms(sigma_mm):.2f}",
            f"{nees.mean():.1f}",
            int(n_seeds - passed.sum()),
        )


def _simulated_runs(name: str, n_seeds: int, n_captures: int) -> Iterator[tuple[float, ...]]:
    from lce_rig.simulate import SimulationOptions, simulate_captures, truth_extrinsics

    rig = load_rig(name)
    options = SimulationOptions.for_rig(name)
    for seed in range(n_seeds):
        images: dict[str, ImageDetection] = {}
        scans: dict[str, LidarDetection] = {}
        for capture in simulate_captures(rig, n_captures=n_captures, seed=seed, options=options):
            images[f"{capture.index:06d}"] = BoardFinder(rig).image(capture.images[0])
            scans[f"{capture.index:06d}"] = BoardFinder(rig).scan(capture.scans[0])
        camera, lidar = next(iter(rig.cameras)), next(iter(rig.lidars))
        detections = Detections({(camera, "frames"): images}, {lidar: scans})
        (calibration, *_), _ = calibrate_detections(rig, detections)
        error = difference(calibration.T_cam_lidar, truth_extrinsics(rig, seed, options)[camera, lidar])
        nees = float(error @ np.linalg.solve(covariance_alone(calibration), error))
        yield (
            float(np.degrees(np.linalg.norm(error[3:]))),
            float(1000 * np.linalg.norm(error[:3])),
            nees,
            calibration.sigma_rotation_deg,
            1000 * calibration.sigma_translation_m,
            calibration.n_detected,
            calibration.verdict == "pass",
        )
