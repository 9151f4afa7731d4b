"""A computer that simulates slower than real time is named as the cause, with the factor."""

import pytest

from lce_rig.collect.live.simulated_pace import LEAST_S, SimulatedPace


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
    assert pace.slowness == pytest.approx(turn_s / 0.1, rel=0.02) and pace.problem() == ""


@pytest.mark.parametrize(
    ("turn_s", "said"), [(0.32, "about 3 times"), (0.7, "about 5 times"), (2.0, "about 10 times")]
)
def test_one_that_does_not_keep_up_is_said_with_its_factor(turn_s: float, said: str) -> None:
    clock = Clock()
    pace = SimulatedPace(0.1, clock)
    pace.begin()
    run(pace, clock, turn_s, 30.0)
    assert said in pace.problem() and "no sensor is at fault" in pace.problem()


def test_one_that_stands_still_is_noticed_without_a_turn_and_forgotten_when_it_goes_on() -> None:
    clock = Clock()
    pace = SimulatedPace(0.1, clock)
    assert pace.problem() == "", "it has not begun"
    pace.begin()
    clock.s += LEAST_S / 2
    assert pace.problem() == "", "it has only begun"
    clock.s += 20.0
    assert "more than 50 times" in pace.problem()
    run(pace, clock, 0.1, 11.0)
    assert pace.problem() == ""
