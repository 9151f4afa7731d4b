#!/usr/bin/env python3
"""Measure what docs/benchmarks.md claims and print it as Markdown tables.

    scripts/bench.py real        recordings by others, in the folder that LCE_RIG_DATA names
    scripts/bench.py simulated   error against exact truth over many seeds
    scripts/bench.py speed       detection, Algorithm 1, the command line
    scripts/bench.py             all of them

Detections are made anew; random splits are seeded. Run it on a machine that does nothing else.
"""

import argparse
import csv
import os
import resource
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from lce_rig import pipeline
from lce_rig.calibrate import CalibrateOptions, CaptureCandidates
from lce_rig.calibrate import calibrate as estimate_extrinsic
from lce_rig.core.geometry import Array, difference, exp_so3, invert, pose
from lce_rig.core.results import ImageBoard
from lce_rig.rig import Rig, load_rig

RIGS = Path(__file__).resolve().parents[1] / "tests" / "rigs"


@dataclass(frozen=True)
class RecordedSet:
    """A folder of recordings, the profile that fits it, and the channel its pictures belong to."""

    name: str
    rig: str
    channel: str = "frames"


SETS = (
    RecordedSet("rlfs01", "rlfs"),
    RecordedSet("sss_noise15mm", "sss"),
    RecordedSet("rles01_lf", "rles"),
    RecordedSet("rles01_le", "rles", "events"),
    RecordedSet("rles02_lf", str(RIGS / "rles02.yaml")),
    RecordedSet("rles02_le", str(RIGS / "rles02.yaml"), "events"),
    RecordedSet("acfr_vlp16", str(RIGS / "acfr.yaml")),
)


