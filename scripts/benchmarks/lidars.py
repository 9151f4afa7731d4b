"""Other LiDARs than a VLP-16, simulated: boards found, errors against exact truth, time of the search."""

import time
from pathlib import Path

import numpy as np
from scipy import stats

import lce_rig as lce
from benchmarks.tables import compare, print_head, print_row
from lce_rig.core.geometry import Array, difference
from lce_rig.core.results import LidarBoard
from lce_rig.detect.finder import BoardFinder
from lce_rig.judge.reach import covariance_alone
from lce_rig.rig import Rig, find_profile, parse_rig, read_profile
from lce_rig.session import Session
from lce_rig.simulate import SimulationOptions, simulate_captures, truth_extrinsics

_MODELS = ("VLP-16", "OS0-64", "OS0-128", "OS1-64", "OS1-128", "XT32", "HDL-32E", "VLP-32C")
_SEED = 7
_N_REPEATS = 5


def bench_lidars(n_captures: int, folder: Path, only: str = "") -> None:
    """Print a row of each model.

    Args:
        n_captures: of each session.
        folder: where simulated sessions are kept.
        only: models whose name contains this.
    """
    print_head(
        "LiDAR",
        "points",
        "boards found",
        "search, ms of CPU",
        "error",
        "reported sigma",
        "chi2 of 6, p",
        "verdict",
    )
    for model in _MODELS:
        if only in model:
            _bench_model(model, n_captures, folder)


def _bench_model(model: str, n_captures: int, folder: Path) -> None:
    session, T_cam_lidar, T_lidar_board = _simulate(model, n_captures, folder)
    scans = [capture.scan("lidar") for capture in session.captures]
    finder = BoardFinder(session.rig)
    best_s = np.full(len(scans), np.inf)
    for _ in range(_N_REPEATS):
        for k, scan in enumerate(scans):
            begun = time.process_time()
            finder.search_scan(scan)
            best_s[k] = min(best_s[k], time.process_time() - begun)
    is_found = [_is_found(finder.scan(scan), T) for scan, T in zip(scans, T_lidar_board, strict=True)]
    points = f"{np.median([len(scan.points) for scan in scans]):.0f}"
    found = f"{sum(is_found)} of {len(scans)}"
    took = f"{1e3 * np.median(best_s):.0f}"
    try:
        pair = lce.calibrate_session(session).pairs[0]
    except lce.LceRigError as error:
        print_row(model, points, found, took, "-", "-", "-", error.what)
        return
    deg, mm = compare(pair.T_cam_lidar, T_cam_lidar)
    tangent = difference(pair.T_cam_lidar, T_cam_lidar)
    chi2 = float(tangent @ np.linalg.solve(covariance_alone(pair), tangent))
    sigma = f"{pair.sigma_rotation_deg:.3f} deg, {1e3 * pair.sigma_translation_m:.1f} mm"
    p = f"{chi2:.1f}, {stats.chi2.sf(chi2, 6):.2f}"
    print_row(model, points, found, took, f"{deg:.3f} deg, {mm:.1f} mm", sigma, p, pair.verdict)


def _is_found(found: object, T_lidar_board: Array) -> bool:
    """Return whether the likeliest surface is the board."""
    if not isinstance(found, list):
        return False
    best: LidarBoard = found[0]
    return float(np.linalg.norm(best.T_lidar_board[:3, 3] - T_lidar_board[:3, 3])) < 0.05


def _simulate(model: str, n_captures: int, folder: Path) -> tuple[Session, Array, list[Array]]:
    """Simulate a session of a model, or open the one that is kept; with the truth."""
    rig = _rig(model)
    path = folder / f"{rig.name}-{_SEED}-{n_captures}"
    options, truths = SimulationOptions.for_rig(rig.name), path / "boards.npy"
    T_cam_lidar = truth_extrinsics(rig, _SEED, options)["cam", "lidar"]
    if not truths.exists():
        boards = []
        with Session.resume(path, rig) if path.exists() else Session.create(path, rig) as session:
            for capture in simulate_captures(rig, n_captures=n_captures, seed=_SEED, options=options):
                if capture.index >= len(session.captures):
                    session.add_capture(capture.images, capture.scans, {"source": "simulated"})
                boards.append(capture.T_lidar_board["lidar"])
        np.save(truths, np.stack(boards))
    return Session.open(path), T_cam_lidar, list(np.load(truths))


def _rig(model: str) -> Rig:
    text = read_profile(find_profile("os1_64"))
    name = "".join(c if c.isalnum() else "_" for c in model.lower())
    return parse_rig(
        text.replace("model: OS1-64", f"model: {model}").replace("name: os1_64", f"name: {name}")
    )
