"""Corruptions of detected boards, for cases that would otherwise need new simulated samples.

Each takes the profile, the sound detections and the session's T_cam_lidar (4, 4).
"""

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from benchmarks.profile_errors import bend, bow
from lce_rig.core.geometry import Array, fit_plane, invert, transform
from lce_rig.core.pattern import is_dark
from lce_rig.core.planar_pose import solve_planar_pose
from lce_rig.core.results import ImageBoard, LidarBoard
from lce_rig.detect.detection import Detections
from lce_rig.rig import Rig

Spoil = Callable[[Rig, Detections, Array], Detections]
# Corners (M, 2) px of one image from its board, its capture's name, and the capture's place from 0 to 1.
_Draw = Callable[[ImageBoard, str, float], Array]
_SEED = 13


def with_bow(rig: Rig, found: Detections, height_m: float) -> Detections:
    """Bend the plate along its width, in scans and images; its middle rises by a height over its ends."""
    board = rig.board.to_board()
    shift = bow(board.corners(), 0, height_m, board)

    def draw(image: ImageBoard, name: str, place: float) -> Array:
        return image.corners_px + _displacement(rig, image, shift)

    bent = {
        lidar: {
            name: [bend(each, 0, height_m, board) for each in boards] if isinstance(boards, list) else boards
            for name, boards in by_name.items()
        }
        for lidar, by_name in found.lidars.items()
    }
    return replace(_redrawn(rig, found, draw), lidars=bent)


def with_contrast(rig: Rig, found: Detections, T_cam_lidar: Array, excess_m: float) -> Detections:
    """Lengthen the ranges of returns from dark parts of the print, which only images show."""
    (images,), board = found.images.values(), rig.board.to_board()

    def lengthened(lidar: LidarBoard, image: ImageBoard) -> LidarBoard:
        points = np.asarray(lidar.points, dtype=np.float64)
        xy = transform(invert(image.T_cam_board) @ T_cam_lidar, points)[:, :2]
        rays = points / np.linalg.norm(points, axis=1, keepdims=True)
        points = points + excess_m * is_dark(board, xy)[:, None] * rays
        plane, sigma_m = fit_plane(points)
        return replace(lidar, points=points.astype(lidar.points.dtype), plane=plane, sigma_m=sigma_m)

    lidars = {}
    for lidar, by_name in found.lidars.items():
        boards_of = dict(by_name)
        for name, boards in by_name.items():
            image = images.get(name)
            if isinstance(boards, list) and isinstance(image, ImageBoard):
                boards_of[name] = [lengthened(each, image) for each in boards]
        lidars[lidar] = boards_of
    return replace(found, lidars=lidars)


def with_focus_drift(rig: Rig, found: Detections, growth: float) -> Detections:
    """Let the focal length grow by a fraction from the first capture to the last."""
    lens = next(iter(rig.cameras.values())).to_intrinsics()
    centre_px = np.array([lens.cx_px, lens.cy_px])

    def draw(image: ImageBoard, name: str, place: float) -> Array:
        return np.asarray(centre_px + (1 + growth * place) * (image.corners_px - centre_px))

    return _redrawn(rig, found, draw)


def with_second_board(rig: Rig, found: Detections, factor: float) -> Detections:
    """Show a board with squares of another size in the second half of the captures, on the same plate."""
    board = rig.board.to_board()
    corners = board.corners()
    middle = np.array([*board.pattern_offset_m, 0.0])

    def draw(image: ImageBoard, name: str, place: float) -> Array:
        shift = (factor - 1) * (corners - middle) * (place > 0.5)
        return image.corners_px + _displacement(rig, image, shift)

    return _redrawn(rig, found, draw)


def with_rolling_shutter(rig: Rig, found: Detections, readout_s: float, speed_mps: float) -> Detections:
    """Move the board at a speed in a random direction of each capture while rows are exposed in turn.

    The pose in the middle of the image's exposure is the sound one.
    """
    n_rows = next(iter(rig.cameras.values())).resolution_px[1]
    names = sorted({name for by_name in found.images.values() for name in by_name})
    directions = np.random.default_rng(_SEED).standard_normal((len(names), 3))
    velocity = dict(
        zip(names, speed_mps * directions / np.linalg.norm(directions, axis=1, keepdims=True), strict=True)
    )

    def draw(image: ImageBoard, name: str, place: float) -> Array:
        late_s = readout_s * (image.corners_px[:, 1] / n_rows - 0.5)
        # In axes of the board, as every corner is displaced there.
        shift = late_s[:, None] * (image.T_cam_board[:3, :3].T @ velocity[name])
        return image.corners_px + _displacement(rig, image, shift)

    return _redrawn(rig, found, draw)


def _displacement(rig: Rig, image: ImageBoard, shift: Array) -> Array:
    """Compute the displacement (M, 2) px of corners that are displaced by (M, 3) m, frame board."""
    lens, corners = next(iter(rig.cameras.values())).to_intrinsics(), rig.board.to_board().corners()
    before, _ = lens.project(transform(image.T_cam_board, corners))
    after, _ = lens.project(transform(image.T_cam_board, corners + shift))
    return np.asarray(after - before)


def _redrawn(rig: Rig, found: Detections, draw: _Draw) -> Detections:
    """Replace the corners of every image, and solve for the board's pose again."""
    lens, corners = next(iter(rig.cameras.values())).to_intrinsics(), rig.board.to_board().corners()
    images = {}
    for key, by_name in found.images.items():
        names, boards = sorted(by_name), dict(by_name)
        for number, name in enumerate(names):
            image = by_name[name]
            if not isinstance(image, ImageBoard):
                continue
            pixels = draw(image, name, number / max(len(names) - 1, 1))
            solved = solve_planar_pose(pixels, corners, lens)
            if solved is not None:
                boards[name] = replace(image, corners_px=pixels, **solved._asdict())
        images[key] = boards
    return replace(found, images=images)
