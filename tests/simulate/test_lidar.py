"""The simulated LiDAR keeps the VLP-16's laws and errs as it claims to."""

from dataclasses import replace

import numpy as np
import pytest

from lce_rig.core.geometry import invert, transform
from lce_rig.simulate.options import LidarNoise
from lce_rig.simulate.room import build_carrier
from lce_rig.simulate.scene import PLATE, Raycaster, Scene, Surface
from lce_rig.simulate.surfaces import merge, rectangle
from tests.exact_lidar import EXACT

from .conftest import VLP16, board_before_lidar, simulate_scan

BEAM = replace(EXACT, divergence_rad=LidarNoise().divergence_rad, exit_size_m=LidarNoise().exit_size_m)
FOOTPRINT_REACH_M = 0.010  # half the beam's exit plus half its divergence at 3 m, rounded up


def scan_of(scene, T_world_lidar, noise, seed=0, **changes):
    return simulate_scan(scene, T_world_lidar, VLP16, noise, np.random.default_rng(seed), **changes)


@pytest.fixture(scope="module")
def scene(room, board):
    T = board_before_lidar(2.2, yaw_deg=20.0)
    return Scene(room.raycaster, build_carrier("person", board, T, np.random.default_rng(3)), board, T)


@pytest.fixture(scope="module")
def exact(scene, T_world_lidar):
    return scan_of(scene, T_world_lidar, EXACT)


def distance_to_surfaces(scene, points_world):
    """Distance of each point from the nearest triangle, or from that triangle's plane if less."""
    import open3d as o3d

    plate = rectangle(scene.board.width_m, scene.board.height_m).moved(scene.T_world_board)
    whole = merge([*(surface.mesh for surface in scene.surfaces), plate])
    engine = o3d.t.geometry.RaycastingScene()
    engine.add_triangles(o3d.core.Tensor(whole.vertices.astype(np.float32)), o3d.core.Tensor(whole.triangles))
    nearest = engine.compute_closest_points(o3d.core.Tensor(points_world.astype(np.float32)))
    distance = np.linalg.norm(nearest["points"].numpy() - points_world, axis=1)
    assert distance.max() < 0.01
    # Open3D's own distance is off by millimetres on long thin triangles: measure from the plane in float64.
    a, b, c = np.moveaxis(whole.vertices[whole.triangles[nearest["primitive_ids"].numpy()]], 1, 0)
    normal = np.cross(b - a, c - a)
    off_plane = np.abs(np.einsum("nc,nc->n", normal, points_world - a)) / np.linalg.norm(normal, axis=1)
    return np.minimum(distance, off_plane)


def lasers(scan):
    return np.argsort(VLP16.rings)[scan.ring]


def azimuths(scan):
    return np.arctan2(scan.points[:, 1], scan.points[:, 0], dtype=np.float64)


def in_board(scene, T_world_lidar, scan):
    return transform(invert(scene.T_world_board) @ T_world_lidar, scan.points.astype(float))


def test_points_without_noise_lie_on_surfaces(scene, exact, T_world_lidar):
    points = transform(T_world_lidar, exact.points.astype(float))
    assert len(points) > 25_000
    # One point in ten thousand may fall to Open3D's distances, not to ours.
    assert np.mean(distance_to_surfaces(scene, points) < 1e-3) > 0.9999


def test_firings_follow_the_manuals_timing_table(exact):
    assert exact.offset_ns is not None
    sequence_start = exact.offset_ns - 2_304 * lasers(exact)
    assert np.all(sequence_start % 55_296 == 0)
    assert np.all(np.diff(exact.offset_ns) > 0)
    assert exact.offset_ns.min() >= 0 and exact.offset_ns.max() < 100_000_000


def test_rings_match_the_beam_table(exact):
    expected = np.radians(np.arange(-15, 16, 2))
    for ring in range(16):
        points = exact.points[exact.ring == ring].astype(float)
        height = points[:, 2] - VLP16.vertical_offsets_m[np.argsort(VLP16.rings)[ring]]
        elevation = np.arctan2(height, np.hypot(points[:, 0], points[:, 1]))
        assert np.abs(elevation - expected[ring]).max() < 1e-5


def test_quantised_scans_step_as_the_sensor(scene, T_world_lidar):
    scan = scan_of(scene, T_world_lidar, replace(EXACT, is_quantised=True))
    points = scan.points.astype(float)
    points[:, 2] -= VLP16.vertical_offsets_m[lasers(scan)]
    steps = np.linalg.norm(points, axis=1) / 0.002
    assert np.abs(steps - np.rint(steps)).max() < 5e-3
    steps = np.degrees(azimuths(scan)) / 0.01
    assert np.abs(steps - np.rint(steps)).max() < 5e-3


