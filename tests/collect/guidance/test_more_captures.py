"""The plan of captures to add: as many as are missing, where they help, and none where nothing is known."""

import numpy as np
import pytest

from lce_rig.collect.guidance.planner import Planner, common_third, plan_captures
from lce_rig.collect.guidance.sensor_model import SensorModel, SensorPlace
from lce_rig.core.camera import Intrinsics
from lce_rig.rig import load_rig
from tests.shared import changed


def plan(rig, held):
    (finding,) = plan_captures(rig, "cam", "lidar", held)
    assert sum(group[0] for group in finding.figures["placements"]) == finding.figures["n_captures"]
    assert len(f"    -> {finding.advice}") <= 80
    return dict(finding.figures)


@pytest.fixture(scope="module")
def placements():
    """Placements that guidance itself would choose, the best first."""
    rig = load_rig("rlfs")
    view = SensorPlace(SensorModel.of(rig, "cam", "lidar"), rig.nominal("cam", "lidar").to_matrix())
    planner, held = Planner(view), np.zeros((0, 4, 4))
    for _ in range(5):
        held = np.concatenate([held, planner.guide(held).T_cam_board[None]])
    return held


@pytest.mark.long
def test_plan_few_captures_reaches_minimum(placements):
    rig = load_rig("rlfs")
    for n in (0, 3, 5):
        assert n + plan(rig, placements[:n])["n_captures"] >= rig.quality.min_captures


def test_plan_like_boards_adds_tilted_ones(placements):
    alike = np.repeat(placements[:1], 5, axis=0)
    alike[:, :3, 3] *= np.linspace(0.7, 1.0, 5)[:, None]
    assert any(group[3] for group in plan(load_rig("rlfs"), alike)["placements"])


def test_plan_without_nominal_needs_beams(placements):
    rig = load_rig("rlfs").model_copy(update={"nominal_extrinsics": ()})
    assert plan(rig, placements)["n_captures"] >= 1
    assert not plan_captures(changed(rig, lidars__lidar__model="other"), "cam", "lidar", placements)


@pytest.mark.parametrize(
    ("shares", "word"), [((0.02, 0.6), ""), ((0.02, 0.3), "on your right"), ((0.7, 0.98), "on your left")]
)
def test_outer_third_is_named_only_if_all_boards_are_in_it(shares, word):
    lens = Intrinsics(900, 900, 499.5, 299.5, 1000, 600, "radtan", (0.0,) * 4)
    centres = 2.0 * lens.unproject(np.array([[1000 * share, 300] for share in shares]))
    assert common_third(lens, centres) == word
