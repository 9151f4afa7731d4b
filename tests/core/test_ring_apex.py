"""In a frame other than the LiDAR's, the apex of the rings is not at the origin."""

import numpy as np
import pytest

from lce_rig.core.geometry import exp_so3, pose, transform
from lce_rig.core.ring_apex import MAX_APEX_M, find_apex
from tests.detect.scans import UNEVEN64_DEG, VLP16_DEG, board_plate, cast, place, room

RNG = np.random.default_rng(0)


def scanned(elevations_deg=VLP16_DEG, sigma_m=0.01):
    return cast([*room(), board_plate(place(2.0))], elevations_deg=elevations_deg, sigma_m=sigma_m)


@pytest.mark.parametrize("elevations_deg", [VLP16_DEG, UNEVEN64_DEG])
@pytest.mark.parametrize("axis_deg", [0.0, 8.0])
def test_find_apex_of_moved_scan_returns_offset(elevations_deg, axis_deg):
    scan = scanned(elevations_deg)
    offset_m = np.array([0.3, -0.1, 0.7])
    T = pose(exp_so3(np.radians([axis_deg, -axis_deg, 30.0])), offset_m)
    apex = find_apex(transform(T, scan.points), scan.ring)
    np.testing.assert_allclose(apex.position_m, offset_m, atol=0.005)
    assert apex.is_beyond(MAX_APEX_M)


def test_find_apex_of_own_frame_is_the_origin():
    scan = scanned()
    apex = find_apex(scan.points, scan.ring)
    assert np.linalg.norm(apex.position_m) < 0.005
    assert not apex.is_beyond(MAX_APEX_M)


def test_find_apex_of_wrong_beam_table_is_the_origin():
    scan = scanned()
    x, y, z = scan.points.T.astype(float)
    lifted = np.arctan2(z, np.hypot(x, y)) + np.radians(0.5) * (2.0 * (scan.ring % 2) - 1)
    points = np.stack([x, y, np.hypot(x, y) * np.tan(lifted)], axis=1)
    assert not find_apex(points, scan.ring).is_beyond(MAX_APEX_M)


def test_find_apex_of_random_rings_is_not_beyond():
    points = RNG.normal(0, 3, (5000, 3)) + [4, 0, 0]
    apex = find_apex(points, RNG.integers(0, 16, 5000).astype(np.int16))
    assert apex is None or not apex.is_beyond(MAX_APEX_M)


def test_find_apex_of_few_points_is_none():
    scan = scanned()
    assert find_apex(scan.points[:50], scan.ring[:50]) is None
