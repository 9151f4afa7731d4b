"""A computer that simulates slower than real time is named as the cause, with the factor."""

import pytest

from lce_rig.collect.live.simulated import LEAST_S, SimulatedPace


class Clock:
    def __init__(self) -> None:
        self.s = 100.0

    def __call__(self) -> float:
        return self.s


def run(pace: SimulatedPace, clock: Clock, turn_s: float, length_s: float) -> None:
    until_s = clock.s + length_s
    while clock.s < until_s:
        clock.s += turn_s
        pace.turn()


@pytest.mark.parametrize("turn_s", [0.1, 0.15])
def test_a_simulation_that_keeps_up_has_no_problem(turn_s: float) -> None:
    clock = Clock()
    pace = SimulatedPace(0.1, clock)
    pace.begin()
    run(pace, clock, turn_s, 20.0)
    assert pace.slowness == pytest.approx(turn_s / 0.1, rel=0.02) and pace.problem() is None


@pytest.mark.parametrize(("turn_s", "factor"), [(0.32, 3), (0.7, 5), (2.0, 10)])
def test_one_that_does_not_keep_up_is_said_with_its_factor(turn_s: float, factor: int) -> None:
    clock = Clock()
    pace = SimulatedPace(0.1, clock)
    pace.begin()
    run(pace, clock, turn_s, 30.0)
    found = pace.problem()
    assert found is not None and found.figures == {"factor": factor, "is_more": False}


def test_one_that_stands_still_is_noticed_without_a_turn_and_forgotten_when_it_goes_on() -> None:
    clock = Clock()
    pace = SimulatedPace(0.1, clock)
    assert pace.problem() is None, "it has not begun"
    pace.begin()
    clock.s += LEAST_S / 2
    assert pace.problem() is None, "it has only begun"
    clock.s += 20.0
    found = pace.problem()
    assert found is not None and found.figures == {"factor": 50, "is_more": True}
    run(pace, clock, 0.1, 11.0)
    assert pace.problem() is None
