"""Ordering, noise and segments of single scans."""

import numpy as np
import pytest
from scans import board_plate, cast, place, room

from lce_rig.detect.lidar.segments import order_scan


@pytest.mark.parametrize("sigma_m", [0.01, 0.03, 0.1])
def test_range_noise_is_read_off_the_scan(sigma_m):
    assert order_scan(cast(room(9.0), sigma_m=sigma_m), 0.4).sigma_m == pytest.approx(sigma_m, rel=0.1)


@pytest.mark.parametrize("step_deg", [0.1, 0.199, 0.4])
def test_azimuth_step_is_read_off_the_scan(step_deg):
    assert order_scan(cast(room(9.0), step_deg=step_deg), 0.4).step_rad == pytest.approx(
        np.radians(step_deg), rel=2e-3
    )


def test_rings_are_ordered_by_azimuth_and_begin_at_a_break():
    ordered = order_scan(cast([board_plate(place(2.5, 180)), *room(9.0)]), 0.4)
    starts = np.flatnonzero(np.diff(ordered.ring, prepend=-1))
    assert ordered.is_break[starts].all()
    turn = np.mod(np.diff(ordered.azimuth), 2 * np.pi)
    inside = np.diff(ordered.ring) == 0
    assert turn[inside].max() < np.radians(10)


def test_second_turn_of_a_long_sweep_is_dropped():
    scan = cast(room(9.0))
    twice = scan.select(np.concatenate([np.arange(len(scan.points)), np.arange(2000)]))
    assert len(order_scan(twice, 0.4).index) == len(order_scan(scan, 0.4).index)
    assert order_scan(twice, 0.4).index.max() < len(scan.points)
