"""Synthetic scans with exact truth: beams of a spinning LiDAR cast at a few simple shapes."""

from dataclasses import dataclass

import numpy as np

from lce_rig.core.board import Board
from lce_rig.core.data import NO_RING, Scan
from lce_rig.core.geometry import Array, exp_so3, invert, pose

VLP16_DEG = np.arange(-15.0, 16.0, 2.0)
HDL32_DEG = -30.67 + np.arange(32) * 4.0 / 3.0
UNEVEN64_DEG = np.concatenate([-24.33 + np.arange(32) * 0.5, -8.33 + np.arange(32) * 1.0 / 3.0])
STEP_DEG = 0.199
BOARD = Board(cols=8, rows=6, square_m=0.07, width_m=0.767, height_m=0.626)


@dataclass(frozen=True, eq=False)
class Plate:
    """A rectangle in the plane z = 0 of its own frame."""

    T_lidar_plate: Array
    width_m: float
    height_m: float

    def ranges(self, rays):
        """Return the range of each ray (N, 3), infinite where it misses."""
        T = invert(self.T_lidar_plate)
        direction, start = rays @ T[:3, :3].T, T[:3, 3]
        with np.errstate(divide="ignore", invalid="ignore"):
            t = -start[2] / direction[:, 2]
            hit = start + t[:, None] * direction
        inside = (np.abs(hit[:, 0]) <= self.width_m / 2) & (np.abs(hit[:, 1]) <= self.height_m / 2) & (t > 0)
        return np.where(inside, t, np.inf)


@dataclass(frozen=True, eq=False)
class Box:
    """A box; a room when seen from inside."""

    T_lidar_box: Array
    size_m: tuple[float, float, float]

    def ranges(self, rays):
        """Return the range of each ray (N, 3), infinite where it misses."""
        T = invert(self.T_lidar_box)
        direction, start = rays @ T[:3, :3].T, T[:3, 3]
        with np.errstate(divide="ignore", invalid="ignore"):
            one, two = (
                (-np.array(self.size_m) / 2 - start) / direction,
                (np.array(self.size_m) / 2 - start) / direction,
            )
        near, far = np.minimum(one, two).max(axis=1), np.maximum(one, two).min(axis=1)
        return np.where((near > far) | (far < 0), np.inf, np.where(near > 0, near, far))


@dataclass(frozen=True, eq=False)
class Pillar:
    """An upright cylinder without ends."""

    x_m: float
    y_m: float
    radius_m: float
    low_m: float = -1.2
    high_m: float = 2.0

    def ranges(self, rays):
        """Return the range of each ray (N, 3), infinite where it misses."""
        a = rays[:, 0] ** 2 + rays[:, 1] ** 2
        b = rays[:, 0] * self.x_m + rays[:, 1] * self.y_m
        root = b * b - a * (self.x_m**2 + self.y_m**2 - self.radius_m**2)
        t = (b - np.sqrt(np.maximum(root, 0.0))) / np.maximum(a, 1e-12)
        z = t * rays[:, 2]
        return np.where((root > 0) & (t > 0) & (z > self.low_m) & (z < self.high_m), t, np.inf)


Shape = Plate | Box | Pillar


