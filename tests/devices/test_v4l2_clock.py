"""Which clock stamps: on stamps made with each of this computer's clocks, and on Jetson's arithmetic."""

import time

import pytest

from lce_rig.devices.stamp_clock import CLOCKS, StampClock, choose_clock, read_clocks

MS = 1_000_000
# As read on a rig: UTC, time since boot with a night of suspend, and Jetson's counter 29 s ahead of raw time.
NOW = {
    "monotonic": 8_000_000 * MS,
    "monotonic_raw": 8_000_450 * MS,
    "tsc": 8_029_450 * MS,
    "tsc_minus": 7_971_450 * MS,
    "boottime": 36_000_000 * MS,
    "realtime": 1_763_733_600_000 * MS,
}


@pytest.mark.parametrize("clock", CLOCKS)
@pytest.mark.parametrize("age_ms", [0, 12, 199])
def test_the_clock_of_the_stamps_is_found(clock: str, age_ms: int) -> None:
    choice = choose_clock(NOW[clock] - age_ms * MS, NOW)
    assert choice.clock == clock
    assert not choice.is_ambiguous
    assert choice.delays_ns[clock] == age_ms * MS


@pytest.mark.parametrize("age_ms", [-1, 201, 5000, -29_000])
def test_stamps_from_the_future_or_too_old_fit_no_clock(age_ms: int) -> None:
    assert choose_clock(NOW["monotonic"] - age_ms * MS, NOW).clock is None


def test_clocks_that_hardly_differ_are_no_doubt() -> None:
    now = NOW | {"monotonic_raw": NOW["monotonic"] + 1 * MS, "boottime": NOW["monotonic"]}
    choice = choose_clock(NOW["monotonic"] - 20 * MS, now)
    assert choice.clock == "monotonic"
    assert not choice.is_ambiguous


def test_clocks_that_both_fit_and_differ_are_said_to() -> None:
    now = NOW | {"monotonic_raw": NOW["monotonic"] + 40 * MS}
    choice = choose_clock(NOW["monotonic"] - 20 * MS, now)
    assert choice.is_ambiguous
    assert choice.spread_ns == 40 * MS


@pytest.mark.parametrize("clock", ["monotonic", "realtime"])
def test_a_stamp_of_this_computers_clock_becomes_utc(clock: str) -> None:
    before_ns, stamp_ns, after_ns = time.time_ns(), read_clocks()[clock], time.time_ns()
    stamps = StampClock()
    utc_ns = stamps.to_utc_ns(stamp_ns)
    assert utc_ns is not None
    # The clocks are read one after the other: 50 us cover what that takes on a busy computer.
    assert before_ns - 50_000 <= utc_ns <= after_ns + 50_000
    assert stamps.problems() == []


def test_stamps_that_fit_no_clock_give_none_and_a_problem() -> None:
    stamps = StampClock()
    assert stamps.to_utc_ns(read_clocks()["monotonic"] + 3600 * 1000 * MS) is None
    (problem,) = stamps.problems()
    assert problem.code == "clock.none_fits"
    delays_ms = dict(problem.figures["delays_ms"])  # type: ignore[arg-type]
    assert delays_ms["monotonic"] == pytest.approx(-3.6e6, rel=1e-3)


def test_a_late_look_does_not_shake_a_known_clock() -> None:
    stamps = StampClock()
    assert stamps.to_utc_ns(read_clocks()["monotonic"]) is not None
    assert stamps.to_utc_ns(read_clocks()["monotonic"] - 1500 * MS) is not None
    assert stamps.clock == "monotonic"
    assert stamps.n_changes == 0


def test_stamps_that_leave_their_clock_are_said_to() -> None:
    stamps = StampClock()
    stamps.to_utc_ns(read_clocks()["monotonic"])
    stamps.to_utc_ns(read_clocks()["realtime"])
    assert stamps.clock == "realtime"
    assert [(found.code, found.figures["n"]) for found in stamps.problems()] == [("clock.changed", 1)]


def test_a_clock_set_by_hand_is_kept_and_judged() -> None:
    stamps = StampClock("realtime")
    utc_ns = stamps.to_utc_ns(read_clocks()["monotonic"])
    assert utc_ns is not None
    assert utc_ns < time.time_ns() - 10**15
    (found,) = stamps.problems()
    assert (found.code, found.figures["clock"]) == ("clock.does_not_fit", "realtime")


@pytest.mark.skipif("tsc" in read_clocks(), reason="this computer tells the offset of its counter")
def test_a_clock_that_this_computer_lacks_is_said() -> None:
    stamps = StampClock("tsc")
    assert stamps.to_utc_ns(read_clocks()["monotonic"]) is None
    assert stamps.used is None
    (found,) = stamps.problems()
    assert (found.code, found.figures["clock"]) == ("clock.missing", "tsc")
