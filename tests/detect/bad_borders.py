"""Boards with an incomplete border: hidden, smeared, or merged with their stand."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scans import BOARD, Plate, Shape, board_plate, place, room

from lce_rig.core.geometry import Array, invert, pose

SMEAR_M = 0.02
_FLOOR_M = -1.0
_ROOM_M = 13.0


@dataclass(frozen=True, eq=False)
class Ragged:
    """The board with a border displaced for each ring, or for each ray."""

    T_lidar_plate: Array
    by_ring: bool
    seed: int
    sigma_m: float = SMEAR_M

    def ranges(self, rays: Array) -> Array:
        """Return the range of each ray (N, 3), infinite where it misses."""
        T = invert(self.T_lidar_plate)
        direction, start = rays @ T[:3, :3].T, T[:3, 3]
        with np.errstate(divide="ignore", invalid="ignore"):
            t = -start[2] / direction[:, 2]
            hit = start + t[:, None] * direction
        of = np.arange(len(rays))
        if self.by_ring:
            of = np.unique(np.round(rays[:, 2], 6), return_inverse=True)[1]
        grown = self.sigma_m * np.random.default_rng(self.seed).standard_normal((of.max() + 1, 4))[of]
        x, y = hit[:, 0], hit[:, 1]
        over = np.column_stack([x, -x, y, -y]) - np.repeat([BOARD.width_m / 2, BOARD.height_m / 2], 2)
        return np.where((over <= grown).all(axis=1) & (t > 0), t, np.inf)


Scene = Callable[[int, bool], tuple[list[Shape], Array]]


def whole(seed: int, has_rings: bool) -> tuple[list[Shape], Array]:
    """Build the board as it should be shown."""
    T = _hung(np.random.default_rng(seed), has_rings)
    return [board_plate(T), *room(_ROOM_M)], T


def hidden(seed: int, has_rings: bool) -> tuple[list[Shape], Array]:
    """Hide one side, and 3 to 12 cm of the plate there, by an object in front of it."""
    rng = np.random.default_rng(seed)
    T = _hung(rng, has_rings)
    side, hidden_m, nearer = rng.integers(4), rng.uniform(0.03, 0.12), rng.uniform(0.7, 0.92)
    axis, sign = side % 2, 1.0 if side < 2 else -1.0
    size, middle = np.array([BOARD.width_m, BOARD.height_m]), np.zeros(3)
    middle[axis] = sign * (size[axis] / 2 - hidden_m + 0.2)
    size[axis], size[1 - axis] = 0.4, size[1 - axis] + 0.3
    before = pose(T[:3, :3], nearer * (T[:3, 3] + T[:3, :3] @ middle))
    return [board_plate(T), Plate(before, *(nearer * size)), *room(_ROOM_M)], T


def smeared(seed: int, has_rings: bool) -> tuple[list[Shape], Array]:
    """Scatter the border by 20 mm."""
    T = _hung(np.random.default_rng(seed), has_rings)
    return [Ragged(T, has_rings, seed), *room(_ROOM_M)], T


def on_a_bar(seed: int, has_rings: bool) -> tuple[list[Shape], Array]:
    """Stand the plate on a bar of 0.1 to 0.3 m in its plane, down to the floor."""
    rng = np.random.default_rng(seed)
    T = _standing(rng, rng.uniform(-0.2, 0.2))
    width_m, off_m = rng.uniform(0.1, 0.3), rng.uniform(-0.15, 0.15)
    length_m = T[2, 3] - BOARD.height_m / 2 - _FLOOR_M
    below = T[:3, 3] + T[:3, :3] @ [off_m, -(BOARD.height_m + length_m) / 2, 0.0]
    return [board_plate(T), Plate(pose(T[:3, :3], below), width_m, length_m), *room(_ROOM_M)], T


def on_the_floor(seed: int, has_rings: bool) -> tuple[list[Shape], Array]:
    """Stand the plate on the floor."""
    T = _standing(np.random.default_rng(seed), _FLOOR_M + BOARD.height_m / 2)
    return [board_plate(T), *room(_ROOM_M)], T


SCENES: dict[str, Scene] = {
    "whole": whole,
    "one side hidden": hidden,
    "smeared by 20 mm": smeared,
    "on a bar": on_a_bar,
    "on the floor": on_the_floor,
}


def _hung(rng: np.random.Generator, has_rings: bool) -> Array:
    roll_deg = rng.uniform(25, 65) if rng.uniform() < 0.5 else rng.uniform(-10, 10)
    distance_m = rng.uniform(1.6, 2.6 if has_rings else 4.0)
    return place(distance_m, rng.uniform(-12, 12), roll_deg, rng.uniform(-35, 35), rng.uniform(-20, 20))


def _standing(rng: np.random.Generator, z_m: float) -> Array:
    return place(rng.uniform(2.2, 3.2), rng.uniform(-12, 12), 0.0, rng.uniform(-35, 35), z_m=z_m)
