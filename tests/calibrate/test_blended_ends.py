"""Ring ends before something close behind: left out where they are many, but not the last of a capture."""

from dataclasses import replace

import numpy as np
import pytest

from lce_rig.calibrate import CalibrateOptions, calibrate
from lce_rig.calibrate.blended_ends import blended_share, is_blended, without_blended_ends
from lce_rig.calibrate.consensus import find_consensus
from lce_rig.core.geometry import difference
from tests.calibrate.boards import BOARD, T_FORWARD, simulate


@pytest.fixture(scope="module")
def observations():
    found = find_consensus(simulate(12, 1), BOARD)
    assert found is not None
    return found.observations


def behind(observation, is_behind):
    return replace(
        observation, lidar=replace(observation.lidar, edge_behind_m=np.where(is_behind, 0.2, np.inf))
    )


def test_a_large_share_is_left_out_and_a_small_one_kept(observations):
    many = [behind(o, o.lidar.edge_side > 0) for o in observations]
    assert blended_share(many) == pytest.approx(0.5)
    cleaned = without_blended_ends(many)
    assert not any(is_blended(o.lidar).any() for o in cleaned)
    for o, whole in zip(cleaned, observations, strict=True):
        assert len(o.lidar.edge_points) == len(o.lidar.edge_ring) == len(whole.lidar.edge_points) / 2
        assert np.all(o.lidar.edge_side < 0)
    few = [many[0], *observations[1:]]
    assert sum(len(o.lidar.edge_points) for o in without_blended_ends(few)) == sum(
        len(o.lidar.edge_points) for o in observations
    )


def test_a_capture_with_hardly_any_other_ring_end_keeps_all(observations):
    all_blended = [behind(o, np.ones(len(o.lidar.edge_side), bool)) for o in observations]
    assert [len(o.lidar.edge_points) for o in without_blended_ends(all_blended)] == [
        len(o.lidar.edge_points) for o in observations
    ]


def test_a_person_behind_half_of_every_board_does_not_move_the_extrinsic():
    """The left ends of every ring lie 8 mm too far inside."""
    shifted = []
    for capture in simulate(20, 3):
        lidar = capture.lidar[0]
        is_left = lidar.edge_side > 0
        axis = lidar.T_lidar_board[:3, 0]
        inwards = -np.sign(np.cross([0, 0, 1.0], lidar.edge_points) @ axis)[:, None] * axis
        ends = lidar.edge_points + 0.008 * is_left[:, None] * inwards
        gap = np.where(is_left, 0.2, np.inf)
        shifted.append(replace(capture, lidar=[replace(lidar, edge_points=ends, edge_behind_m=gap)]))
    unaware = [
        replace(c, lidar=[replace(c.lidar[0], edge_behind_m=np.full(len(c.lidar[0].edge_side), np.inf))])
        for c in shifted
    ]
    options = CalibrateOptions(n_draws=0)
    errors = [
        np.linalg.norm(difference(calibrate(each, BOARD, options).T_cam_lidar, T_FORWARD)[:3])
        for each in (shifted, unaware)
    ]
    assert errors[0] < 0.003
    assert errors[0] < 0.6 * errors[1]
