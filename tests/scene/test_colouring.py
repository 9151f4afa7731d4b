"""Points take the colour of their pixel, unless something nearer hides them."""

import numpy as np

from lce_rig.core.camera import Intrinsics
from lce_rig.core.data import Scan
from lce_rig.scene.colouring import colour_points

LENS = Intrinsics(300.0, 300.0, 159.5, 119.5, 320, 240)
LEFT, RIGHT = (10, 20, 200), (200, 30, 0)


def _scan(points, rings=None):
    n = len(points)
    ring = np.zeros(n, np.int16) if rings is None else np.asarray(rings, np.int16)
    return Scan("lidar", None, np.asarray(points, np.float32), np.zeros(n, np.float32), ring, None)


def _picture():
    pixels = np.zeros((240, 320, 3), np.uint8)
    pixels[:, :160], pixels[:, 160:] = LEFT, RIGHT
    return pixels


def test_a_floor_seen_at_a_grazing_angle_does_not_hide_itself():
    z, x = np.meshgrid(np.linspace(4, 8, 200), np.linspace(-0.5, 0.5, 30))
    floor = np.stack([x.ravel(), np.full(x.size, 1.2), z.ravel()], axis=1)
    T = np.eye(4)
    T[1, 3] = -0.3
    _, is_seen = colour_points(_scan(floor - T[:3, 3]), _picture(), T, LENS)
    assert is_seen.mean() > 0.95


def test_grey_images_and_empty_scans():
    colours, _ = colour_points(_scan([[0.0, 0, 2]]), np.full((240, 320), 77, np.uint8), np.eye(4), LENS)
    assert colours.tolist() == [[77, 77, 77]]
    assert colour_points(_scan(np.zeros((0, 3))), _picture(), np.eye(4), LENS)[0].shape == (0, 3)
