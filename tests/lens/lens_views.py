"""Corners of boards projected by a known lens, with a board slightly different from its specification."""

from dataclasses import dataclass, replace

import numpy as np

from lce_rig.core.board import Board
from lce_rig.core.camera import Intrinsics
from lce_rig.core.geometry import exp_so3, perturb, pose, transform
from lce_rig.core.results import ImageBoard
from lce_rig.lens.lens_estimate import BoardView

BOARD = Board(cols=6, rows=4, square_m=0.1, width_m=0.8, height_m=0.6)
WIDE = Intrinsics(450.0, 452.0, 322.0, 236.0, 640, 480, "radtan", (-0.35, 0.16, 0.0007, -0.0004, -0.03))
FISHEYE = Intrinsics(250.0, 251.0, 322.0, 236.0, 640, 480, "equidistant", (-0.05, 0.02, -0.01, 0.002))


@dataclass(frozen=True)
class Scene:
    """Poses of the boards and errors of their corners."""

    lens: Intrinsics = WIDE
    sigma_px: float = 0.05
    tilt_deg: tuple[float, float] = (10.0, 45.0)
    distance_m: tuple[float, float] = (1.0, 3.0)
    spread: tuple[float, float] = (0.1, 0.9)
    bow_m: tuple[float, float] = (0.0, 0.0)
    aspect: float = 0.0
    print_sigma_m: float = 0.0
    flutter_m: float = 0.0


def photograph(n, seed, scene=None, board=BOARD):
    """Hold a board n times before a lens; starting poses are some centimetres and degrees off."""
    scene = scene or Scene()
    rng = np.random.default_rng(seed)
    printed = bent(board, scene, rng)
    x, y = board.corners()[:, :2].T
    size = np.array([scene.lens.width_px, scene.lens.height_px])
    views = []
    while len(views) < n:
        ray = scene.lens.unproject(rng.uniform(*scene.spread, 2) * size)
        tilt, angle = np.radians(rng.uniform(*scene.tilt_deg)), rng.uniform(0, 2 * np.pi)
        roll = np.radians(rng.uniform(15, 75))
        turn = exp_so3(tilt * np.array([np.cos(angle), np.sin(angle), 0.0]))
        R = turn @ np.diag([1.0, -1.0, -1.0]) @ exp_so3(np.array([0, 0, roll]))
        T = pose(R, ray * rng.uniform(*scene.distance_m))
        # A limp plate: bowed differently at each placement.
        flutter = scene.flutter_m * rng.standard_normal(2)
        middle = flutter[0] * (1 - (x / x.max()) ** 2) + flutter[1] * (1 - (y / y.max()) ** 2)
        pixels, is_valid = scene.lens.project(transform(T, printed + middle[:, None] * [0, 0, 1]))
        if not (is_valid.all() and scene.lens.is_inside(pixels, 3.0).all()):
            continue
        pixels = pixels + scene.sigma_px * rng.standard_normal(pixels.shape)
        start = perturb(T, np.r_[0.03 * rng.standard_normal(3), 0.05 * rng.standard_normal(3)])
        found = ImageBoard(start, np.eye(6), None, np.inf, pixels, 0.0, 0.0)
        views.append(BoardView(f"{len(views):06d}", "frames", found))
    return views


def bent(board, scene, rng):
    """Place the corners of a board that is bowed, stretched and printed badly."""
    corners = board.corners()
    x, y = corners[:, :2].T
    for side, bow_m in zip((x, y), scene.bow_m, strict=True):
        corners[:, 2] += bow_m * (1 - (side / np.abs(side).max()) ** 2)
    corners[:, :2] *= [1 + scene.aspect / 2, 1 - scene.aspect / 2]
    corners[:, :2] += scene.print_sigma_m * rng.standard_normal((len(corners), 2))
    return corners


def with_corners(view, corners_px):
    """Exchange a view's corners."""
    return replace(view, board=replace(view.board, corners_px=corners_px))
