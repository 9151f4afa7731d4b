"""The board in full scans of a room: its pose, its figures, and false candidates."""

from dataclasses import replace

import numpy as np
import pytest
from scans import (
    BOARD,
    HDL32_DEG,
    UNEVEN64_DEG,
    Box,
    Plate,
    board_plate,
    cast,
    outline_distance,
    person,
    place,
    room,
)

from lce_rig.core.board import Board
from lce_rig.core.data import Scan
from lce_rig.core.findings import Refusal
from lce_rig.core.geometry import exp_so3, invert, pose, transform
from lce_rig.core.results import LidarBoard
from lce_rig.detect.lidar.measurement import Beam
from lce_rig.detect.lidar.search import Limits, find_lidar_boards, look_for_board
from lce_rig.detect.lidar.segments import order_scan

POINT_BEAM = Beam(0.0, 0.0)
ROOM = room(13.0)


def find(scan, **limits):
    return find_lidar_boards(scan, BOARD, Limits(beam=POINT_BEAM, **limits))


def assert_is_board(found, T_lidar_board, within_m=0.02, within_deg=1.5, normal_deg=0.6):
    """Check the first candidate against the truth, up to the symmetries of a rectangle."""
    assert not isinstance(found, Refusal), found
    T = found[0].T_lidar_board
    assert np.linalg.norm(T[:3, 3] - T_lidar_board[:3, 3]) < within_m
    assert np.degrees(np.arccos(min(1.0, found[0].plane[:3] @ T_lidar_board[:3, 2]))) < normal_deg
    assert np.degrees(np.arccos(min(1.0, abs(T[:3, 0] @ T_lidar_board[:3, 0])))) < within_deg
    assert found[0].plane[3] > 0


@pytest.mark.parametrize("azimuth_deg", [0, 60, 120, 179, 181, 240, 300])
def test_board_is_found_on_every_side_of_the_lidar(azimuth_deg):
    T = place(2.5, azimuth_deg)
    assert_is_board(find(cast([board_plate(T), *ROOM], sigma_m=0.01, seed=azimuth_deg)), T)


@pytest.mark.parametrize("start_deg", [28, 30, 180])
def test_board_at_scan_seam_is_complete(start_deg):
    T = place(2.5, 30)
    assert_is_board(find(cast([board_plate(T), *ROOM], sigma_m=0.01, start_deg=start_deg)), T)


def rotated_about_z(scan, deg):
    """Return the same returns in the frame of a LiDAR mounted with another yaw."""
    c, s = np.cos(np.radians(deg)), np.sin(np.radians(deg))
    return replace(
        scan, points=(scan.points @ np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]])).astype(np.float32)
    )


def test_lidar_board_yaw_keeps_background():
    scan = cast([board_plate(place(2.5, 20)), *ROOM], sigma_m=0.01)
    ahead = find(scan)[0]
    # Rings are cut at their first break from azimuth -180 deg on; boards at every angle to it.
    for deg in (148, 155, 160, 165, 172):
        turned = find(rotated_about_z(scan, deg))[0]
        assert len(turned.edge_points) == len(ahead.edge_points), deg
        assert np.isfinite(turned.edge_behind_m).sum() == np.isfinite(ahead.edge_behind_m).sum(), deg


def test_overlapping_revolution_changes_nothing():
    T = place(2.5, 30)
    scan = cast([board_plate(T), *ROOM], sigma_m=0.01)
    twice = scan.select(np.concatenate([np.arange(len(scan.points)), np.arange(8000)]))
    np.testing.assert_array_equal(find(twice)[0].T_lidar_board, find(scan)[0].T_lidar_board)


@pytest.mark.parametrize("roll_deg", [0, 20, 45, 70, 90])
@pytest.mark.parametrize("distance_m", [1.2, 2, 3, 4, 5])
def test_board_is_found_at_every_distance_and_roll(distance_m, roll_deg):
    T = place(distance_m, 20, roll_deg)
    # A board that hangs straight shows its height only to within the gap between two rings.
    free_m = 0.02 if roll_deg % 90 else 0.5 * np.radians(2.0) * distance_m
    found = find(cast([board_plate(T), *ROOM], sigma_m=0.01, seed=roll_deg))
    assert_is_board(found, T, within_m=free_m + 0.005, normal_deg=0.3 * distance_m)


