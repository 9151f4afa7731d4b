"""The board in point clouds without rings: its pose, touching surfaces, and false candidates."""

from dataclasses import replace

import numpy as np
import pytest
from scans import BOARD, Box, Plate, Shape, accumulate, board_plate, outline_distance, person, place, room

from lce_rig.core.findings import Refusal
from lce_rig.core.geometry import Array, exp_so3, perturb, pose
from lce_rig.core.results import LidarBoard
from lce_rig.detect.lidar.measurement import Beam
from lce_rig.detect.lidar.search import Limits
from lce_rig.detect.lidar.unstructured import find_unstructured_boards, look_for_unstructured_board

POINT_BEAM = Limits(beam=Beam(0.0, 0.0, 0.0))


def best(found: list[LidarBoard] | Refusal) -> LidarBoard:
    assert not isinstance(found, Refusal), found
    return found[0]


def assert_is_at(board: LidarBoard, T_lidar_board: Array, within_m: float = 0.008) -> None:
    """Compare place and normal with the truth, and the edge points with the plate's true edges."""
    assert np.linalg.norm(board.T_lidar_board[:3, 3] - T_lidar_board[:3, 3]) < within_m
    assert np.degrees(np.arccos(min(1.0, board.plane[:3] @ T_lidar_board[:3, 2]))) < 0.4
    assert len(board.edge_points) >= 12
    assert np.sqrt(np.mean(outline_distance(board.edge_points, T_lidar_board) ** 2)) < 0.006


@pytest.mark.parametrize("roll_deg", [0, 20, 45, 70])
@pytest.mark.parametrize(("distance_m", "yaw_deg"), [(2, 0), (3, 40), (5, -30)])
def test_unstructured_board_is_found_at_any_roll(distance_m: float, yaw_deg: float, roll_deg: float) -> None:
    T = place(distance_m, 5, roll_deg, yaw_deg)
    assert_is_at(
        best(find_unstructured_boards(accumulate([board_plate(T), *room(13)]), BOARD, POINT_BEAM)), T
    )


def test_unstructured_board_by_box_is_found() -> None:
    """Also with a person behind it, and with a box beside it on the floor."""
    T = place(3, 5, 0, 20)
    held = accumulate([board_plate(T), *person(T, 0.25), *room(13)])
    assert_is_at(best(find_unstructured_boards(held, BOARD, POINT_BEAM)), T)
    T = place(3, 5, 0, 20, z_m=-1.0 + BOARD.height_m / 2)
    box = Box(pose(exp_so3(np.array([0, 0, 0.6])), np.array([3.2, 0.95, -0.6])), (0.4, 0.4, 0.8))
    shapes = [board_plate(T), box, *room(13)]
    assert_is_at(best(find_unstructured_boards(accumulate(shapes), BOARD, POINT_BEAM)), T, 0.02)


def test_unstructured_board_without_background_is_found() -> None:
    T = place(4, -5, 30)
    scan = accumulate([board_plate(T), Box(pose(np.eye(3), np.array([3.0, 2.5, 0])), (1, 0.5, 2))])
    board = best(find_unstructured_boards(scan, BOARD, POINT_BEAM))
    assert np.linalg.norm(board.T_lidar_board[:3, 3] - T[:3, 3]) < 0.008
    # The plate's end between the last return and the next ray is undetermined.
    beyond = outline_distance(board.edge_points, T)
    assert len(beyond) >= 12 and np.std(beyond) < 0.01 and abs(np.mean(beyond)) < 0.02


def test_predicted_board_is_found_or_the_cause_is_named() -> None:
    T = place(3, 5, 20)
    off = perturb(T[None], np.array([[0.05, -0.03, 0.04, 0.05, 0.02, -0.05]]))[0]
    scan = accumulate([board_plate(T), *room(13)])
    found = look_for_unstructured_board(scan, BOARD, off, POINT_BEAM)
    assert isinstance(found, LidarBoard)
    assert_is_at(found, T)
    too_near = look_for_unstructured_board(scan, BOARD, off, replace(POINT_BEAM, min_range_m=4.0))
    assert isinstance(too_near, Refusal)
    elsewhere = look_for_unstructured_board(scan, BOARD, place(4, 25, 0), POINT_BEAM)
    assert isinstance(elsewhere, Refusal) and elsewhere.code.startswith("lidar.not")


