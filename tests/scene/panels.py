"""Upright panels before a wall, rendered for a camera and a LiDAR without rings, with exact truth."""

from typing import NamedTuple

import numpy as np

from lce_rig.core.camera import Intrinsics
from lce_rig.core.data import NO_RING, Image, Scan
from lce_rig.core.geometry import Array, invert, perturb, pose

LENS = Intrinsics(450.0, 450.0, 320.0, 180.0, 640, 360)
AXES = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])
TRUTH = perturb(pose(AXES, np.zeros(3)), np.array([0.05, -0.2, 0.1, 0.02, -0.03, 0.01]))
STEP = np.radians(0.25)
NO_RINGS = np.full(100_000, NO_RING, dtype=np.int16)


class Panels(NamedTuple):
    """Upright panels before a wall, across the x axis: corners (y, z) and distance in m, and grey."""

    low: Array
    high: Array
    x: Array
    grey: Array

    def hit(self, origin, rays):
        """Return distance and grey (N,) along rays (N, 3) from a point, frame lidar."""
        distance, grey = np.full(len(rays), np.inf), np.zeros(len(rays))
        for low, high, x, shade in zip(*self, strict=True):
            along = (x - origin[0]) / rays[:, 0]
            at = (origin + along[:, None] * rays)[:, 1:]
            is_hit = (along > 0) & (along < distance) & np.all((at > low) & (at < high), axis=1)
            distance[is_hit], grey[is_hit] = along[is_hit], shade
        return distance, grey


def panels(seed, n=12):
    rng = np.random.default_rng(seed)
    x = np.append(rng.uniform(3, 12, n), 20.0)
    middle, size = rng.uniform(-1, 1, (n, 2)) * [0.55, 0.3] * x[:n, None], rng.uniform(0.3, 1.2, (n, 2))
    low, high = np.vstack([middle - size, [-50, -50]]), np.vstack([middle + size, [50, 50]])
    return Panels(low, high, x, np.append(rng.uniform(40, 220, n), 128.0))


def rendered(seed):
    """Render image and scan of random panels at the true extrinsics, with noise."""
    scene, rng = panels(seed), np.random.default_rng(seed)
    angles = np.stack(np.meshgrid(np.arange(-0.7, 0.7, STEP), np.arange(-0.45, 0.45, STEP)), axis=-1)
    azimuth, elevation = angles.reshape(-1, 2).T
    rays = np.stack([np.cos(azimuth), np.sin(azimuth), np.tan(elevation)], axis=1)
    distance, _ = scene.hit(np.zeros(3), rays)
    points = rays * (distance + rng.normal(0, 0.01, len(rays)))[:, None]
    scan = Scan(
        "lidar", 0, points.astype(np.float32), np.zeros(len(points), np.float32), NO_RINGS[: len(points)]
    )
    pixels = np.stack(np.meshgrid(np.arange(640), np.arange(360)), axis=-1).reshape(-1, 2)
    back = invert(TRUTH)
    _, grey = scene.hit(back[:3, 3], LENS.unproject(pixels) @ back[:3, :3].T)
    grey = np.clip(grey + rng.normal(0, 3, len(grey)), 0, 255).reshape(360, 640).astype(np.uint8)
    return Image("cam", "frames", 0, grey), scan