@pytest.mark.parametrize(
    ("yaw_deg", "pitch_deg"), [(60, 0), (-60, 0), (0, 55), (0, -55), (40, 40), (-45, -35)]
)
def test_tilted_board_is_found(yaw_deg, pitch_deg):
    T = place(2.3, -30, 45, yaw_deg, pitch_deg)
    assert_is_board(find(cast([board_plate(T), *ROOM], sigma_m=0.01)), T)


@pytest.mark.parametrize("yaw_deg", [45, -52, 60])
@pytest.mark.parametrize("lost", ["nothing", "behind", "both"])
def test_lost_dark_squares_board_is_found(yaw_deg, lost):
    """A VLP-16 loses them at 42 to 66 deg, or measures them up to 8 cm behind the plane."""
    board, T = Board(6, 5, 0.15, 1.1, 0.95), place(3.5, 30, 0, yaw_deg, 10)
    scan = cast([board_plate(T, board), *ROOM], sigma_m=0.006, seed=3)
    local = transform(invert(T), scan.points.astype(np.float64))
    column, row = np.floor(local[:, :2].T / board.square_m + [[3.5], [3.0]])
    is_on = (np.abs(local[:, 2]) < 0.05) & (column >= 0) & (column < 7) & (row >= 0) & (row < 6)
    is_dark = is_on & ((column + row) % 2 == 0)
    is_gone = is_dark & {"nothing": True, "behind": False, "both": scan.ring % 2 == 0}[lost]
    farther = 1 + 0.06 / abs(T[:3, 2] @ T[:3, 3]) * (is_dark & ~is_gone)
    points = (scan.points * farther[:, None]).astype(np.float32)
    expected = T @ pose(exp_so3(np.array([0.02, 0.02, 0.02])), np.array([0.03, -0.03, 0.02]))
    found = look_for_board(replace(scan, points=points).select(~is_gone), board, expected)
    assert_is_board([found] if isinstance(found, LidarBoard) else found, T, within_m=0.06, within_deg=3)


@pytest.mark.parametrize("sigma_m", [0.0, 0.016, 0.032, 0.048, 0.06, 0.08, 0.1])
def test_board_is_found_at_every_noise_level_of_the_paper(sigma_m):
    T = place(2.3, 15, 45, 20, 10)
    scan = cast([board_plate(T), *ROOM], sigma_m=sigma_m, seed=2)
    found = find(scan)
    # 600 returns spread by 0.18 m rms fix a normal to sigma / (0.18 sqrt(600)) an axis; five times that.
    assert_is_board(
        found, T, within_m=0.03, within_deg=3, normal_deg=0.1 + 5 * np.degrees(sigma_m / 0.18 / 24)
    )
    assert order_scan(scan, 0.4).sigma_m == pytest.approx(max(sigma_m, 0.004), rel=0.1)


@pytest.mark.parametrize("behind_m", [0.1, 0.2, 0.4])
@pytest.mark.parametrize("roll_deg", [0, 45])
def test_person_behind_board_is_excluded(behind_m, roll_deg):
    T = place(2.0, 160, roll_deg, 15, -10)
    scan = cast([board_plate(T), *person(T, behind_m), *ROOM], sigma_m=0.008, seed=1, mixed_share=0.7)
    found = find(scan)
    assert_is_board(found, T, within_m=0.03)
    height = found[0].points @ T[:3, 2] - T[:3, 3] @ T[:3, 2]
    assert np.abs(height).max() < 5 * 0.008


def test_plate_of_the_same_size_is_a_second_candidate():
    T, other = place(2.5, 30), place(3.0, 150, 20)
    found = find(cast([board_plate(T), board_plate(other), *ROOM], sigma_m=0.01))
    assert len(found) == 2
    centres = np.array([f.T_lidar_board[:3, 3] for f in found])
    for truth in (T, other):
        assert np.linalg.norm(centres - truth[:3, 3], axis=1).min() < 0.03


@pytest.mark.parametrize("elevations_deg", [HDL32_DEG, UNEVEN64_DEG])
def test_board_is_found_by_lidars_with_other_rings(elevations_deg):
    T = place(3.0, 30)
    assert_is_board(find(cast([board_plate(T), *ROOM], sigma_m=0.01, elevations_deg=elevations_deg)), T)


