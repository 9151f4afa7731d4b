"""Cost of `calibrate` after detection, as sessions grow: processor seconds of one core and peak memory."""

import resource
import time
from multiprocessing import get_context
from pathlib import Path

from benchmarks.still_sessions import still_session
from benchmarks.tables import print_head, print_row
from lce_rig.calibrate import CalibrateOptions
from lce_rig.core.calibration import Method
from lce_rig.detect.detection import Detections
from lce_rig.pipeline.calibration import calibrate_detections
from lce_rig.rig import load_rig
from lce_rig.simulate import SimulationOptions

_SIZES = (20, 30, 40, 80, 160, 320, 640)
_METHODS: tuple[Method, ...] = ("paper", "ml")
_RIG, _CORNER_SIGMA_PX = "rlfs", 0.1


def bench_growth(folder: Path) -> None:
    """Tabulate both methods on the first captures of one simulated session, each in a process of its own.

    Args:
        folder: where the session's detections are kept; to simulate them takes minutes.
    """
    print_head("captures", "method", "used", "s of one core", "peak MB")
    with get_context("spawn").Pool(1, maxtasksperchild=1) as pool:
        for n_captures in _SIZES:
            for method in _METHODS:
                print_row(n_captures, method, *pool.apply(_measure, (n_captures, method, folder)))


def _measure(n_captures: int, method: Method, folder: Path) -> tuple[str, str, str]:
    rig = load_rig(_RIG)
    options = SimulationOptions.for_rig(_RIG)
    session = still_session(rig, 0, options, max(_SIZES), _CORNER_SIGMA_PX, folder)
    chosen = session.candidates[:n_captures]
    detections = Detections(
        {(next(iter(rig.cameras)), "frames"): {each.capture: each.image for each in chosen}},
        {next(iter(rig.lidars)): {each.capture: session.places[each.capture] for each in chosen}},
    )
    start = time.process_time()
    (calibration, *_), _ = calibrate_detections(rig, detections, CalibrateOptions(method))
    seconds = time.process_time() - start
    peak_mb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    return str(len(calibration.captures_used)), f"{seconds:.1f}", f"{peak_mb:.0f}"
