"""Times of one core and memory."""

import resource
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

import lce_rig as lce
from benchmarks.measured import measure
from benchmarks.recordings import SETS
from benchmarks.tables import print_head, print_row
from lce_rig.calibrate import EstimateSettings, fit_extrinsic
from lce_rig.core.results import ImageBoard, Observation
from lce_rig.detect.finder import BoardFinder

# Key, description, unit and value of each measurement.
_Measured = Iterator[tuple[str, str, str, float]]
_MS = "{:.1f} ms"


def bench_speed() -> None:
    """Tabulate times, processor seconds of one core, and the memory of the command line."""
    print_head("what", "figure")
    with tempfile.TemporaryDirectory() as scratch:
        session = Path(scratch) / "session"
        SETS[0].collect(session)
        for part in (_detector_speed, _command_speed, _search_without_rings):
            for key, what, unit, value in part(session):
                print_row(what, unit.format(value))
                measure(f"speed.{key}", unit, value)


def _detector_speed(path: Path) -> _Measured:
    from lce_rig.session import Session

    session = Session.open(path)
    rig, board = session.rig, session.rig.board.to_board()
    scans = [capture.scan("lidar") for capture in session.captures]
    found = [BoardFinder(rig).scan(scan) for scan in scans]
    pictures = [capture.image("cam", "frames") for capture in session.captures]
    yield (
        "scan",
        "board in a full VLP-16 scan, no prior, median",
        _MS,
        milliseconds(lambda k: BoardFinder(rig).scan(scans[k])),
    )
    boards = [result if isinstance(result, list) else [] for result in found]
    poses = [[each.T_lidar_board for each in of_scan] for of_scan in boards]
    yield (
        "scan-tracked",
        "tracked, median",
        _MS,
        milliseconds(lambda k: BoardFinder(rig).look_in_scan(scans[k], poses[k])),
    )
    yield (
        "image",
        "board in a 1280x720 picture, median",
        _MS,
        milliseconds(lambda k: BoardFinder(rig).image(pictures[k])),
    )
    finder = BoardFinder(rig)
    seen = [finder.search_image(picture).located for picture in pictures]
    lasts = [board if isinstance(board, ImageBoard) else None for board in seen]
    yield (
        "image-tracked",
        "tracked, median",
        _MS,
        milliseconds(lambda k: finder.search_image(pictures[k], lasts[k])),
    )
    detections = lce.detect_boards(session)
    pair = detections.pairs[0]
    both = ((name, *detections.of(pair, name)) for name in detections.captures(pair))
    candidates = [
        Observation.of(n, i, s) for n, i, s in both if isinstance(i, ImageBoard) and isinstance(s, list)
    ]
    thirty = (candidates * 2)[:30]
    thirty = [replace(c, capture=f"{k:06d}") for k, c in enumerate(thirty)]
    start = time.process_time()
    fit_extrinsic(thirty, board, EstimateSettings("paper"))
    seconds = time.process_time() - start
    yield "algorithm-1", "Algorithm 1, N = 30, with certificate", "{:.2f} s", seconds


def _search_without_rings(path: Path) -> _Measured:
    from lce_rig.session import Session

    simulated = path.with_name("mid360")
    words = ["simulate", "--rig", "mid360", "--captures", "8", str(simulated)]
    subprocess.run([sys.executable, "-m", "lce_rig", *words], check=True, capture_output=True)
    session = Session.open(simulated)
    scans = [capture.scan("lidar") for capture in session.captures]
    yield (
        "without-rings",
        f"board in a simulated Mid-360's point cloud of {len(scans[0].points)} points, median",
        "{:.0f} ms",
        milliseconds(lambda k: BoardFinder(session.rig).scan(scans[k]), len(scans)),
    )


def milliseconds(work: Callable[[int], object], n: int = 18) -> float:
    """Time `work(k)` for k < n and return the median, ms."""
    work(0)
    times = []
    for k in range(n):
        start = time.process_time()
        work(k)
        times.append(time.process_time() - start)
    return 1000 * float(np.median(times))


def _command_speed(session: Path) -> _Measured:
    for words in (["calibrate", str(session)], ["--help"]):
        shutil.rmtree(session / "detections", ignore_errors=True)
        start = time.perf_counter()
        subprocess.run([sys.executable, "-m", "lce_rig", *words], check=False, capture_output=True)
        is_help = words == ["--help"]
        what = "lce-rig --help" if is_help else "lce-rig calibrate on rlfs01 from cold"
        yield "help" if is_help else "calibrate", what, "{:.2f} s", time.perf_counter() - start
        if not is_help:
            peak_mb = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss / 1024
            yield "calibrate-memory", "its peak memory", "{:.0f} MB", peak_mb