def test_board_is_found_by_a_lidar_that_hangs_upside_down():
    T = place(2.5, 30)
    scan = cast([board_plate(T), *ROOM], sigma_m=0.01)
    turn = pose(exp_so3(np.array([np.pi, 0, 0])), np.zeros(3))
    turned = Scan("lidar", 0, transform(turn, scan.points).astype(np.float32), scan.intensity, 15 - scan.ring)
    assert_is_board(find(turned), turn @ T)


def test_hands_over_border_move_nothing():
    T = place(2.5, 30)
    hands = []
    for x, y in ((0.36, 0.0), (-0.36, 0.1)):
        hand = T @ pose(np.eye(3), np.array([x, y, 0.03]))
        hands.append(Box(hand, (0.1, 0.1, 0.06)))
    found = find(cast([board_plate(T), *hands, *ROOM], sigma_m=0.008))
    assert_is_board(found, T)
    assert found[0].quality.n_ring_ends_dropped >= 2
    assert np.abs(outline_distance(found[0].edge_points, T)).max() < 0.025


def test_plate_beside_board_changes_nothing():
    T = place(2.5, 30)
    beside = T @ pose(np.eye(3), np.array([BOARD.width_m / 2 + 0.45, 0, 0]))
    assert_is_board(find(cast([board_plate(T), Plate(beside, 0.8, 0.6), *ROOM], sigma_m=0.01)), T)


def test_ring_ends_lie_within_a_step():
    T = place(2.5, 30)
    board = find(cast([board_plate(T), *ROOM]))[0]
    step_m = 2.5 * board.azimuth_step_rad
    distance = outline_distance(board.edge_points, T)
    assert (distance < 1e-6).all()
    assert (distance > -1.5 * step_m).all()
    assert board.azimuth_step_rad == pytest.approx(np.radians(0.199), rel=1e-3)
    azimuth = np.arctan2(board.edge_points[:, 1], board.edge_points[:, 0])
    for ring in np.unique(board.edge_ring):
        ends = board.edge_ring == ring
        assert sorted(board.edge_side[ends]) == [-1, 1]
        assert azimuth[ends & (board.edge_side > 0)] > azimuth[ends & (board.edge_side < 0)]


def test_lidar_board_is_unbiased():
    errors, residuals, sizes, sigmas = [], [], [], []
    rng = np.random.default_rng(5)
    for seed in range(40):
        T = place(rng.uniform(1.8, 3), rng.uniform(-60, 90), rng.uniform(25, 65), 35, 25)
        scan = cast([board_plate(T), *ROOM], sigma_m=0.02, seed=seed)
        found = find(scan)
        assert not isinstance(found, Refusal), (seed, found)
        board = found[0]
        errors.append((T[:3, :3].T @ board.plane[:3])[:2])
        residuals.append(outline_distance(board.edge_points, T).mean())
        sizes.append([board.quality.width_m - BOARD.width_m, board.quality.height_m - BOARD.height_m])
        sigmas.append([board.quality.width_sigma_m, board.quality.height_sigma_m])
    errors, sizes = np.array(errors), np.array(sizes)
    standard_error = errors.std(axis=0) / np.sqrt(len(errors))
    assert (np.abs(errors.mean(axis=0)) < 4 * standard_error).all()
    assert np.degrees(errors.std(axis=0)).max() < 0.5
    assert np.abs(sizes.mean(axis=0)).max() < 0.0015
    assert np.sqrt(np.mean((sizes / sigmas) ** 2)) < 1.5
    # On average an end lies half a step inside the edge, seen along the edge's normal.
    assert -0.008 < np.mean(residuals) < -0.001


@pytest.mark.parametrize("scale", [0.95, 1.03, 1.08])
def test_other_size_board_is_measured_at_full_size(scale):
    T = place(2.3, 30)
    quality = find(cast([board_plate(T, scale=scale), *ROOM], sigma_m=0.01))[0].quality
    area_m2 = quality.width_m * quality.height_m
    assert np.sqrt(area_m2 / (BOARD.width_m * BOARD.height_m)) == pytest.approx(scale, abs=0.01)


