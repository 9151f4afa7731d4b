"""Inputs in which nothing can be seen, or everything is wrong: never an all-clear."""

from dataclasses import replace

import pytest
from benchmarks.drift_inputs import CORRUPTIONS, judge_corrupted

from lce_rig.simulate import truth_extrinsics
from tests.scene.conftest import SEED


@pytest.mark.long
@pytest.mark.parametrize("name", CORRUPTIONS)
def test_a_corruption_is_never_an_all_clear(seen, name) -> None:
    pair = judge_corrupted(seen.rig, seen.captures, seen.truth, CORRUPTIONS[name])
    assert pair.state != "unchanged"
    assert pair.summary.code.startswith("scene.") and pair.summary.severity != "note"


def test_another_rig_s_result_is_changed(seen) -> None:
    other = replace(seen.truth, T_cam_lidar=truth_extrinsics(seen.rig, SEED + 1)["cam", "lidar"])
    pair = judge_corrupted(seen.rig, seen.captures, other, lambda image, scan, _: (image, scan))
    assert pair.state == "changed"
