"""Extrinsics from a scene without a board, against the truth of rendered panels."""

from dataclasses import replace

import numpy as np
import pytest

from lce_rig.core.geometry import difference, perturb, tangent_sizes
from lce_rig.detect.lidar.measurement import Beam
from lce_rig.lens.difference import turn_of_lens
from lce_rig.lens.models import MODELS
from lce_rig.scene.edge_pyramid import EdgePyramid, build_edge_pyramid
from lce_rig.scene.estimate import (
    MIN_GAIN,
    REACH,
    estimate_scene,
    find_better_focal,
    follow_lens,
    gain_over,
)
from lce_rig.scene.outline_score import OutlineScore, build_outline_view
from lce_rig.scene.outlines import LEVEL, UPRIGHT, find_outlines
from tests.scene.conftest import COV
from tests.scene.panels import LENS, TRUTH, rendered

BEAM = Beam(0.0, 0.0)
VECTOR = MODELS["radtan4"].vector(LENS)


def outline_view(seed):
    """Render one view, and find its edges."""
    return build_outline_view(str(seed), *rendered(seed), BEAM, LENS, TRUTH)


@pytest.fixture(scope="module")
def views():
    return [outline_view(seed) for seed in range(3)]


def estimate(views, tangent=(0.0,) * 6):
    return estimate_scene(views, LENS, perturb(TRUTH, np.array(tangent)))


@pytest.fixture(scope="module")
def found(views):
    """The estimate from the true start."""
    return estimate(views)


def further(cases):
    return [pytest.param(case, marks=pytest.mark.long) for case in cases]


STARTS = np.random.default_rng(5).uniform(-1, 1, (20, 6)) * REACH


@pytest.mark.parametrize("start", [*STARTS[:2], *further(STARTS[2:4])])
def test_estimate_rough_start_covers_truth(views, start):
    found = estimate(views, start)
    assert found.state == "usable"
    assert found.chi2(TRUTH) < 16.81
    turn_deg, shift_m = tangent_sizes(difference(found.T_cam_lidar, TRUTH))
    assert turn_deg < 0.1 and shift_m < 0.02


def test_gain_over_changed_extrinsics_exceeds_that_of_truth(views, found):
    lower = perturb(TRUTH, np.array([0.0, 0.19, 0.0, 0.0, 0.0, 0.0]))
    assert gain_over(found, views, LENS, TRUTH, COV) < MIN_GAIN / 2
    assert gain_over(found, views, LENS, lower, COV) > MIN_GAIN


@pytest.mark.long
def test_estimate_one_view_claims_cover_errors():
    found = [estimate([outline_view(10 + k)], start) for k, start in enumerate(STARTS)]
    chi2 = np.array([each.chi2(TRUTH) for each in found if each.state == "usable"])
    assert len(chi2) > 10 and np.mean(chi2 < 12.59) >= 0.9


@pytest.mark.long
def test_estimate_blind_view_has_no_veto(views):
    blind = replace(views[0], outlines=views[0].outlines.select(np.zeros(len(views[0].outlines), dtype=bool)))
    expected, found = estimate(views[1:]), estimate([blind, *views[1:]])
    assert found.state == expected.state and found.n_views == 2
    np.testing.assert_allclose(found.T_cam_lidar, expected.T_cam_lidar)


def test_estimate_dark_views_have_no_veto(views):
    grey = np.random.default_rng(0).normal(10, 2, (360, 640)).astype(np.uint8)
    dark = build_edge_pyramid(grey, LENS.fx_px)
    found = estimate([views[0], *[replace(view, pyramid=dark) for view in views]])
    assert found.state == "usable" and found.chi2(TRUTH) < 16.81


def test_estimate_mirrored_images_is_not_usable(views):
    def mirrored(view):
        levels = [
            tuple(replace(layer, values=layer.values[:, ::-1] * np.float32([1, -1, 1])) for layer in pair)
            for pair in view.pyramid.levels
        ]
        return replace(view, pyramid=EdgePyramid(levels))

    found = estimate([mirrored(view) for view in views])
    assert found.state != "usable"


def test_estimate_no_edges_is_few_edges(views):
    empty = replace(views[0], outlines=views[0].outlines.select(np.zeros(len(views[0].outlines), dtype=bool)))
    found = estimate([empty])
    assert found.state == "few_edges"
    assert len(found.undetermined) == 6


