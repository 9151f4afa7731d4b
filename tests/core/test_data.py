"""Samples."""

import numpy as np

from lce_rig.core.data import Scan

NEAR, FAR = [0.03, 0.0, 0.04], [3.0, 4.0, 0.0]


def scan(*points):
    n = len(points)
    ring = np.arange(n, dtype=np.int16)
    return Scan("lidar", 5, np.array(points, np.float32), np.ones(n, np.float32), ring, np.arange(n))


def test_scan_corrected_moves_points_along_rays():
    corrected = scan(FAR, NEAR).corrected(0.1)
    # A return not beyond the offset lies nowhere.
    np.testing.assert_allclose(corrected.points, [[2.94, 3.92, 0.0]], rtol=1e-6)
    assert corrected.ring.tolist() == [0] and corrected.points.dtype == np.float32
    longer = scan(FAR, NEAR).corrected(-0.1)
    np.testing.assert_allclose(np.linalg.norm(longer.points, axis=1), [5.1, 0.15], rtol=1e-6)


def test_scan_corrected_twice_is_corrected_once():
    once = scan(FAR).corrected(0.1)
    assert once.corrected(0.1) is once
    np.testing.assert_allclose(once.corrected(0.0).points, [FAR], rtol=1e-6)
    recorded = scan(FAR)
    assert recorded.corrected(0.0) is recorded


def test_scan_corrected_without_points_is_empty():
    assert len(scan(FAR).select(np.zeros(1, bool)).corrected(0.1).points) == 0
