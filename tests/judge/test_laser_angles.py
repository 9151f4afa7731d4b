"""Angles of the lasers that are not those of the scans are found, in rings' places on the plate."""

from dataclasses import replace

import numpy as np
import pytest

from lce_rig.core.geometry import Array, fit_plane
from lce_rig.core.results import LidarBoard
from tests.calibrate.boards import Scenario, simulate
from tests.judge.test_explanations import causes

HALF_DEG = np.radians(0.5)
OF_RING = HALF_DEG * np.linspace(-1, 1, 16)
IN_TURN = HALF_DEG * np.tile([1.0, -1.0], 8)


def read_by_other_table(lidar: LidarBoard, azimuth: Array, elevation: Array) -> LidarBoard:
    def rays(points: Array, ring: Array) -> Array:
        x, y, z = points.T
        e, a = np.arctan2(z, np.hypot(x, y)) + elevation[ring], np.arctan2(y, x) + azimuth[ring]
        unit = np.stack([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)], axis=1)
        return np.linalg.norm(points, axis=1)[:, None] * unit

    points = rays(lidar.points, lidar.ring)
    plane, _ = fit_plane(points)
    return replace(lidar, points=points, edge_points=rays(lidar.edge_points, lidar.edge_ring), plane=plane)


@pytest.mark.parametrize(
    ("azimuth", "elevation", "cause"),
    [
        (IN_TURN, 0 * OF_RING, "azimuths"),
        # Hardly distinguishable from a rotation of the LiDAR about its forward axis.
        (2 * OF_RING, 0 * OF_RING, "azimuths"),
        (0 * OF_RING, IN_TURN, "elevations"),
        (0 * OF_RING, HALF_DEG * (2 * np.linspace(-1, 1, 16) ** 2 - 1), "elevations"),
    ],
)
def test_explain_other_beam_table_is_named(azimuth: Array, elevation: Array, cause: str) -> None:
    boards = simulate(15, 1, Scenario(laser_bias_sigma_m=0.008, footprint_m=0.006))
    boards = [replace(o, surface=read_by_other_table(o.lidar, azimuth, elevation)) for o in boards]
    assert causes(boards)[0] == cause
