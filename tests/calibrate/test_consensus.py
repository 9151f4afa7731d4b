"""The correct pairs are found among decoys, misdetections and ambiguous poses, for any mounting."""

from dataclasses import replace

import numpy as np
import pytest

from lce_rig.calibrate.consensus import find_consensus
from lce_rig.calibrate.result import error_to_reference
from lce_rig.core.errors import NotEnoughDataError
from lce_rig.core.geometry import exp_so3, invert, pose
from lce_rig.core.results import Observation
from tests.calibrate.boards import BOARD, T_FORWARD, Scenario, random_pose, scan_board, simulate, with_decoy


def somewhere_else(seed, T_cam_lidar=T_FORWARD):
    """A plate of the board's size at a place where no board is."""
    rng = np.random.default_rng(seed)
    while True:
        decoy = scan_board(invert(T_cam_lidar) @ random_pose(rng, Scenario(), BOARD), rng, Scenario(), BOARD)
        if decoy is not None:
            return decoy


@pytest.mark.parametrize(
    ("mounting", "turn_deg"),
    [
        ("forward", (0, 0, 0)),
        ("rear", (0, 0, 180)),
        ("upside down", (180, 0, 0)),
        ("on its side", (0, 20, 95)),
    ],
)
def test_consensus_any_mounting_is_found(mounting, turn_deg):
    R_turn = exp_so3(np.radians(np.array(turn_deg, dtype=float)))
    T = pose(T_FORWARD[:3, :3] @ R_turn.T, np.array([0.3, -0.2, 0.15]))
    captures = simulate(10, seed=3, T_cam_lidar=T)
    consensus = find_consensus(captures, BOARD)
    assert len(consensus.observations) == 10
    angle_deg, distance_m = error_to_reference(consensus.T_cam_lidar, T)
    assert angle_deg < 2.0
    assert distance_m < 0.05


def test_consensus_static_decoy_is_not_taken():
    captures = simulate(12, seed=1)
    decoy = somewhere_else(99)
    consensus = find_consensus([with_decoy(item, decoy, is_first=True) for item in captures], BOARD)
    assert len(consensus.observations) == 12
    assert all(observation.lidar is not decoy for observation in consensus.observations)


def test_consensus_many_rivals_are_rejected():
    """Every capture has three decoys, and every third capture lacks the board."""
    captures = []
    for k, item in enumerate(simulate(15, seed=2)):
        rivals = [somewhere_else(1000 + 3 * k + j) for j in range(3)]
        places = rivals if k % 3 == 0 else [*rivals, item.lidar]
        captures.append(Observation.of(item.capture, item.image, places))
    consensus = find_consensus(captures, BOARD)
    assert error_to_reference(consensus.T_cam_lidar, T_FORWARD)[0] < 2.0
    right = [item for k, item in enumerate(captures) if k % 3]
    found = {observation.capture: observation.lidar for observation in consensus.observations}
    assert all(found[item.capture] is item.places[-1] for item in right)
    for capture, refusal in consensus.refused.items():
        assert int(capture) % 3 == 0
        assert (refusal.code, refusal.figures["n_candidates"]) == ("pair.elsewhere", 3)


def test_consensus_swapped_pose_is_corrected():
    captures = simulate(12, seed=4, scenario=Scenario(corner_sigma_px=0.3))
    swapped = []
    for item in captures[:4]:
        assert item.image.T_cam_board_alternative is not None
        image = replace(
            item.image,
            T_cam_board=item.image.T_cam_board_alternative,
            T_cam_board_alternative=item.image.T_cam_board,
            chi2_gap=2.0,
        )
        swapped.append(replace(item, pose=image))
    consensus = find_consensus(swapped + captures[4:], BOARD)
    chosen = {observation.capture: observation.image.T_cam_board for observation in consensus.observations}
    for item in captures[:4]:
        np.testing.assert_array_equal(chosen[item.capture], item.image.T_cam_board)


def test_consensus_of_unrelated_captures_is_empty():
    captures = [replace(item, surface=somewhere_else(k)) for k, item in enumerate(simulate(4, seed=6))]
    with pytest.raises(NotEnoughDataError) as caught:
        find_consensus(captures, BOARD)
    assert caught.value.finding.code == "shortage.few_agree"