def test_estimate_upright_edges_leave_pitch_wide(views, found):
    upright = [replace(v, outlines=v.outlines.select(v.outlines.kind == UPRIGHT)) for v in views]
    assert estimate(upright).cov[3, 3] > found.cov[3, 3]


def test_changes_beyond_the_smallest_exceed_chi2(found):
    turn_deg, shift_m = found.smallest_changes(COV)
    for axis in range(6):
        step = (np.radians(turn_deg) if axis > 2 else shift_m) * np.eye(6)[axis]
        assert found.chi2(perturb(found.T_cam_lidar, step), COV) > 16.81


def test_score_slope_is_difference_quotient(views):
    score = OutlineScore(views, LENS, TRUTH, 0)
    tangent = np.array([0.02, -0.03, 0.01, 0.02, -0.01, 0.015])
    _, slope = score.score(tangent)
    step = 1e-3
    numeric = [
        (score.score(tangent + step * axis)[0] - score.score(tangent - step * axis)[0]) / (2 * step)
        for axis in np.eye(6)
    ]
    np.testing.assert_allclose(slope, numeric, atol=0.1 * np.abs(numeric).max())


def panel_before_wall(beam):
    """A panel of 1 m at 4 m before a wall at 8 m, scanned in steps of 0.2 deg."""
    azimuth, elevation = np.meshgrid(*[np.radians(np.arange(-15, 15, 0.2))] * 2)
    rays = np.stack([np.ones_like(azimuth), np.tan(azimuth), np.tan(elevation) / np.cos(azimuth)], axis=-1)
    is_panel = np.all(np.abs(rays[..., 1:] * 4) < 0.5, axis=-1)
    points = np.where(is_panel, 4.0, 8.0)[..., None] * rays
    return find_outlines(points.reshape(-1, 3), np.ones(points.size // 3), beam)


def test_outlines_of_panel_lie_on_its_border():
    found = panel_before_wall(Beam(0.0, 0.0))
    for kind, axis in ((UPRIGHT, 1), (LEVEL, 2)):
        border = np.abs(found.points[found.kind == kind, axis])
        assert len(border) > 100
        assert np.median(border) == pytest.approx(0.5, abs=0.008)
    assert np.linalg.norm(found.points, axis=1).max() < 5.0


def test_outlines_of_wide_beam_lie_within_last_return():
    narrow, wide = panel_before_wall(Beam(0.0, 0.0)), panel_before_wall(Beam(0.0, 0.003))
    shrunk = np.median(np.abs(narrow.points[narrow.kind == UPRIGHT, 1])) - np.median(
        np.abs(wide.points[wide.kind == UPRIGHT, 1])
    )
    assert shrunk == pytest.approx(0.006, abs=0.002)


def test_outlines_of_few_points_are_none():
    assert len(find_outlines(np.ones((5, 3)), np.ones(5), Beam())) == 0


@pytest.mark.parametrize(("scale", "sign"), [(0.98, 1), (1.0, 0), (1.02, -1)])
def test_better_focal_finds_wrong_lens(views, scale, sign):
    lens = replace(LENS, fx_px=scale * LENS.fx_px, fy_px=scale * LENS.fy_px)
    found = estimate_scene(views, lens, TRUTH)
    assert np.sign(find_better_focal(views, lens, found.T_cam_lidar) or 0) == sign


@pytest.mark.parametrize("change", [(0, 0, 6, 0), *further([(0, 0, 0, -6), (4, 4, 0, 0)])])
def test_follow_lens_predicts_other_estimate(views, found, change):
    change = np.array([*change, 0, 0, 0, 0], dtype=np.float64)
    lens = MODELS["radtan4"].intrinsics(VECTOR + change, 640, 360)
    other = estimate_scene(views, lens, TRUTH)
    moved = difference(other.T_cam_lidar, found.T_cam_lidar)
    (foretold,) = follow_lens(views, LENS, found.T_cam_lidar, change[:, None]).T
    far = [1, 1, 1, 5, 5, 5] * (moved - foretold)
    assert np.linalg.norm(far) < 0.3 * np.linalg.norm([1, 1, 1, 5, 5, 5] * moved)


def test_follow_lens_turns_by_principal_point(views):
    changes = np.eye(8)[:, 2:4]
    moved = follow_lens(views, LENS, TRUTH, changes)[3:] + turn_of_lens(LENS) @ changes
    assert np.linalg.norm(moved, axis=0).max() < 0.3 / LENS.fx_px
