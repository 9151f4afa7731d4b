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


def test_points_that_only_the_lidar_sees_get_no_colour():
    """A board at 1 m hides a part of the wall at 4 m from a camera beside the LiDAR, and not the rest."""
    T_cam_lidar = np.eye(4)
    T_cam_lidar[0, 3] = 0.3
    v = np.linspace(-0.2, 0.2, 81)
    rays = np.stack(np.meshgrid(np.linspace(-0.3, 0.3, 241), v), axis=-1).reshape(-1, 2)
    is_board = (np.abs(rays) < 0.1).all(axis=1)
    points = np.column_stack([rays, np.ones(len(rays))]) * np.where(is_board, 1.0, 4.0)[:, None]
    # As the LiDAR's rays see them: its origin lies beside the camera, and it looks past the board's edge.
    points_lidar = (points @ T_cam_lidar[:3, :3]).astype(np.float32)
    points_camera = points_lidar @ T_cam_lidar[:3, :3].T + T_cam_lidar[:3, 3]
    u = points_camera[:, 0] / points_camera[:, 2]
    w = points_camera[:, 1] / points_camera[:, 2]
    # In the camera the board covers [0.2, 0.4] of x / z; the wall's points there are hidden.
    is_behind = ~is_board & (np.abs(u - 0.3) < 0.09) & (np.abs(w) < 0.09)
    is_free = ~is_board & ((np.abs(u - 0.3) > 0.13) | (np.abs(w) > 0.13))
    assert is_behind.sum() > 100 and is_free.sum() > 1000
    rings = np.repeat(np.arange(81), 241).astype(np.int16)
    _, seen = colour_points(_scan(points_lidar, rings), _picture(), T_cam_lidar, LENS)
    assert not seen[is_behind].any() and seen[is_board].all() and seen[is_free].all()
