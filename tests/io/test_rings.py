"""Rings from elevation, for the beam tables of different LiDARs."""

import numpy as np
import pytest

from lce_rig.core.errors import SourceError
from lce_rig.io.folder.cloud import rings_from_elevation

VLP16_DEG = np.arange(-15.0, 16.0, 2.0)
HDL32_DEG = -30.67 + np.arange(32) * 4.0 / 3.0
UNEVEN64_DEG = np.concatenate([-24.33 + np.arange(32) * 0.5, -8.33 + np.arange(32) / 3.0])
UNEVEN32_DEG = np.concatenate(
    [[-25.0, -15.639, -11.31, -8.843, -7.254, -6.148, -5.333, -4.667], np.linspace(-4, 5 / 3, 18)]
    + [[7 / 3, 10 / 3, 4.667, 7.0, 10.333, 15.0]]
)


def sweep(elevations_deg, offsets_m=0.0, n=1200, seed=0, low_m=0.8, high_m=12.0):
    """Make a cloud of n returns a laser at smoothly varying distances, with the lasers' numbers."""
    rng = np.random.default_rng(seed)
    azimuth = np.tile(np.linspace(0, 2 * np.pi, n, endpoint=False), (len(elevations_deg), 1)).T
    phase = rng.uniform(0, 6, size=len(elevations_deg))
    range_m = low_m + (high_m - low_m) * (0.5 + 0.5 * np.sin(3 * azimuth + phase)) ** 2
    elevation = np.radians(elevations_deg)
    flat = range_m * np.cos(elevation)
    z = range_m * np.sin(elevation) + offsets_m
    points = np.stack([flat * np.cos(azimuth), flat * np.sin(azimuth), z], axis=-1).reshape(-1, 3)
    return points.astype(np.float32), np.tile(np.arange(len(elevations_deg)), n)


@pytest.mark.parametrize(
    "elevations_deg", [VLP16_DEG, HDL32_DEG, UNEVEN32_DEG, UNEVEN64_DEG, VLP16_DEG - 7.3]
)
def test_every_point_gets_the_number_of_its_laser(elevations_deg):
    points, laser = sweep(elevations_deg)
    np.testing.assert_array_equal(rings_from_elevation(points), laser)


def test_a_laser_that_sees_little_keeps_its_own_ring():
    points, laser = sweep(VLP16_DEG)
    keep = (laser < 13) | (np.arange(len(laser)) % 97 == 0)
    ring = rings_from_elevation(points[keep])
    assert all(len(np.unique(ring[laser[keep] == k])) == 1 for k in range(16))


@pytest.mark.parametrize("n", [1, 2])
def test_a_cloud_of_hardly_any_points_has_no_rings_to_tell(n):
    with pytest.raises(SourceError):
        rings_from_elevation(np.array([[3.0, 1.0, 0.2], [5.0, 2.0, 1.9]])[:n])
