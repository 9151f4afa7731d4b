"""Poses of boards of each kind in images, whole and with 30 % of the print covered."""

from collections.abc import Iterator
from dataclasses import dataclass, field, replace

import cv2
import numpy as np
from detect.drawn_boards import WIDE, draw, looking, picture
from numpy.typing import NDArray

from benchmarks.tables import print_head, print_row, rms
from lce_rig.core.board import Board
from lce_rig.core.geometry import Array, difference, perturb, transform
from lce_rig.core.results import ImageBoard
from lce_rig.detect.image.search import find_image_board

# Forty-eight corners each, on one plate.
_CHECKERBOARD = Board(8, 6, 0.07, 0.767, 0.626)
_BOARDS = {
    "checkerboard": _CHECKERBOARD,
    "charuco": replace(_CHECKERBOARD, type="charuco", marker_share=0.75, dictionary="5X5_50"),
    "aprilgrid": replace(
        _CHECKERBOARD, square_m=0.13, type="aprilgrid", gap_share=0.3, dictionary="APRILTAG_36h11"
    ),
}
_COVERED = 0.3
# Of grey values: errors of corners are then noise, not those of drawing and model, which are 0.01 px.
_NOISE = 8.0
_STEP = 1e-6


@dataclass
class _Errors:
    """Errors of the poses of one board that was found, with their bounds.

    Attributes:
        poses: tangents (6,) of the errors.
        bounds: (6, 6) covariances by the corners used, and by all that are not covered, for noise of 1 px.
        corners_px: errors of the corners used.
        n_used: of each pose.
    """

    poses: list[Array] = field(default_factory=list)
    bounds: tuple[list[Array], list[Array]] = field(default_factory=lambda: ([], []))
    corners_px: list[Array] = field(default_factory=list)
    n_used: list[int] = field(default_factory=list)


def bench_boards(n_poses: int) -> None:
    """Print errors of each board at the same poses, as multiples of the whole checkerboard's.

    Args:
        n_poses: drawn at random, each with the print covered at one of its corners.
    """
    print_head(
        "board",
        "found",
        "corners used",
        "corners, rms px",
        "errors, rms deg / mm",
        "of the checkerboard's",
        "bound of the corners used",
        "bound of those not covered",
    )
    usual: tuple[float, float] | None = None
    for name, board in _BOARDS.items():
        for is_covered in (False, True) if board.has_markers else (False,):
            errors = _measure(board, n_poses, is_covered=is_covered)
            size = _sizes(np.mean([np.outer(e, e) for e in errors.poses], axis=0))
            sigma_px = rms(np.concatenate(errors.corners_px).ravel())
            if usual is None:
                # The checkerboard's noise gives the bounds of all boards.
                usual, noise_px = size, sigma_px
            bounds = [_sizes(noise_px**2 * np.mean(bound, axis=0)) for bound in errors.bounds]
            print_row(
                f"{name}, {_COVERED:.0%} covered" if is_covered else name,
                f"{len(errors.poses)} of {n_poses}",
                f"{np.mean(errors.n_used):.0f}",
                f"{sigma_px:.3f}",
                f"{size[0]:.4f} / {size[1]:.2f}",
                *(f"{deg / usual[0]:.2f}, {mm / usual[1]:.2f}" for deg, mm in (size, *bounds)),
            )


def _measure(board: Board, n_poses: int, *, is_covered: bool) -> _Errors:
    errors, corners = _Errors(), board.corners()
    for seed, T, side in _poses(n_poses):
        pixels, is_open = draw(board, WIDE, T, noise=_NOISE, seed=seed), np.ones(len(corners), dtype=np.bool_)
        if is_covered:
            pixels, is_open = _cover(pixels, board, T, side)
        found = find_image_board(picture(pixels), board, WIDE)
        if isinstance(found, ImageBoard):
            is_used = np.isfinite(found.corners_px).all(axis=1)
            truth_px, _ = WIDE.project(transform(T, corners))
            errors.poses.append(difference(found.T_cam_board, T))
            errors.corners_px.append((found.corners_px - truth_px)[is_used])
            errors.n_used.append(int(is_used.sum()))
            for bound, chosen in zip(errors.bounds, (is_used, is_open), strict=True):
                bound.append(_bound(corners[chosen], T))
    return errors


def _poses(n: int) -> Iterator[tuple[int, Array, Array]]:
    """Draw poses that show the whole plate, top up, and the corner of the print that is covered."""
    rng, k = np.random.default_rng(0), 0
    while k < n:
        tilt, about, roll = rng.uniform([10, 0, -60], [45, 360, 60])
        distance = rng.uniform(1.2, 3.5)
        T = looking(tilt, about, roll, distance * np.array([*rng.uniform(-0.25, 0.25, 2), 1.0]))
        outline, _ = WIDE.project(transform(T, _CHECKERBOARD.outline()))
        if np.all((outline > 5) & (outline < [WIDE.width_px - 5, WIDE.height_px - 5])):
            yield k, T, rng.choice([-1, 1], 2)
            k += 1


def _cover(
    pixels: NDArray[np.uint8], board: Board, T: Array, side: Array
) -> tuple[NDArray[np.uint8], NDArray[np.bool_]]:
    """Lay grey paper on a corner of the print; also, which corners (N,) remain."""
    size = np.array(board.pattern_size_m)
    low = side * size / 2 - np.where(side > 0, np.sqrt(_COVERED) * size, 0)
    paper = low + np.array([[0, 0], [1, 0], [1, 1], [0, 1]]) * np.sqrt(_COVERED) * size
    outline, _ = WIDE.project(transform(T, np.column_stack([paper, np.zeros(4)])))
    covered = cv2.fillConvexPoly(pixels, np.rint(outline).astype(np.int32), 90)
    at = board.corners()[:, :2]
    is_hidden = np.all((at > paper.min(axis=0)) & (at < paper.max(axis=0)), axis=1)
    return np.asarray(covered, dtype=np.uint8), ~is_hidden


def _bound(corners: Array, T: Array) -> Array:
    """Compute the Cramer-Rao bound (6, 6) of a pose by corners (N, 3) with noise of 1 px each way."""
    steps = np.array([WIDE.project(transform(perturb(T, step), corners))[0].ravel()
                      for step in (*(_STEP * np.eye(6)), *(-_STEP * np.eye(6)))])  # fmt: skip
    J = (steps[:6] - steps[6:]).T / (2 * _STEP)
    return np.asarray(np.linalg.inv(J.T @ J))


def _sizes(cov: Array) -> tuple[float, float]:
    """Return the rms size of rotation, deg, and translation, mm, of a covariance (6, 6)."""
    return float(np.degrees(np.sqrt(np.trace(cov[3:, 3:])))), float(1e3 * np.sqrt(np.trace(cov[:3, :3])))
