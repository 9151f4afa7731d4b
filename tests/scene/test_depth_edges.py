"""Outlines of near objects and changes of reflectivity, found at their true azimuth and height."""

import numpy as np
import pytest

from lce_rig.core.data import NO_RING, Scan
from lce_rig.detect.lidar.measurement import Beam
from lce_rig.scene.depth_edges import CHANNELS, DepthEdges, find_depth_edges, leave_standing

NEEDLE = Beam(0.0, 0.0)
STEP = np.radians(0.2)
AZIMUTHS = np.arange(-0.6, 0.6, STEP)


def scan_of(range_at, elevations_deg, intensity_at=None):
    """Measure a scene given as range, and intensity, over (azimuth, elevation), rad."""
    az, el = np.meshgrid(AZIMUTHS, np.radians(elevations_deg))
    r = range_at(az, el)
    points = np.stack([np.cos(el) * np.cos(az), np.cos(el) * np.sin(az), np.sin(el)], axis=-1) * r[..., None]
    ring = np.broadcast_to(np.arange(len(elevations_deg))[:, None], az.shape)
    flat = points.reshape(-1, 3).astype(np.float32)
    intensity = np.zeros(len(flat)) if intensity_at is None else intensity_at(az, el).ravel()
    return Scan("lidar", 0, flat, intensity.astype(np.float32), ring.ravel().astype(np.int16))


def pillar(az, el):
    return np.where(np.abs(az) < 0.1, 3.0, 6.0)


def scattered(range_at, intensity_at=None, n=60_000):
    """Measure a scene with beams in random directions, about 0.2 deg apart, and no rings."""
    rng = np.random.default_rng(0)
    az, el = rng.uniform(-0.6, 0.6, n), rng.uniform(-0.35, 0.25, n)
    r = range_at(az, el) + rng.normal(0, 0.01, n)
    points = np.stack([np.cos(el) * np.cos(az), np.cos(el) * np.sin(az), np.sin(el)], axis=-1) * r[:, None]
    intensity = np.zeros(n) if intensity_at is None else intensity_at(az, el)
    none = np.full(n, NO_RING, dtype=np.int16)
    return Scan("lidar", 0, points.astype(np.float32), intensity.astype(np.float32), none)


def azimuth_of(edges):
    return np.arctan2(edges.points[:, 1], edges.points[:, 0])


def test_without_rings_outlines_lie_between_the_last_return_and_the_next():
    def leaning(az, el):
        return np.where(np.abs(az - el / 3) < 0.1, 3.0, 6.0)

    edges = find_depth_edges(scattered(leaning), NEEDLE)
    elevation = np.arcsin(edges.points[:, 2] / np.linalg.norm(edges.points, axis=1))
    from_outline = np.abs(azimuth_of(edges) - elevation / 3) - 0.1
    assert len(edges) > 2 * 100
    assert np.abs(from_outline.mean()) < 0.1 * STEP and np.abs(from_outline).mean() < STEP / 2
    assert np.linalg.norm(edges.points, axis=1) == pytest.approx(3.0, abs=0.06)


@pytest.mark.parametrize(
    "surface",
    [
        lambda az, el: np.minimum(1.7 / np.sin(np.maximum(-el, 0.02)), 60.0),
        lambda az, el: np.minimum(1.5 / np.sin(np.maximum(np.abs(az), 0.02)), 60.0),
        lambda az, el: np.where(el > 0, 4.0, 8.0),
        lambda az, el: np.random.default_rng(1).uniform(5.0, 9.0, len(az)),
    ],
    ids=["floor", "walls of a corridor", "upper edge", "foliage"],
)
def test_without_rings_slopes_and_clutter_have_hardly_any_outlines(surface):
    assert len(find_depth_edges(scattered(surface), NEEDLE)) < 0.01 * 60_000


def test_without_rings_changes_of_reflectivity_lie_on_the_borders_of_a_stripe():
    edges = find_depth_edges(scattered(lambda az, el: 4.0 + 0 * az, stripe), NEEDLE)
    elevation = np.arcsin(edges.points[:, 2] / 4.0)
    from_border = np.abs(azimuth_of(edges) - elevation / 2) - 0.05
    assert len(edges) > 2 * 100 and set(edges.channel) == {CHANNELS.index("reflectivity")}
    assert np.abs(from_border).max() < 2 * STEP


