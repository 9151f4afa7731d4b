"""The clock of an event camera, fitted by the edges it saw of the board's pulses."""

import numpy as np
import pytest

from lce_rig.core.data import Pulse
from lce_rig.timing.clock import ClockModel
from lce_rig.timing.rig_clock import EdgeClock

MS, S = 1_000_000, 1_000_000_000
HOST_NS = 1_753_000_000 * S


def coarse(error_ms):
    """From the camera's Unix time to the board's, as the computer knows it when the camera is opened."""
    return ClockModel(HOST_NS, 77 * S + round(error_ms * MS), 0.0, np.zeros((2, 2)), 0, 0, 0, 0, 0, 0, "host")


def run(
    seed=0, period_s=0.05, n=400, error_ms=3.0, drift=60e-6, lost=0.0, unseen=0.0, bounces=0.0, bound_ms=15
):
    rng = np.random.default_rng(seed)
    clock = EdgeClock("davis", bound_ms * MS)
    clock.set_clock(coarse(error_ms))
    for k in range(n):
        true_ns = round(k * period_s * S)
        if rng.uniform() >= lost:
            clock.take_sent(Pulse("davis", 77 * S + true_ns // 1000 * 1000, k, 0))
        if rng.uniform() >= unseen:
            seen_ns = HOST_NS + round(true_ns * (1 + drift) + rng.uniform(0, 2000)) // 1000 * 1000
            clock.take_seen(Pulse("davis", seen_ns, k, 0))
            if rng.uniform() < bounces:
                clock.take_seen(Pulse("davis", seen_ns + 4000, k, 0))
        if k % 50 == 49:
            clock.fit()
    return clock, clock.fit()


@pytest.mark.parametrize("faults", [{}, {"lost": 0.2, "unseen": 0.2, "bounces": 0.1}, {"error_ms": -12.0}])
def test_edges_tie_the_camera_to_the_board_within_microseconds(faults):
    for seed in range(5):
        clock, model = run(seed, **faults)
        assert clock.problem is None
        assert model.drift == pytest.approx(-60e-6, abs=0.1e-6)
        true_ns = 10 * S
        error_ns = model.convert(HOST_NS + round(true_ns * 1.00006)) - 77 * S - true_ns
        assert abs(error_ns) < 2000


def test_pulses_too_quick_for_a_coarse_clock_are_refused_with_what_to_do():
    clock, model = run(bound_ms=30)
    assert model is None
    assert clock.problem.code == "edges.too_close"
    assert clock.problem.figures == {"sigma_ms": 30, "period_ms": 50}


def test_edges_of_something_else_are_refused():
    rng = np.random.default_rng(0)
    clock = EdgeClock("davis", 5 * MS)
    clock.set_clock(coarse(0))
    for k in range(200):
        clock.take_sent(Pulse("davis", 77 * S + k * 50 * MS, k, 0))
    for k, time in enumerate(np.sort(rng.uniform(0, 10, 200))):
        clock.take_seen(Pulse("davis", HOST_NS + round(time * S), k, 0))
    assert clock.fit() is None
    assert clock.problem.code == "edges.not_the_pulses"


def test_a_board_that_begins_anew_is_fitted_anew():
    clock, _ = run(n=100)
    for k in range(100):
        clock.take_sent(Pulse("davis", k * 50 * MS, k, 0))
    assert clock.fit() is None
    clock.set_clock(ClockModel(HOST_NS, 0, 0.0, np.zeros((2, 2)), 0, 0, 0, 0, 0, 0, "host"))
    for k in range(100):
        clock.take_seen(Pulse("davis", HOST_NS + k * 50 * MS, k, 0))
    assert abs(clock.fit().drift) < 1e-7