def test_damaged_points_change_nothing():
    T = place(2.5, 30)
    scan = cast([board_plate(T), *ROOM], sigma_m=0.01)
    bad = np.array(
        [[np.nan, 1, 1], [np.inf, 0, 0], [0, 0, 0], [0.1, 0, 0], [1, -np.inf, np.nan]], dtype=np.float32
    )
    points = np.concatenate([bad, scan.points, bad])
    ring = np.concatenate([np.arange(5), scan.ring, np.arange(5)]).astype(np.int16)
    damaged = Scan("lidar", 0, points, np.zeros(len(points), np.float32), ring)
    np.testing.assert_array_equal(find(damaged)[0].T_lidar_board, find(scan)[0].T_lidar_board)


def test_empty_scan_is_refused_with_its_count():
    nothing = Scan("lidar", 0, np.zeros((3, 3), np.float32), np.zeros(3, np.float32), np.zeros(3, np.int16))
    refusal = find(nothing)
    assert (refusal.code, refusal.figures["n_points"]) == ("lidar.no_returns", 3)
    assert isinstance(find(nothing.select(np.zeros(0, dtype=int))), Refusal)


def test_two_rings_are_refused_with_distance_advice():
    T = place(5.0, 30, 0, 0, 60)
    refusal = find(cast([board_plate(T), *room(16.0)], sigma_m=0.01))
    assert (refusal.code, refusal.figures["n_rings"]) == ("lidar.too_few_rings", 2)
    assert refusal.figure("closer_m") == pytest.approx(2.5, abs=0.05)


@pytest.mark.parametrize(
    ("shapes", "code", "figures"),
    [
        ([], "lidar.no_plate", {"board_width_m": BOARD.width_m, "max_range_m": 6.0}),
        ([Plate(place(2.5, 30), 0.92, 0.74)], "lidar.other_plate", {"width_m": pytest.approx(0.92, abs=0.1)}),
        ([Plate(place(2.5, 30), 1.42, 0.63)], "lidar.touching", {}),
    ],
    ids=["none", "of another size", "a part of a larger surface"],
)
def test_lidar_board_none_names_the_cause(shapes, code, figures):
    refusal = find(cast([*shapes, *ROOM], sigma_m=0.01))
    assert isinstance(refusal, Refusal) and refusal.code == code
    assert {name: refusal.figures[name] for name in figures} == figures


def test_bent_board_is_refused_for_its_thickness():
    T = place(2.0, 30)
    scan = cast([board_plate(T), *ROOM], sigma_m=0.005)
    local = transform(invert(T), scan.points)
    on = (np.abs(local) < [0.4, 0.33, 0.02]).all(axis=1)
    local[on, 2] += 0.08 * (local[on, 0] / (BOARD.width_m / 2)) ** 2
    bent = Scan("lidar", 0, transform(T, local).astype(np.float32), scan.intensity, scan.ring)
    refusal = find(bent)
    assert refusal.code == "lidar.too_thick" and refusal.figure("plane_rms_m") > refusal.figure(
        "max_plane_rms_m"
    )


def test_plate_in_larger_plane_is_no_rival():
    T, patch = place(2.5, 30), place(3.0, 150)
    beside = Plate(patch @ pose(np.eye(3), np.array([BOARD.width_m / 2 + 0.35, 0, 0])), 0.6, 0.8)
    assert len(find(cast([board_plate(patch), beside, *ROOM], sigma_m=0.01))) == 1
    found = find(cast([board_plate(T), board_plate(patch), beside, *ROOM], sigma_m=0.01))
    assert_is_board(found, T)
    assert len(found) == 1


@pytest.mark.parametrize(("wall_intensity", "brightness"), [(50, 0.5), (20, 0.2), (None, 1.0)])
def test_ring_ends_have_background_echo_strength(wall_intensity, brightness):
    """A wall 2 m behind a board at 2 m, brighter or darker; without intensities both count as alike."""
    wall = Plate(place(4.0, roll_deg=0.0), 8.0, 6.0)
    scan = cast([board_plate(place(2.0)), wall], sigma_m=0.005)
    is_wall = scan.points[:, 0] > 3
    intensity = np.where(is_wall, wall_intensity, 100) if wall_intensity else np.zeros(len(is_wall))
    found = find(replace(scan, intensity=intensity.astype(np.float32)))[0]
    assert len(found.edge_echo) > 10
    echo = brightness * (found.edge_points[:, 0] / 4.0) ** 2
    assert np.allclose(found.edge_echo, echo / (1 + echo), rtol=0.02)
