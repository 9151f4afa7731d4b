"""Ordering, noise and segments of single scans."""

import numpy as np
import pytest
from scans import board_plate, cast, place, room

from lce_rig.core.data import Scan
from lce_rig.detect.lidar.segments import cut_segments, order_scan


@pytest.mark.parametrize("sigma_m", [0.01, 0.03, 0.1])
def test_range_noise_is_read_off_the_scan(sigma_m):
    assert order_scan(cast(room(9.0), sigma_m=sigma_m), 0.4).sigma_m == pytest.approx(sigma_m, rel=0.1)


@pytest.mark.parametrize("step_deg", [0.1, 0.199, 0.4])
def test_azimuth_step_is_read_off_the_scan(step_deg):
    assert order_scan(cast(room(9.0), step_deg=step_deg), 0.4).step_rad == pytest.approx(
        np.radians(step_deg), rel=2e-3
    )


def test_a_few_returns_whose_steps_have_nothing_in_common_still_have_a_step():
    azimuth = np.radians([0.0, 0.2, 2.4])
    points = 3.0 * np.stack([np.cos(azimuth), np.sin(azimuth), np.zeros(3)], axis=1).astype(np.float32)
    scan = Scan("lidar", 0, points, np.ones(3, np.float32), np.zeros(3, np.int16))
    assert np.radians(0.2) < order_scan(scan, 0.4).step_rad < np.radians(2.2)


def test_rings_are_ordered_by_azimuth_and_begin_at_a_break():
    ordered = order_scan(cast([board_plate(place(2.5, 180)), *room(9.0)]), 0.4)
    starts = np.flatnonzero(np.diff(ordered.ring, prepend=-1))
    assert ordered.is_break[starts].all()
    turn = np.mod(np.diff(ordered.azimuth), 2 * np.pi)
    inside = np.diff(ordered.ring) == 0
    assert turn[inside].max() < np.radians(10)


def test_board_behind_the_lidar_is_one_segment_a_ring():
    T = place(2.5, 180)
    ordered = order_scan(cast([board_plate(T), *room(13.0)], sigma_m=0.005), 0.4)
    segments = cut_segments(ordered, 6.0)
    on_board = np.abs(segments.centre @ T[:3, 2] - T[:3, 3] @ T[:3, 2]) < 0.02
    on_board &= np.linalg.norm(segments.centre - T[:3, 3], axis=1) < 0.5
    assert len(np.unique(segments.ring[on_board])) == on_board.sum() >= 10


def test_second_turn_of_a_long_sweep_is_dropped():
    scan = cast(room(9.0))
    twice = scan.select(np.concatenate([np.arange(len(scan.points)), np.arange(2000)]))
    assert len(order_scan(twice, 0.4).index) == len(order_scan(scan, 0.4).index)
    assert order_scan(twice, 0.4).index.max() < len(scan.points)
