"""Stale intrinsics: how often the check finds them, and how often it takes right ones for stale."""

from collections import Counter
from dataclasses import replace

import numpy as np

from benchmarks.tables import print_head, print_row
from lce_rig.core.board import Board
from lce_rig.core.camera import Intrinsics
from lce_rig.core.geometry import Array, exp_so3, pose, transform
from lce_rig.core.planar_pose import solve_planar_pose
from lce_rig.core.results import ImageBoard
from lce_rig.judge.intrinsics_check import check_intrinsics
from lce_rig.lens.lens_estimate import BoardView
from lce_rig.rig import load_rig

# Noise of a corner per coordinate, as recordings of the rig show it.
_RIGS = {"rlfs": 0.03, "rles": 0.05}
_N_CAPTURES = (12, 25)


def bench_intrinsics(n_seeds: int) -> None:
    """Print the number of sessions that fit / do not fit each kind of stale intrinsics."""
    columns: dict[str, dict[str, str]] = {}
    for name, sigma_px in _RIGS.items():
        rig = load_rig(name)
        (camera,) = rig.cameras.values()
        lens, board = camera.to_intrinsics(), rig.board.to_board()
        for n_captures in _N_CAPTURES:
            sessions = [_photograph(lens, board, n_captures, sigma_px, seed) for seed in range(n_seeds)]
            column = columns.setdefault(f"{name}, {n_captures} captures", {})
            for kind, given in _kinds(lens).items():
                column[kind] = _verdicts(sessions, given, board)
    print_head("profile's intrinsics", *columns)
    for kind in next(iter(columns.values())):
        print_row(kind, *(column[kind] for column in columns.values()))


def _kinds(lens: Intrinsics) -> dict[str, Intrinsics]:
    def longer(factor: float) -> Intrinsics:
        return replace(lens, fx_px=factor * lens.fx_px, fy_px=factor * lens.fy_px)

    k1, *rest = lens.distortion
    refocused = tuple(0.93 * k for k in lens.distortion)
    return {
        "right": lens,
        "pixels counted from 1": replace(lens, cx_px=lens.cx_px + 1, cy_px=lens.cy_px + 1),
        "focal length +0.5 %": longer(1.005),
        "focal length -1 %": longer(0.99),
        "focal length +2 %": longer(1.02),
        "focal length -2 %": longer(0.98),
        "principal point 10 px off": replace(lens, cx_px=lens.cx_px + 8, cy_px=lens.cy_px - 6),
        "focal length +2 %, centre 5 px off, distortion -7 %": replace(
            longer(1.02), cx_px=lens.cx_px + 4, cy_px=lens.cy_px - 3, distortion=refocused
        ),
        "k1 20 % too small": replace(lens, distortion=(0.8 * k1, *rest)),
        "no distortion": replace(lens, distortion=()),
        "equidistant without coefficients": replace(lens, model="equidistant", distortion=(0.0,) * 4),
    }


def _verdicts(sessions: list[list[BoardView]], given: Intrinsics, board: Board) -> str:
    checks = [check_intrinsics(views, given, board) for views in sessions]
    counts = Counter(check is not None and check.fits() for check in checks)
    return f"{counts[True]} / {counts[False]}"


def _photograph(lens: Intrinsics, board: Board, n: int, sigma_px: float, seed: int) -> list[BoardView]:
    """Hold a board that is bowed by 0.6 mm, 0.06 % too wide and badly printed n times before a lens."""
    rng = np.random.default_rng(seed)
    corners = imperfect_corners(board, rng)
    views: list[BoardView] = []
    while len(views) < n:
        ray = lens.unproject(rng.uniform(0.1, 0.9, 2) * [lens.width_px, lens.height_px])
        tilt, angle = np.radians(rng.uniform(10, 45)), rng.uniform(0, 2 * np.pi)
        roll = np.radians(rng.uniform(20, 70))
        turn = exp_so3(tilt * np.array([np.cos(angle), np.sin(angle), 0.0]))
        R = turn @ np.diag([1.0, -1.0, -1.0]) @ exp_so3(np.array([0.0, 0.0, roll]))
        pixels, is_valid = lens.project(transform(pose(R, ray * rng.uniform(1.2, 3.5)), corners))
        if not (is_valid.all() and lens.is_inside(pixels, 3.0).all()):
            continue
        pixels = pixels + sigma_px * rng.standard_normal(pixels.shape)
        solved = solve_planar_pose(pixels, board.corners(), lens)
        if solved is not None:
            start = solved.T_cam_board
            found = ImageBoard(start, solved.cov, None, np.inf, pixels, 0.0, solved.sigma_px)
            views.append(BoardView(f"{len(views):06d}", "frames", found))
    return views


def imperfect_corners(board: Board, rng: np.random.Generator) -> Array:
    """Bow a board by 0.6 mm, print it 0.06 % too wide and every corner 0.07 mm off: (N, 3)."""
    corners = board.corners()
    x = corners[:, 0] - corners[:, 0].mean()
    corners[:, 2] = -0.0006 * (1 - (x / np.abs(x).max()) ** 2)
    corners[:, :2] *= [1.0003, 0.9997]
    corners[:, :2] += 7e-5 * rng.standard_normal((len(corners), 2))
    return corners
