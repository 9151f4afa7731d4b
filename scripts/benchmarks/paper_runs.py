"""Every method on every simulated set; results are kept in a table, so that a new method joins the others."""

import csv
import sys
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path

import numpy as np

from benchmarks.baselines import settings_of
from benchmarks.kept import kept_folder
from benchmarks.paper_sets import LEVELS, LIDAR, N_CAPTURES, PaperSet, paper_rig, paper_set
from benchmarks.tables import compare
from lce_rig.calibrate import (
    CalibrateOptions,
    CaptureCandidates,
    EstimateSettings,
    capture_residual,
    fit_extrinsic,
)
from lce_rig.core.board import Board
from lce_rig.core.errors import NotEnoughDataError
from lce_rig.core.geometry import Array
from lce_rig.core.results import ImageBoard, Observation

# The middle of the ten levels stands for all where something else is varied.
MIDDLE_LEVEL = 5
_COUNTS, _FIGURES = ("level", "n_captures", "seed"), ("deg", "mm", "mge_mm", "paper_mge_mm")
FRAME_COUNTS = (6, 8, 10, 15, 20, 25, N_CAPTURES)


@dataclass(frozen=True)
class Run:
    """The error of one method on one simulated set, NaN where it refused it.

    Attributes:
        method: name of the method, or of a variant of it.
        level: of noise.
        n_captures: the first so many of the set.
        seed: of the set.
        deg, mm: rotation and translation off by.
        mge_mm: mean geometric error as docs/conventions.md defines it.
        paper_mge_mm: the same as the paper's code counts it, see `paper_mge_m`.
    """

    method: str
    level: int
    n_captures: int
    seed: int
    deg: float
    mm: float
    mge_mm: float
    paper_mge_mm: float


def simulated_runs(folder: Path, n_seeds: int, methods: Sequence[str], anew: Sequence[str]) -> list[Run]:
    """Run methods at all levels, and at the middle level on fewer captures; what is kept is not run again.

    Args:
        folder: detections and results are kept in it.
        n_seeds: sets.
        methods: to run.
        anew: those of them that have changed since their results were kept.
    """
    sets = folder / "sets"
    path = kept_folder(sets, paper_rig()) / "simulated.csv"
    runs = [run for run in read_runs(path) if run.method not in anew]
    known = EstimateSettings.of(CalibrateOptions(n_draws=0), paper_rig().lidars[LIDAR])
    for seed in range(n_seeds):
        missing = [name for name in methods if (name, seed) not in {(run.method, run.seed) for run in runs}]
        if not missing:
            continue
        seen = paper_set(sets, seed)
        for level in LEVELS:
            counts = FRAME_COUNTS if level == MIDDLE_LEVEL else (N_CAPTURES,)
            for method in missing:
                options = settings_of(method, known)
                runs += [measure(seen, method, level, seed, n, options) for n in counts]
        print(f"set {seed + 1} of {n_seeds} done", file=sys.stderr, flush=True)
        write_runs(path, runs)
    return [run for run in runs if run.seed < n_seeds]


def measure(
    seen: PaperSet, name: str, level: int, seed: int, n_captures: int, options: EstimateSettings
) -> Run:
    """Calibrate the first captures of a set at a level and hold the result against the truth."""
    board = paper_rig().board.to_board()
    try:
        estimate = fit_extrinsic(_candidates(seen, level, n_captures), board, options)
    except NotEnoughDataError:
        return Run(name, level, n_captures, seed, *[float("nan")] * 4)
    deg, mm = compare(estimate.T_cam_lidar, seen.T_cam_lidar)
    paper_mm = 1000 * paper_mge_m(estimate.T_cam_lidar, estimate.observations.values(), board)
    return Run(name, level, n_captures, seed, deg, mm, 1000 * estimate.metrics.mge_m, paper_mm)


def _candidates(seen: PaperSet, level: int, n_captures: int) -> list[CaptureCandidates]:
    both = [(placement.image, placement.scans[level]) for placement in seen.placements[:n_captures]]
    return [
        CaptureCandidates(f"{index:06d}", image, scan)
        for index, (image, scan) in enumerate(both)
        if isinstance(image, ImageBoard) and isinstance(scan, list)
    ]


def paper_mge_m(T_cam_lidar: Array, observations: Iterable[Observation], board: Board) -> float:
    """Compute the mean geometric error as the paper's code counts it.

    Its points lie on the LiDAR's fitted plane, so that range noise is not in it, and its count halves the
    edge error.
    """
    planes, edges = [], []
    for observation in observations:
        lidar = observation.lidar
        height = lidar.points @ lidar.plane[:3] + lidar.plane[3]
        flat = replace(lidar, points=lidar.points - height[:, None] * lidar.plane[:3])
        residual = capture_residual(T_cam_lidar, replace(observation, lidar=flat), board)
        planes.append(residual.plane_mean_m)
        edges.append(residual.edge_mean_m / 2)
    return float(np.mean(planes) + np.nanmean(edges))


def read_runs(path: Path) -> list[Run]:
    """Read kept results; none where there is no such file."""
    if not path.exists():
        return []
    kinds = {field.name: field.type for field in fields(Run)}
    with path.open(newline="") as file:
        return [
            Run(**{name: kinds[name](cell) for name, cell in row.items()}) for row in csv.DictReader(file)
        ]


def write_runs(path: Path, runs: Iterable[Run]) -> None:
    """Keep results as a table."""
    with path.open("w", newline="") as file:
        writer = csv.DictWriter(file, [field.name for field in fields(Run)])
        writer.writeheader()
        writer.writerows(asdict(run) for run in runs)
