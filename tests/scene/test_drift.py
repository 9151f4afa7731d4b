"""The scene's opinion on extrinsics, against a simulated room's truth."""

from dataclasses import replace

import numpy as np
import pytest

from lce_rig.core.calibration import MOTIONS
from lce_rig.core.geometry import difference, perturb
from lce_rig.scene.alignment import Alignment
from lce_rig.scene.depth_edges import CHANNELS
from lce_rig.scene.drift import watch
from lce_rig.scene.edge_field import build_edge_field


def judge(seen, tangent=(0.0,) * 6, views=None):
    c = seen.truth
    lens = seen.rig.cameras["cam"].to_intrinsics()
    moved = perturb(c.T_cam_lidar, np.array(tangent))
    return watch(seen.views if views is None else views, lens, moved, c.cov)


def along(axis, size):
    return size * np.eye(6)[MOTIONS.index(axis)]


def test_the_truth_is_unchanged(seen):
    drift = judge(seen)
    assert drift.state == "unchanged"
    assert all(abs(axis.change) < 2 * axis.sigma for axis in drift.axes)


@pytest.mark.parametrize("sign", [-1, 1])
@pytest.mark.parametrize(
    ("axis", "size"),
    [
        ("rotation_x", np.radians(1.0)),
        ("rotation_y", np.radians(0.6)),
        ("rotation_z", np.radians(1.4)),
        ("translation_x", 0.05),
        ("translation_y", 0.05),
        ("translation_z", 0.10),
    ],
)
def test_one_changed_axis_is_seen_with_its_size(seen, axis, size, sign):
    drift = judge(seen, along(axis, sign * size))
    assert drift.state == "changed"
    (found,) = [each for each in drift.axes if each.state == "changed"]
    injected = np.degrees(size) if found.unit == "deg" else size
    assert axis in (found.axis, *found.instead)
    if found.axis == axis:
        assert found.change == pytest.approx(-sign * injected, abs=3 * found.sigma)


def test_changes_of_two_axes_are_both_seen(seen):
    turned = along("rotation_y", np.radians(1.0)) + along("rotation_x", np.radians(1.2))
    drift = judge(seen, turned)
    assert {axis.axis for axis in drift.axes if axis.state == "changed"} >= {"rotation_y"}
    left = difference(drift.T_changed, seen.truth.T_cam_lidar)
    assert np.degrees(np.linalg.norm(left[3:])) < 0.5


@pytest.mark.parametrize("size_deg", [4.0, 8.0, -15.0])
def test_a_change_beyond_the_range_is_never_an_all_clear(seen, size_deg):
    assert judge(seen, along("rotation_y", np.radians(size_deg))).state != "unchanged"


def of_images(seen, change):
    """Replace the images of the views."""
    focal_px = seen.rig.cameras["cam"].to_intrinsics().fx_px
    return [
        replace(view, field=build_edge_field(change(capture.images[0].grey), focal_px))
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
def test_images_without_the_scene_s_edges_cannot_tell(seen, change):
    drift = judge(seen, views=of_images(seen, change))
    assert {axis.state for axis in drift.axes} == {"unknown"}


def test_changes_of_reflectivity_alone_show_pitch_and_yaw(seen):
    lens = seen.rig.cameras["cam"].to_intrinsics()
    is_painted = [view.edges.channel == CHANNELS.index("reflectivity") for view in seen.views]
    views = [
        replace(view, edges=view.edges.select(keep))
        for view, keep in zip(seen.views, is_painted, strict=True)
    ]
    alignment = Alignment(views, lens, seen.truth.T_cam_lidar)
    for axis in ("rotation_x", "rotation_y"):
        curve = alignment.curve(MOTIONS.index(axis), np.zeros(6))
        assert abs(np.degrees(curve.peak)) < 0.15


def test_too_few_edges_cannot_tell(seen):
    view = seen.views[0]
    edges = view.edges
    few = edges.select(np.arange(len(edges)) < 9)
    for views in ([], [replace(view, edges=few)]):
        drift = judge(seen, views=views)
        assert drift.state == "unknown" and drift.findings[0].code == "scene.few_edges"
