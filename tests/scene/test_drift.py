"""Drift by the scene's edges, compared with the truth of a simulated room."""

from dataclasses import replace

import numpy as np
import pytest

from lce_rig.core.calibration import MOTIONS
from lce_rig.core.geometry import difference, perturb, tangent_sizes
from lce_rig.judge.scene_drift import watch_scene
from lce_rig.scene.edge_pyramid import build_edge_pyramid


def judge(seen, tangent=(0.0,) * 6, views=None):
    moved = replace(seen.truth, T_cam_lidar=perturb(seen.truth.T_cam_lidar, np.array(tangent)))
    return watch_scene(seen.views if views is None else views, seen.rig.lens_of(moved), moved)


def along(axis, size):
    return size * np.eye(6)[MOTIONS.index(axis)]


def test_scene_drift_truth_holds(seen):
    drift = judge(seen)
    assert drift.state == "unchanged" and drift.change.chi2 < 6
    (finding,) = drift.findings
    assert finding.code == "scene.unchanged"
    assert finding.figures["smallest_deg"] < 1.5 and finding.figures["smallest_m"] < 0.15


@pytest.mark.parametrize("sign", [1, pytest.param(-1, marks=pytest.mark.long)])
@pytest.mark.parametrize("axis", MOTIONS)
def test_scene_drift_one_axis_is_seen_with_its_size(seen, axis, sign):
    size = np.radians(1.5) if axis.startswith("rotation") else 0.13
    drift = judge(seen, along(axis, sign * size))
    assert drift.state == "changed"
    assert axis in drift.findings[0].figures.get("axes", axis)
    turn_deg, shift_m = tangent_sizes(difference(drift.T_changed, seen.truth.T_cam_lidar))
    assert drift.findings[0].code != "scene.changed" or (turn_deg < 0.6 and shift_m < 0.06)


def test_scene_drift_two_axes_are_both_named(seen):
    turned = along("rotation_y", np.radians(1.0)) + along("rotation_x", np.radians(1.2))
    drift = judge(seen, turned)
    assert drift.findings[0].figures["axes"] == ("rotation_x", "rotation_y")
    assert drift.findings[0].figures["rotation_deg"] == pytest.approx(1.56, abs=0.3)


@pytest.mark.parametrize("size_deg", [4.0, 8.0, -15.0])
def test_scene_drift_beyond_the_reach_does_not_hold(seen, size_deg):
    assert judge(seen, along("rotation_y", np.radians(size_deg))).state != "unchanged"


def of_images(seen, change):
    """Replace the images of the views."""
    focal_px = seen.rig.cameras["cam"].to_intrinsics().fx_px
    return [
        replace(view, pyramid=build_edge_pyramid(change(capture.images[0].grey), focal_px))
        for view, capture in zip(seen.views, seen.captures, strict=True)
    ]


NOISE = np.random.default_rng(0)


@pytest.mark.parametrize(
    "change",
    [
        lambda grey: np.full_like(grey, 90),
        lambda grey: (grey // 255 + NOISE.integers(0, 9, grey.shape)).astype(np.uint8),
        lambda grey: np.ascontiguousarray(grey[:, ::-1]),
        lambda grey: np.ascontiguousarray(grey[::-1, ::-1]),
    ],
    ids=["even", "dark", "mirrored", "upside down"],
)
def test_scene_drift_of_other_images_cannot_tell(seen, change):
    drift = judge(seen, views=of_images(seen, change))
    assert drift.state == "unknown" and drift.opinion.change is None


def test_scene_drift_few_edges_cannot_tell(seen):
    view = seen.views[0]
    few = view.outlines.select(np.arange(len(view.outlines)) < 9)
    for views in ([], [replace(view, outlines=few)]):
        drift = judge(seen, views=views)
        assert drift.state == "unknown" and drift.findings[0].code == "scene.few_edges"


def test_scene_drift_uncertain_result_cannot_tell(seen):
    wide = seen.truth.cov + np.diag([0.0] * 3 + [np.radians(1.0)] * 3) ** 2
    drift = watch_scene(seen.views, seen.rig.lens_of(seen.truth), replace(seen.truth, cov=wide))
    assert drift.state == "unknown" and drift.findings[0].code == "scene.unknown"