def test_other_plates_are_refused_with_their_cause() -> None:
    T = place(3, 5, 20)
    W, H = BOARD.width_m, BOARD.height_m

    def code_of(*shapes: Shape, fov_deg: float = 70.0) -> str:
        found = find_unstructured_boards(accumulate([*shapes, *room(13)], fov_deg=fov_deg), BOARD, POINT_BEAM)
        assert isinstance(found, Refusal)
        return found.code

    assert code_of(board_plate(T, scale=1.3)) == "lidar.other_plate"
    # A sheet in its plane at one edge, as high as the plate; the rim of the view.
    beside = pose(T[:3, :3], T[:3, 3] + T[:3, 0] * (W / 2 + 0.1))
    assert code_of(board_plate(T), Plate(beside, 0.2, H)) in ("lidar.no_border", "lidar.other_plate")
    assert code_of(board_plate(place(3, 14, 0)), fov_deg=30.0) in ("lidar.out_of_view", "lidar.other_plate")
    assert code_of() in ("lidar.no_plate", "lidar.other_plate")


@pytest.mark.parametrize("deep_m", [0.0, 0.1], ids=["flush", "behind"])
@pytest.mark.parametrize("side", [0, 1], ids=["beside", "below"])
def test_box_at_plate_hides_only_touched_border(side: int, deep_m: float) -> None:
    """A box at half of one edge, its face in the plate's plane or a hand behind it."""
    T, size_m = place(3, 5, 0, 20), np.array([BOARD.width_m, BOARD.height_m])
    box_m = np.array([0.35, 0.35, 0.3])
    middle = np.zeros(3)
    middle[side] = -(size_m[side] + box_m[side]) / 2
    middle[2] = -deep_m - box_m[2] / 2
    box = Box(pose(T[:3, :3], T[:3, 3] + T[:3, :3] @ middle), tuple(box_m.tolist()))
    found = find_unstructured_boards(accumulate([board_plate(T), box, *room(13)]), BOARD, POINT_BEAM)
    if isinstance(found, Refusal):
        assert found.code == "lidar.other_plate"
    else:
        # The outline is a start; what the calibration takes are the places on the border.
        assert_is_at(found[0], T, 0.04)


@pytest.mark.parametrize("n", [0, 5, 400])
def test_too_few_points_are_refused(n: int) -> None:
    scan = accumulate([board_plate(place(3, 5, 20)), *room(13)], n=max(n, 1)).select(np.arange(n))
    assert isinstance(find_unstructured_boards(scan, BOARD, POINT_BEAM), Refusal)


@pytest.mark.parametrize("n", [4_000, 8_000, 16_000])
def test_sparse_board_without_a_located_border_is_refused(n: int) -> None:
    """Without a border, the plate's position in its plane is undetermined, and no residual reveals it."""
    scan = accumulate([board_plate(place(3, 5, 20)), *room(13)], n=n)
    found = find_unstructured_boards(scan, BOARD, POINT_BEAM)
    for board in () if isinstance(found, Refusal) else found:
        assert np.isfinite(board.quality.edge_rms_m)
        assert board.quality.n_ring_ends >= 4
        assert len(board.points) >= 10


def test_half_beam_grows_with_obliquity() -> None:
    """A beam ten times as high as wide, on a plate turned about its upright edges."""
    beam, yaw_rad = Beam(0.005, 0.0005, 0.005), np.radians(40)
    T = place(3, 0, 0, 40)
    board = best(find_unstructured_boards(accumulate([board_plate(T), *room(13)]), BOARD, Limits(beam=beam)))
    assert board.edge_beam_m is not None and board.edge_beam_m.shape == (len(board.edge_points), 2)
    wide_m, high_m = (beam.widths_m(3.0) / 2).tolist()
    on_plate = (board.edge_points - T[:3, 3]) @ T[:3, :2]
    is_side = np.abs(on_plate[:, 0]) / BOARD.width_m > np.abs(on_plate[:, 1]) / BOARD.height_m
    assert board.edge_beam_m[is_side, 0].mean() == pytest.approx(wide_m / np.cos(yaw_rad), rel=0.1)
    assert board.edge_beam_m[~is_side, 1].mean() == pytest.approx(high_m, rel=0.1)
    assert board.edge_beam_m[is_side, 1].max() < 0.002


@pytest.mark.parametrize("intensity", [0.0, 50.0], ids=["without intensity", "alike"])
def test_the_wall_behind_each_edge_is_measured(intensity: float) -> None:
    T = place(3, 5, 20)
    scan = accumulate([board_plate(T), *room(13)])
    scan = replace(scan, intensity=np.full(len(scan.points), intensity, dtype=np.float32))
    board = best(find_unstructured_boards(scan, BOARD, POINT_BEAM))
    range_m = np.linalg.norm(board.edge_points, axis=1)
    beyond_m = np.median(board.edge_behind_m) / np.abs(T[:3, 2] @ T[:3, 3]) * 3.0
    share = 1 / (1 + ((range_m + beyond_m) / range_m) ** 2)
    assert np.median(board.edge_echo) == pytest.approx(np.median(share), rel=0.25)