def place(distance_m, azimuth_deg=0.0, roll_deg=45.0, yaw_deg=0.0, pitch_deg=0.0, z_m=0.0):
    """Build T_lidar_board of a board that faces the LiDAR, then turned in its plane and tilted."""
    facing = np.array([[0.0, 0.0, -1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]) @ np.diag([-1.0, 1.0, 1.0])
    facing[:, 0] = np.cross(facing[:, 1], facing[:, 2])
    tilt = exp_so3(np.array([0.0, np.radians(yaw_deg), 0.0])) @ exp_so3(
        np.array([np.radians(pitch_deg), 0.0, 0.0])
    )
    local = facing @ tilt @ exp_so3(np.array([0.0, 0.0, np.radians(roll_deg)]))
    about = exp_so3(np.array([0.0, 0.0, np.radians(azimuth_deg)]))
    return pose(about @ local, about @ np.array([distance_m, 0.0, z_m]))


def board_plate(T_lidar_board, board=BOARD, scale=1.0):
    """Make the plate of a board."""
    return Plate(T_lidar_board, board.width_m * scale, board.height_m * scale)


def room(size_m=9.0):
    """Build walls, floor and ceiling, a poster, a pillar, a table and a door leaf."""
    return [
        Box(pose(np.eye(3), np.array([0.4, -0.3, 0.6])), (size_m, size_m + 1, 3.2)),
        Plate(place(size_m / 2 - 0.2, 100.0, 0.0), 0.6, 0.85),
        Pillar(-2.0, 2.4, 0.22),
        Box(pose(np.eye(3), np.array([-2.4, -1.6, -0.35])), (1.2, 0.7, 0.05)),
        Box(pose(exp_so3(np.array([0.0, 0.0, 0.6])), np.array([1.5, -3.0, -0.1])), (0.04, 0.9, 2.1)),
    ]


def person(T_lidar_board, behind_m):
    """Build torso, head and two arms of somebody who holds the board from behind, standing upright."""
    towards = T_lidar_board[:2, 3] / np.linalg.norm(T_lidar_board[:2, 3])
    azimuth = np.arctan2(towards[1], towards[0])
    upright = exp_so3(np.array([0.0, 0.0, azimuth]))
    middle = T_lidar_board[:3, 3] + upright @ [behind_m + 0.12, 0.0, -0.1]
    arms = [T_lidar_board[:3, 3] + upright @ [behind_m / 2 + 0.05, side * 0.42, 0.0] for side in (-1, 1)]
    torso = [Box(pose(upright, middle), (0.24, 0.46, 0.9))]
    return torso + [Box(pose(upright, arm), (behind_m + 0.06, 0.09, 0.09)) for arm in arms]


def cast(
    shapes,
    *,
    sigma_m=0.0,
    seed=0,
    elevations_deg=VLP16_DEG,
    step_deg=STEP_DEG,
    start_deg=0.0,
    mixed_share=0.0,
    max_range_m=100.0,
    stagger=0.0,
):
    """Cast one revolution, in order of firing, clockwise as a VLP-16 turns.

    Args:
        shapes: surfaces; beams that hit none return nothing.
        sigma_m: noise of a range.
        seed: of noise and of the phase of the rotor.
        elevations_deg: of the lasers, from the lowest up.
        step_deg: of the rotor from firing to firing.
        start_deg: azimuth of the first firing.
        mixed_share: share of the beams over an edge that return from between the two surfaces.
        max_range_m: beams that go farther return nothing.
        stagger: steps of the rotor from one laser's firing to the next one's, as lasers fire in turn.
    """
    rng = np.random.default_rng(seed)
    azimuth = np.radians(start_deg - step_deg * (np.arange(int(360 / step_deg)) + rng.uniform()))
    azimuth, ring = (
        np.repeat(azimuth, len(elevations_deg)),
        np.tile(np.arange(len(elevations_deg)), len(azimuth)),
    )
    elevation = np.radians(elevations_deg)[ring]
    azimuth = azimuth - np.radians(step_deg) * np.mod(stagger * ring, 1.0)

    def trace(shift_rad):
        at = azimuth + shift_rad
        rays = np.stack(
            [np.cos(elevation) * np.cos(at), np.cos(elevation) * np.sin(at), np.sin(elevation)], axis=1
        )
        return rays, np.min([shape.ranges(rays) for shape in shapes], axis=0)

    rays, range_m = trace(0.0)
    if mixed_share:
        _, left = trace(0.0015)
        _, right = trace(-0.0015)
        other = np.where(np.abs(left - range_m) > np.abs(right - range_m), left, right)
        over_edge = np.isfinite(range_m) & np.isfinite(other) & (np.abs(other - range_m) > 0.1)
        is_mixed = over_edge & (rng.uniform(size=len(range_m)) < mixed_share)
        weight = rng.uniform(0.2, 0.8, size=len(range_m))
        range_m = np.where(
            is_mixed, weight * range_m + (1 - weight) * np.where(is_mixed, other, 0.0), range_m
        )
    keep = np.isfinite(range_m) & (range_m < max_range_m)
    noisy = range_m[keep] + sigma_m * rng.standard_normal(int(keep.sum()))
    points = (rays[keep] * noisy[:, None]).astype(np.float32)
    intensity = np.full(len(points), 50.0, dtype=np.float32)
    offset_ns = (np.repeat(np.arange(len(azimuth) // len(elevations_deg)), len(elevations_deg)) * 55296)[keep]
    return Scan("lidar", 0, points, intensity, ring[keep].astype(np.int16), offset_ns.astype(np.int64))


def accumulate(
    shapes: list[Shape], sigma_m: float = 0.01, seed: int = 0, n: int = 120_000, fov_deg: float = 70.0
) -> Scan:
    """Cast rays in random directions of a cone ahead, as a rosette does in a while."""
    rng = np.random.default_rng(seed)
    across, turn = np.radians(fov_deg / 2) * np.sqrt(rng.uniform(size=n)), rng.uniform(0, 2 * np.pi, n)
    rays = np.column_stack([np.cos(across), np.sin(across) * np.cos(turn), np.sin(across) * np.sin(turn)])
    range_m = np.min([shape.ranges(rays) for shape in shapes], axis=0)
    keep = np.isfinite(range_m)
    points = rays[keep] * (range_m[keep] + sigma_m * rng.standard_normal(int(keep.sum())))[:, None]
    points = points.astype(np.float32)
    rings = np.full(len(points), NO_RING, dtype=np.int16)
    return Scan("lidar", None, points, np.zeros(len(points), dtype=np.float32), rings)


def outline_distance(points, T_lidar_board, board=BOARD):
    """Measure how far points lie from the board's border, along their rays in its plane; negative inside."""
    T = invert(T_lidar_board)
    normal, centre = T_lidar_board[:3, 2], T_lidar_board[:3, 3]
    pierced = points * ((normal @ centre) / (points @ normal))[:, None]
    local = np.abs(pierced @ T[:3, :3].T + T[:3, 3])[:, :2]
    return np.asarray((local - [board.width_m / 2, board.height_m / 2]).max(axis=1))
