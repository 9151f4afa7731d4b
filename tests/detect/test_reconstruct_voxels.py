"""Voxel grids, event maps, noise filters, and lamps that flicker."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from moving_board import Motion, board_events, events_of, join, lamps, noise

from lce_rig.core.data import join_events
from lce_rig.detect.events.windows import (
    hot_pixels,
    is_flickering,
    normalise_voxels,
    voxel_grid,
    without_background_activity,
)
from lce_rig.io.events import open_events


def random_events(n, seed, width_px=12, height_px=9, duration_ns=50_000_000):
    rng = np.random.default_rng(seed)
    return events_of(
        rng.integers(0, duration_ns, n),
        rng.integers(0, width_px, n),
        rng.integers(0, height_px, n),
        rng.random(n) < 0.5,
        width_px,
        height_px,
    )


@given(st.integers(0, 60), st.integers(0, 10_000), st.integers(2, 7))
def test_voxel_grid_matches_its_definition(n, seed, n_bins):
    events = random_events(n, seed)
    start, end = -3_000_000, 61_000_000
    expected = np.zeros((n_bins, events.height_px, events.width_px))
    for t, x, y, polarity in zip(events.t_ns, events.x, events.y, events.polarity, strict=True):
        position = (n_bins - 1) * (t - start) / (end - start)
        for b in range(n_bins):
            expected[b, y, x] += (1 if polarity else -1) * max(0.0, 1 - abs(b - position))
    np.testing.assert_allclose(voxel_grid(events, n_bins, start, end), expected, atol=1e-5)


def test_voxels_normalised_have_unit_scatter():
    """Mean 0 and standard deviation 1 over the cells with events."""
    grid = voxel_grid(random_events(200, 1), 5, 0, 50_000_000)
    is_hit = grid != 0
    normalised = normalise_voxels(grid.copy())
    assert normalised[is_hit].mean() == pytest.approx(0, abs=1e-5)
    assert normalised[is_hit].std() == pytest.approx(1, abs=1e-5)
    assert not normalised[~is_hit].any()
    assert not normalise_voxels(np.zeros((5, 3, 4), np.float32)).any()


def test_hot_pixel_is_distinguished_from_edge():
    rng = np.random.default_rng(3)
    counts = rng.poisson(2, (40, 50))
    counts[:, 20:23] += 60  # an edge that went to and fro
    counts[10, 40] = counts[10, 41] = 900
    is_hot = hot_pixels(counts)
    assert sorted(zip(*np.nonzero(is_hot), strict=True)) == [(10, 40), (10, 41)]


def test_noise_filter_keeps_board_events():
    board = board_events(Motion(), 0.3, noise_hz=0.0)
    noise_only = random_events(300, 5, 160, 120, 300_000_000)
    assert len(without_background_activity(board)) > 0.98 * len(board)
    assert len(without_background_activity(noise_only)) < 0.25 * len(noise_only)


def test_flicker_is_distinguished_from_motion():
    assert is_flickering(lamps(100))
    board = board_events(Motion(), 1.0)
    for scene in (board, noise(5.0), join(board, noise(1.0))):
        assert not is_flickering(scene)


def test_events_of_one_polarity_count_as_flicker():
    scene = noise(5.0)
    assert is_flickering(replace(scene, polarity=np.ones(len(scene), bool)))
    sparse = noise(0.02)
    assert not is_flickering(sparse)


@pytest.mark.dataset
@pytest.mark.parametrize(
    ("name", "is_storm"), [("event_packet_ros1.bag", True), ("davis346_apriltag_libcaer_cmp.mcap", False)]
)
def test_flicker_of_mains_light_is_detected(recordings, name, is_storm):
    if not (recordings / "events").is_dir():
        pytest.skip("no recordings of events")
    recording = open_events(recordings / "events" / name)
    assert is_flickering(join_events(list(recording))) == is_storm