def test_mixed_pixels_occur_and_only_at_the_boards_border(board, T_world_lidar):
    T = board_before_lidar(3.0)
    behind = rectangle(6.0, 6.0).moved(board_before_lidar(3.3, roll_deg=0.0))
    scene = Scene(Raycaster([Surface("wall", behind, PLATE, np.eye(4))]), [], board, T)
    scan = scan_of(scene, T_world_lidar, BEAM)
    depth = -in_board(scene, T_world_lidar, scan)
    is_mixed = (depth[:, 2] > 0.01) & (depth[:, 2] < 0.29)
    assert is_mixed.sum() >= 10
    # Where the beam's axis crosses the board's plane, measured from the border.
    points = scan.points[is_mixed].astype(float)
    points[:, 2] -= VLP16.vertical_offsets_m[lasers(scan)][is_mixed]
    origin = T_world_lidar[:3, 3] + np.outer(VLP16.vertical_offsets_m[lasers(scan)][is_mixed], [0, 0, 1])
    ray = points / np.linalg.norm(points, axis=1, keepdims=True)
    at = origin + ray * (3.0 / ray[:, :1])
    xy = np.abs(transform(invert(T), at)[:, :2]) - [board.width_m / 2, board.height_m / 2]
    to_border = np.abs(np.max(xy, axis=1))
    assert to_border.max() < FOOTPRINT_REACH_M


@pytest.mark.parametrize(
    "noise, growth_mm", [(EXACT, 0.0), (BEAM, 7.5), (replace(BEAM, edge_growth_m=0.005), 11.5)]
)
def test_returns_reach_over_by_the_footprint(board, T_world_lidar, noise, growth_mm):
    # Footprint at 3 m: half of 10 mm + 3 m * 3 mrad = 9.5 mm; the outermost 4 % of its energy are too weak.
    scene = Scene(Raycaster(()), [], board, board_before_lidar(3.0, roll_deg=0.0))
    step_m = 3.0 * VLP16.step_rad
    growth = []
    for seed in range(12):
        scan = scan_of(scene, T_world_lidar, noise, seed)
        across = in_board(scene, T_world_lidar, scan)[:, 0]
        for ring in np.unique(scan.ring):
            on_ring = across[scan.ring == ring]
            if len(on_ring) > 10:
                growth.append((np.ptp(on_ring) + step_m - board.width_m) / 2)
    assert 1e3 * np.mean(growth) == pytest.approx(growth_mm, abs=1.0)


def test_range_noise_has_stated_sigma(board, T_world_lidar):
    scene = Scene(Raycaster(()), [], board, board_before_lidar(2.0, roll_deg=0.0))
    noise = replace(EXACT, range_sigma_m=0.02)
    error = in_board(scene, T_world_lidar, scan_of(scene, T_world_lidar, noise))[:, 2]
    n = len(error)
    assert n > 800
    assert error.std() == pytest.approx(0.02, rel=4 / np.sqrt(2 * n))
    assert abs(error.mean()) < 4 * 0.02 / np.sqrt(n)


def test_laser_bias_shifts_each_ring_by_its_own_amount(board, T_world_lidar):
    scene = Scene(Raycaster(()), [], board, board_before_lidar(2.0, roll_deg=0.0))
    bias = 0.001 * np.arange(16.0)
    scan = simulate_scan(scene, T_world_lidar, VLP16, EXACT, np.random.default_rng(0), laser_bias_m=bias)
    plane = -in_board(scene, T_world_lidar, scan)[:, 2]
    cosine = scan.points[:, 0] / np.linalg.norm(scan.points, axis=1)
    assert np.abs(plane / cosine - bias[lasers(scan)]).max() < 1e-4


def test_dark_squares_and_weak_returns_read_long(board, T_world_lidar):
    T = board_before_lidar(1.5, roll_deg=0.0)
    scene = Scene(Raycaster(()), [], board, T, print_reflectivity=0.2)
    scan = scan_of(scene, T_world_lidar, replace(EXACT, dark_bias_m=0.01, weak_bias_m=0.03))
    depth, is_dark = -in_board(scene, T_world_lidar, scan)[:, 2], scan.intensity < 30
    assert 0.2 < is_dark.mean() < 0.5
    assert np.median(depth[~is_dark]) == pytest.approx(0.0005, abs=2e-4)
    assert np.median(depth[is_dark]) == pytest.approx(0.008 + 0.03 * (1 - 20 / 30), abs=1e-3)


def test_rim_noise_moves_border_points_only(board, T_world_lidar):
    scene = Scene(Raycaster(()), [], board, board_before_lidar(2.5))
    plain, rimmed = (scan_of(scene, T_world_lidar, replace(EXACT, rim_spread_rad=w)) for w in (0.0, 0.0015))
    moved_m = np.linalg.norm(plain.points - rimmed.points, axis=1)
    assert moved_m.max() == 0.0, "an infinitely thin beam has no rim"
    plain, rimmed = (scan_of(scene, T_world_lidar, replace(BEAM, rim_spread_rad=w)) for w in (0.0, 0.0015))
    moved_m = np.linalg.norm(plain.points - rimmed.points, axis=1)
    xy = in_board(scene, T_world_lidar, plain)[:, :2]
    inside_m = np.min([board.width_m / 2, board.height_m / 2] - np.abs(xy), axis=1)
    is_rim = inside_m < BEAM.exit_size_m[0] + BEAM.divergence_rad[0] * 2.5
    assert moved_m[inside_m > 0.02].max() < 1e-6
    assert 1e-3 < moved_m[is_rim].mean() < 0.0015 * 2.6
