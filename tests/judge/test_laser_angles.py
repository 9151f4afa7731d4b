"""Angles of the lasers that are not those of the scans are found, in rings' places on the plate."""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import pytest

from lce_rig.calibrate import EstimateSettings, fit_extrinsic
from lce_rig.core.geometry import Array, fit_plane
from lce_rig.core.results import LidarBoard, Observation
from lce_rig.judge.verdict import angle_findings
from tests.calibrate.boards import BOARD, Scenario, simulate

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


def angles_deg(seed: int, azimuth: Array, elevation: Array) -> Mapping[str, float]:
    boards: list[Observation] = simulate(15, seed, Scenario(laser_bias_sigma_m=0.008, footprint_m=0.006))
    boards = [replace(o, lidar=read_by_other_table(o.lidar, azimuth, elevation)) for o in boards]
    settings = EstimateSettings("ml", laser_bias_sigma_m=0.008, range_offset_sigma_m=0.005)
    return fit_extrinsic(boards, BOARD, settings).laser_angles


@pytest.mark.parametrize(
    ("azimuth", "elevation", "angle"),
    [
        (IN_TURN, 0 * OF_RING, "azimuth"),
        # Hardly told from a LiDAR that is turned about its way forward.
        (2 * OF_RING, 0 * OF_RING, "azimuth"),
        (0 * OF_RING, IN_TURN, "elevation"),
        (0 * OF_RING, HALF_DEG * (2 * np.linspace(-1, 1, 16) ** 2 - 1), "elevation"),
    ],
)
def test_a_beam_table_of_another_model_is_found(azimuth: Array, elevation: Array, angle: str) -> None:
    (finding,) = angle_findings(angles_deg(1, azimuth, elevation))
    assert (finding.code, finding.figures["angle"]) == ("verdict.laser_angles", angle)
    assert 0.15 < finding.figure("rms_deg") < 0.65


def test_right_angles_are_not_doubted() -> None:
    for seed in range(6):
        assert angle_findings(angles_deg(seed, 0 * OF_RING, 0 * OF_RING)) == []
