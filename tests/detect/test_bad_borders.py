"""Boards with an incomplete border are used, and errors of border points agree with their deviations."""

from dataclasses import replace

import numpy as np
import pytest
from bad_borders import SCENES, SMEAR_M, Ragged
from scans import BOARD, accumulate, board_plate, cast, outline_distance, place, room

from lce_rig.core.data import Scan
from lce_rig.core.findings import Refusal
from lce_rig.core.geometry import Array, invert, transform
from lce_rig.core.results import LidarBoard
from lce_rig.detect.lidar.measurement import Beam
from lce_rig.detect.lidar.search import Limits, find_lidar_boards
from lce_rig.detect.lidar.unstructured import find_unstructured_boards

POINT_BEAM = Limits(beam=Beam(0.0, 0.0, 0.0))
OS1_DEG = np.linspace(-16.6, 16.6, 64)


def boards(border: str, has_rings: bool, n: int = 5) -> list[tuple[LidarBoard, Array]]:
    """Find the board in n scenes; with its true pose."""
    found = []
    for seed in range(n):
        shapes, T = SCENES[border](seed, has_rings)
        if has_rings:
            scan = cast(
                shapes, sigma_m=0.008, seed=seed, elevations_deg=OS1_DEG, step_deg=360 / 1024, stagger=0.27
            )
            candidates = find_lidar_boards(scan, BOARD, POINT_BEAM)
        else:
            scan = accumulate(shapes, sigma_m=0.008, seed=seed)
            candidates = find_unstructured_boards(scan, BOARD, POINT_BEAM)
        assert not isinstance(candidates, Refusal), (seed, candidates)
        found.append((candidates[0], T))
    return found


@pytest.mark.parametrize(
    "has_rings", [pytest.param(True, id="rings"), pytest.param(False, id="no rings", marks=pytest.mark.long)]
)
@pytest.mark.parametrize("border", [name for name in SCENES if name != "smeared by 20 mm"])
def test_partly_visible_border_has_ring_ends(border: str, has_rings: bool) -> None:
    for board, T in boards(border, has_rings):
        # With rings, an end lies up to a step inside.
        step_m = board.azimuth_step_rad * board.quality.distance_m / 0.7
        off_m = outline_distance(board.edge_points, T)
        assert len(off_m) >= 12
        assert np.mean((off_m > -0.012 - step_m) & (off_m < 0.012)) > 0.9
        assert abs(board.plane[:3] @ T[:3, 2]) > np.cos(np.radians(1.2))


@pytest.mark.parametrize("has_rings", [True, False], ids=["rings", "no rings"])
def test_smeared_border_has_its_width_as_noise(has_rings: bool) -> None:
    for board, T in boards("smeared by 20 mm", has_rings):
        assert board.edge_sigma_m is not None
        assert np.median(board.edge_sigma_m) > 0.6 * SMEAR_M
        off_m = outline_distance(board.edge_points, T)
        assert np.sqrt(np.mean((off_m / np.hypot(board.edge_sigma_m, 0.005)) ** 2)) < 1.5


@pytest.mark.parametrize("has_rings", [True, False], ids=["rings", "no rings"])
def test_sharp_border_has_no_further_noise(has_rings: bool) -> None:
    assert all(board.edge_sigma_m is None for board, _ in boards("whole", has_rings))


@pytest.mark.parametrize("border", ["on a bar", "on the floor"])
def test_side_on_a_stand_has_no_ends_on_it(border: str) -> None:
    """The plate's end within a merged surface is undetermined."""
    for board, T in boards(border, has_rings=False):
        on_board = transform(invert(T), board.edge_points)
        is_lower = on_board[:, 1] < -BOARD.height_m / 2 + 0.03
        assert np.count_nonzero(is_lower & (np.abs(on_board[:, 0]) < 0.3)) <= (
            8 if border == "on a bar" else 0
        )


def test_moving_board_is_refused_by_its_motion() -> None:
    """It slides by 60 mm while points are accumulated; one with as wide a border that stands is not."""
    T, parts = place(3, 5, 20, 20), []
    for k in range(12):
        moved = T.copy()
        moved[:3, 3] += T[:3, 0] * 0.06 * (k / 11 - 0.5)
        parts.append(accumulate([board_plate(moved), *room(13)], sigma_m=0.008, seed=k, n=10_000))
    refusal = find_unstructured_boards(_joined(parts), BOARD, POINT_BEAM)
    assert isinstance(refusal, Refusal) and refusal.code == "lidar.moved"
    assert refusal.figure("moved_m") == pytest.approx(0.045, abs=0.01)
    parts = [accumulate([Ragged(T, False, k), *room(13)], sigma_m=0.008, seed=k, n=10_000) for k in range(12)]
    assert isinstance(find_unstructured_boards(_joined(parts), BOARD, POINT_BEAM), list)


def _joined(parts: list[Scan]) -> Scan:
    points, intensity, ring = (
        np.concatenate([getattr(part, name) for part in parts]) for name in ("points", "intensity", "ring")
    )
    return replace(parts[0], points=points, intensity=intensity, ring=ring)
