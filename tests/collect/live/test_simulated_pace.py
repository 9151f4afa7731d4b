"""A computer that simulates slower than real time is named as the cause, with the factor."""

import pytest

from lce_rig.collect.live.simulated import LEAST_S, SimulatedPace


@pytest.mark.parametrize(("turn_s", "factor"), [(0.1, None), (0.15, None), (0.32, 3), (0.7, 7), (2.0, 20)])
def test_a_simulation_slower_than_half_real_time_is_reported_by_its_factor(
    turn_s: float, factor: int | None
) -> None:
    now_s = 100.0
    pace = SimulatedPace(0.1, lambda: now_s)
    assert pace.problem() is None, "it has not begun"
    pace.begin()
    now_s += LEAST_S / 2
    assert pace.problem() is None, "it has only begun"
    now_s = 100.0
    for _ in range(300):
        now_s += turn_s
        pace.turn()
    problem = pace.problem()
    assert problem is None if factor is None else problem is not None and problem.figures["factor"] == factor
