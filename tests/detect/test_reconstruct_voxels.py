"""Voxel grids, event maps and noise filters."""

import time

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from moving_board import Motion, board_events, events_of

from lce_rig.detect.events.reconstruct import event_map, normalise_voxels, voxel_grid
from lce_rig.detect.events.reconstruct.filters import hot_pixels, without_background_activity, without_pixels


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
def test_the_grid_equals_the_sum_over_events_of_its_definition(n, seed, n_bins):
    events = random_events(n, seed)
    start, end = -3_000_000, 61_000_000
    expected = np.zeros((n_bins, events.height_px, events.width_px))
    for t, x, y, polarity in zip(events.t_ns, events.x, events.y, events.polarity, strict=True):
        position = (n_bins - 1) * (t - start) / (end - start)
        for b in range(n_bins):
            expected[b, y, x] += (1 if polarity else -1) * max(0.0, 1 - abs(b - position))
    np.testing.assert_allclose(voxel_grid(events, n_bins, start, end), expected, atol=1e-5)


def test_the_first_and_the_last_event_fall_into_the_outer_bins_where_no_bounds_are_given():
    grid = voxel_grid(events_of([100, 300], [0, 1], [0, 0], [True, False], 2, 1))
    np.testing.assert_array_equal(grid[:, 0, :], [[1, 0], [0, 0], [0, 0], [0, 0], [0, -1]])


def test_a_single_event_and_none_at_all_make_a_grid():
    assert voxel_grid(events_of([5], [1], [1], [True], 4, 4)).sum() == 1
    assert not voxel_grid(events_of([], [], [], [], 4, 4)).any()


def test_normalised_grids_have_mean_0_and_deviation_1_over_what_was_hit():
    grid = voxel_grid(random_events(200, 1))
    is_hit = grid != 0
    normalised = normalise_voxels(grid.copy())
    assert normalised[is_hit].mean() == pytest.approx(0, abs=1e-5)
    assert normalised[is_hit].std() == pytest.approx(1, abs=1e-5)
    assert not normalised[~is_hit].any()
    assert not normalise_voxels(np.zeros((5, 3, 4), np.float32)).any()


def test_an_event_map_holds_each_pixels_polarity_sum():
    summed = event_map(events_of([1, 2, 3, 4], [0, 0, 0, 1], [1, 1, 1, 0], [1, 1, 0, 0], 2, 2))
    np.testing.assert_array_equal(summed, [[0, -1], [1, 0]])


def test_a_grid_of_200_000_events_takes_less_than_10_ms():
    events = random_events(200_000, 2, 346, 260)
    spent = []
    for _ in range(5):
        begun = time.process_time()
        voxel_grid(events)
        spent.append(time.process_time() - begun)
    assert min(spent) < 0.010


def test_a_hot_pixel_is_told_from_an_edge():
    rng = np.random.default_rng(3)
    counts = rng.poisson(2, (40, 50)).astype(np.uint16)
    counts[:, 20:23] += 60  # an edge that went to and fro
    counts[10, 40] = counts[10, 41] = 900
    is_hot = hot_pixels(counts)
    assert sorted(zip(*np.nonzero(is_hot), strict=True)) == [(10, 40), (10, 41)]


def test_marked_pixels_fall_silent_and_others_do_not():
    events = random_events(500, 4)
    is_bad = np.zeros((events.height_px, events.width_px), bool)
    is_bad[4, 5] = True
    kept = without_pixels(events, is_bad)
    of_bad = (events.x == 5) & (events.y == 4)
    assert 0 < of_bad.sum() == len(events) - len(kept)
    assert without_pixels(events, np.zeros_like(is_bad)) is events


def test_lone_events_are_dropped_and_accompanied_ones_stay():
    events = events_of([0, 1_000_000, 2_000_000, 50_000_000], [5, 6, 30, 6], [5, 5, 30, 6], [1] * 4, 40, 40)
    kept = without_background_activity(events)
    np.testing.assert_array_equal(kept.t_ns, [0, 1_000_000])


def test_most_noise_goes_and_nearly_all_events_of_the_board_stay():
    board = board_events(Motion(), 0.3, noise_hz=0.0)
    noise_only = random_events(300, 5, 160, 120, 300_000_000)
    assert len(without_background_activity(board)) > 0.98 * len(board)
    assert len(without_background_activity(noise_only)) < 0.25 * len(noise_only)
