"""The simulated experiment of the LCE-Calib paper: errors at ten levels of noise, beside the published ones.

References:
    Jiao et al., "LCE-Calib: Automatic LiDAR-Frame/Event Camera Extrinsic Calibration With a Globally Optimal
    Solution", IEEE/ASME Transactions on Mechatronics, 2023.
"""

from pathlib import Path
from typing import get_args

import numpy as np

from benchmarks.measured import measure
from benchmarks.paper_sets import LEVELS, LIDAR, RANGE_SIGMA_M, PaperSet, paper_rig, paper_set
from benchmarks.tables import compare, print_head, print_row, rms
from lce_rig.calibrate import CalibrateOptions, EstimateSettings, fit_extrinsic
from lce_rig.core.calibration import Method
from lce_rig.core.results import ImageBoard, Observation

# Of the paper's Algorithm 1 on one set, by level.
_PUBLISHED_DEG = (0.0917, 0.0690, 0.0802, 0.0854, 0.2512, 0.1624, 0.1577, 0.2020, 0.2448, 0.4001)
_PUBLISHED_MM = (0.38, 0.39, 0.49, 0.75, 7.24, 6.51, 4.56, 6.34, 9.70, 11.93)
_SIZE = "{:.3f} deg, {:.2f} mm"


def bench_paper(n_seeds: int, folder: Path) -> None:
    """Print the errors of both methods, rms over sets.

    Args:
        n_seeds: simulated sets.
        folder: their detections are kept in it.
    """
    sets = [paper_set(folder / "sets", seed) for seed in range(n_seeds)]
    print_head(f"{n_seeds} sets", *(f"{100 * RANGE_SIGMA_M[level - 1]:.1f} cm" for level in LEVELS))
    names = [f"paper.{100 * RANGE_SIGMA_M[level - 1]:.1f}-cm" for level in LEVELS]
    for method in get_args(Method):
        errors = np.array([[_errors(one, level, method) for level in LEVELS] for one in sets])
        print_row(f"rotation deg, {method}", *(f"{rms(column):.3f}" for column in errors[:, :, 0].T))
        print_row(f"translation mm, {method}", *(f"{rms(column):.2f}" for column in errors[:, :, 1].T))
        for name, column in zip(names, errors.transpose(1, 2, 0), strict=True):
            measure(f"{name}.{method}", _SIZE, *(rms(values) for values in column))
    for name, *published in zip(names, _PUBLISHED_DEG, _PUBLISHED_MM, strict=True):
        measure(f"{name}.published", _SIZE, *published)
    print_row("rotation deg, published", *_PUBLISHED_DEG)
    print_row("translation mm, published", *_PUBLISHED_MM)


def _errors(simulated: PaperSet, level: int, method: Method) -> tuple[float, float]:
    """Calibrate a set at one level of noise and return its error in deg and mm."""
    candidates = [
        Observation.of(f"{index:06d}", placement.image, boards)
        for index, placement in enumerate(simulated.placements)
        if isinstance(placement.image, ImageBoard) and isinstance(boards := placement.scans[level], list)
    ]
    rig = paper_rig()
    settings = EstimateSettings.of(CalibrateOptions(method), rig.lidars[LIDAR])
    estimate = fit_extrinsic(candidates, rig.board.to_board(), settings)
    return compare(estimate.T_cam_lidar, simulated.T_cam_lidar)