def test_upright_outlines_lie_between_the_last_return_and_the_next():
    edges = find_depth_edges(scan_of(pillar, range(-15, 16, 2)), NEEDLE)
    azimuth = np.arctan2(edges.points[:, 1], edges.points[:, 0])
    assert len(edges) == 2 * 16
    assert np.abs(np.abs(azimuth) - 0.1).max() < STEP / 2
    assert np.linalg.norm(edges.points, axis=1) == pytest.approx(3.0, abs=1e-3)
    assert edges.weight == pytest.approx(np.sqrt(3.0), abs=1e-3)


def test_a_floor_has_no_outlines_though_its_rings_lie_far_apart():
    floor = scan_of(lambda az, el: 1.0 / np.sin(-el) + 0 * az, np.arange(-20, -4, 0.5))
    assert len(find_depth_edges(floor, NEEDLE)) == 0


def test_a_wall_seen_at_a_grazing_angle_has_no_outline_though_its_steps_are_large():
    wall = scan_of(lambda az, el: 0.4 / np.sin(np.maximum(np.abs(az), 0.02)), [0])
    assert np.abs(np.diff(np.linalg.norm(wall.points, axis=1))).max() > 1.0
    assert len(find_depth_edges(wall, NEEDLE)) == 0


def stripe(az, el):
    """A dark stripe that leans: its middle lies at the azimuth of half the elevation."""
    return np.where(np.abs(az - el / 2) < 0.05, 10.0, 60.0)


def test_changes_of_reflectivity_lie_on_the_borders_of_a_stripe():
    edges = find_depth_edges(scan_of(lambda az, el: 4.0 + 0 * az, range(-15, 16, 2), stripe), NEEDLE)
    azimuth = np.arctan2(edges.points[:, 1], edges.points[:, 0])
    elevation = np.arcsin(edges.points[:, 2] / 4.0)
    assert len(edges) == 2 * 16 and set(edges.channel) == {CHANNELS.index("reflectivity")}
    assert np.abs(np.abs(azimuth - elevation / 2) - 0.05).max() < 0.51 * STEP


def test_reflectivity_of_other_surfaces_and_noise_are_no_changes():
    rng = np.random.default_rng(0)

    def noisy(az, el):
        return np.where(np.abs(az) < 0.1, 20.0, 60.0) + rng.normal(0, 3.0, az.shape)

    edges = find_depth_edges(scan_of(pillar, range(-15, 16, 2), noisy), NEEDLE)
    assert set(edges.channel) == {CHANNELS.index("depth")}


def test_single_returns_between_two_surfaces_are_no_outline():
    def mixed(az, el):
        return np.where(np.abs(az) < STEP / 2, 4.0, 6.0)

    assert len(find_depth_edges(scan_of(mixed, range(-15, 16, 2)), NEEDLE)) == 0


@pytest.mark.parametrize("scan", [scan_of(lambda az, el: 3.0 + az, [0]), scattered(lambda az, el: 3.0 + az)])
@pytest.mark.parametrize("n", [0, 1, 2])
def test_an_almost_empty_scan_has_no_outlines(n, scan):
    assert len(find_depth_edges(scan.select(np.arange(n)), NEEDLE)) == 0


def test_the_board_and_its_stand_move_before_a_standing_rig_and_are_left_out(seen):
    found = [view.edges for view in seen.views]
    standing = leave_standing(found)
    shares = []
    for capture, before, after in zip(seen.captures, found, standing, strict=True):
        middle = capture.T_lidar_board["lidar"][:3, 3]
        n_near, n_left = (
            np.count_nonzero(np.hypot(*(edges.points - middle)[:, :2].T) < 0.6) for edges in (before, after)
        )
        assert n_near > 15 and n_left < 0.2 * n_near
        shares.append((len(after) - n_left) / (len(before) - n_near))
    assert min(shares) > 0.8


def test_a_rig_that_moves_keeps_its_edges(seen):
    moving = [
        DepthEdges(view.edges.points + [0.4 * k, 0, 0], view.edges.weight, view.edges.channel)
        for k, view in enumerate(seen.views)
    ]
    assert list(map(len, leave_standing(moving))) == list(map(len, moving))
    assert list(map(len, leave_standing(moving[:1]))) == [len(moving[0])]
    assert leave_standing([]) == []