def main() -> None:
    """Run the parts asked for."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("part", nargs="?", choices=["real", "simulated", "speed", "all"], default="all")
    parser.add_argument("--seeds", type=int, default=20, help="simulated sessions (default 20)")
    parser.add_argument("--splits", type=int, default=20, help="random split halves (default 20)")
    parser.add_argument("--only", default="", help="recorded sets whose name contains this")
    arguments = parser.parse_args()
    if arguments.part in ("real", "all"):
        bench_real(arguments.splits, arguments.only)
    if arguments.part in ("simulated", "all"):
        bench_simulated(arguments.seeds)
    if arguments.part in ("speed", "all"):
        bench_speed()


def print_head(*titles: str) -> None:
    """Print the head of a Markdown table."""
    print("| " + " | ".join(titles) + " |\n|" + "---|" * len(titles), flush=True)


def print_row(*cells: object) -> None:
    """Print a row of a Markdown table."""
    print("| " + " | ".join(map(str, cells)) + " |", flush=True)


# ------------------------------------------------------------------------------------------------ recordings


def bench_real(n_splits: int, only: str) -> None:
    """Tabulate every recorded set that is there."""
    head = "set, pairs, picture, LiDAR, used, EGT deg, EGT mm, split deg, split mm, MGE mm, claimed deg / mm"
    print_head(*head.split(", "), "verdict")
    for recorded in SETS:
        folder = recordings() / recorded.name
        if folder.is_dir() and only in recorded.name:
            print_row(*_real_row(recorded, folder, n_splits))


def _real_row(recorded: RecordedSet, folder: Path, n_splits: int) -> tuple[object, ...]:
    with tempfile.TemporaryDirectory() as scratch:
        session = Path(scratch) / "session"
        collect(recorded, folder, session)
        rig, detections = detect(session)
    pair = detections.pairs[0]
    names = detections.captures(pair)
    n_image = sum(isinstance(detections.of(pair, name)[0], ImageBoard) for name in names)
    n_lidar = sum(isinstance(detections.of(pair, name)[1], list) for name in names)
    calibration, estimate = pipeline.calibrate(rig, detections, CalibrateOptions())[0][0]
    error = compare(estimate.T_cam_lidar, reference_of(folder))
    candidates = candidates_of(detections, pair)
    split = split_halves(candidates, rig, n_splits)
    return (
        recorded.name,
        len(names),
        n_image,
        n_lidar,
        len(estimate.used),
        *(f"{value:.3f}" if i == 0 else f"{value:.1f}" for i, value in enumerate(error)),
        *(f"{value:.3f}" if i == 0 else f"{value:.1f}" for i, value in enumerate(split)),
        f"{1000 * calibration.metrics.mge_m:.1f}",
        f"{calibration.sigma_rotation_deg:.3f} / {1000 * calibration.sigma_translation_m:.1f}",
        calibration.verdict,
    )


def recordings() -> Path:
    """Find the recordings by others."""
    folder = os.environ.get("LCE_RIG_DATA")
    if not folder or not Path(folder).is_dir():
        sys.exit("LCE_RIG_DATA names no folder of recordings")
    return Path(folder)


def collect(recorded: RecordedSet, folder: Path, session: Path) -> None:
    """Build a session with the command a user would type."""
    words = [
        "collect",
        "--rig",
        recorded.rig,
        "--channel",
        recorded.channel,
        "--from",
        str(folder),
        str(session),
    ]
    subprocess.run([sys.executable, "-m", "lce_rig", *words], check=True, stderr=subprocess.DEVNULL)


def detect(path: Path) -> tuple[Rig, pipeline.Detections]:
    """Detect the boards of a session."""
    from lce_rig.session import Session

    session = Session.open(path)
    return session.rig, pipeline.detect(session)


def candidates_of(detections: pipeline.Detections, pair: pipeline.Pair) -> list[CaptureCandidates]:
    """List the captures in which both sensors found boards."""
    both = ((name, *detections.of(pair, name)) for name in detections.captures(pair))
    return [
        CaptureCandidates(n, i, s) for n, i, s in both if isinstance(i, ImageBoard) and isinstance(s, list)
    ]


def reference_of(folder: Path) -> Array:
    """Read the reference extrinsic of a recorded set."""
    from lce_rig.export.reference import read_reference

    if (folder / "reference.json").exists():
        T = read_reference(folder / "reference.json").of("", "")
        assert T is not None
        return T
    # 50 runs of another tool, LiDAR <- camera: roll, pitch, yaw about fixed axes and a translation.
    with (folder / "reference_50_runs.csv").open() as file:
        runs = np.array([[float(cell) for cell in row] for row in list(csv.reader(file))[1:]])
    roll, pitch, yaw, *t = np.median(runs, axis=0)
    x, y, z = np.eye(3)
    return invert(pose(exp_so3(yaw * z) @ exp_so3(pitch * y) @ exp_so3(roll * x), np.array(t)))


def compare(T: Array, T_reference: Array) -> tuple[float, float]:
    """Measure a difference in deg and mm."""
    tangent = difference(T, T_reference)
    return float(np.degrees(np.linalg.norm(tangent[3:]))), float(1000 * np.linalg.norm(tangent[:3]))


def split_halves(candidates: list[CaptureCandidates], rig: Rig, n_splits: int) -> tuple[float, float]:
    """Calibrate random halves apart and give the rms of their differences, deg and mm."""
    rng = np.random.default_rng(0)
    options = CalibrateOptions(n_draws=20)
    differences = []
    for _ in range(n_splits):
        order = rng.permutation(len(candidates))
        middle = len(order) // 2
        halves = [[candidates[i] for i in sorted(part)] for part in (order[:middle], order[middle:])]
        T_1, T_2 = (estimate_extrinsic(half, rig.board.to_board(), options).T_cam_lidar for half in halves)
        differences.append(compare(T_1, T_2))
    deg, mm = np.sqrt(np.mean(np.square(differences), axis=0))
    return float(deg), float(mm)


# ------------------------------------------------------------------------------------------------- simulation


def bench_simulated(n_seeds: int, n_captures: int = 30) -> None:
    """Tabulate errors against exact truth."""
    head = "rig, seeds, captures, found by both, rms deg, rms mm, claimed deg / mm, NEES, not passed"
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
        images: dict[str, pipeline.ImageDetection] = {}
        scans: dict[str, pipeline.LidarDetection] = {}
        for capture in simulate_captures(rig, n_captures=n_captures, seed=seed, options=options):
            images[f"{capture.index:06d}"] = pipeline.detect_image(rig, capture.images[0])
            scans[f"{capture.index:06d}"] = pipeline.detect_scan(rig, capture.scans[0])
        camera, lidar = next(iter(rig.cameras)), next(iter(rig.lidars))
        detections = pipeline.Detections({(camera, "frames"): images}, {lidar: scans})
        calibration, estimate = pipeline.calibrate(rig, detections, CalibrateOptions(seed=seed))[0][0]
        error = difference(estimate.T_cam_lidar, truth_extrinsics(rig, seed, options)[camera, lidar])
        nees = float(error @ np.linalg.solve(estimate.cov, error))
        yield (
            float(np.degrees(np.linalg.norm(error[3:]))),
            float(1000 * np.linalg.norm(error[:3])),
            nees,
            calibration.sigma_rotation_deg,
            1000 * calibration.sigma_translation_m,
            calibration.n_detected,
            calibration.verdict == "pass",
        )


def rms(values: Array) -> float:
    """Root mean square."""
    return float(np.sqrt(np.mean(np.square(values))))


# ------------------------------------------------------------------------------------------------------ speed


def bench_speed() -> None:
    """Tabulate times, processor seconds of one core, and the memory of the command line."""
    print_head("what", "figure")
    folder = recordings() / "rlfs01"
    with tempfile.TemporaryDirectory() as scratch:
        session = Path(scratch) / "session"
        collect(SETS[0], folder, session)
        for what, figure in (*_detector_speed(session), *_command_speed(session)):
            print_row(what, figure)


def _detector_speed(path: Path) -> Iterator[tuple[str, str]]:
    from lce_rig.detect.lidar_track import track_lidar_board
    from lce_rig.session import Session

    session = Session.open(path)
    rig, board = session.rig, session.rig.board.to_board()
    scans = [capture.scan("lidar") for capture in session.captures]
    found = [pipeline.detect_scan(rig, scan) for scan in scans]
    pictures = [capture.image("cam", "frames") for capture in session.captures]
    yield (
        "board in a full VLP-16 scan, no prior, median",
        milliseconds(lambda k: pipeline.detect_scan(rig, scans[k])),
    )
    yield "tracked, median", milliseconds(lambda k: track_lidar_board(scans[k], board, found[k][0]))  # type: ignore[index]
    yield (
        "board in a 1280x720 picture, median",
        milliseconds(lambda k: pipeline.detect_image(rig, pictures[k])),
    )
    detections = pipeline.detect(session)
    candidates = candidates_of(detections, detections.pairs[0])
    thirty = (candidates * 2)[:30]
    thirty = [CaptureCandidates(f"{k:06d}", c.image, c.lidar) for k, c in enumerate(thirty)]
    start = time.process_time()
    estimate_extrinsic(thirty, board, CalibrateOptions(n_draws=100))
    yield "Algorithm 1, N = 30, I = 100, with certificates", f"{time.process_time() - start:.2f} s"


def milliseconds(work: Callable[[int], object], n: int = 18) -> str:
    """Time `work(k)` for k < n and give the median."""
    work(0)
    times = []
    for k in range(n):
        start = time.process_time()
        work(k)
        times.append(time.process_time() - start)
    return f"{1000 * float(np.median(times)):.1f} ms"


def _command_speed(session: Path) -> Iterator[tuple[str, str]]:
    for words in (["calibrate", str(session)], ["--help"]):
        shutil.rmtree(session / "detections", ignore_errors=True)
        start = time.perf_counter()
        subprocess.run([sys.executable, "-m", "lce_rig", *words], check=False, capture_output=True)
        what = "lce-rig calibrate on rlfs01 from cold" if words[0] == "calibrate" else "lce-rig --help"
        yield what, f"{time.perf_counter() - start:.2f} s"
        if words[0] == "calibrate":
            peak_mb = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss / 1024
            yield "its peak memory", f"{peak_mb:.0f} MB"


if __name__ == "__main__":
    main()
