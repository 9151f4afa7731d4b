"""Which picture belongs to which cloud."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from lce_rig.core.errors import SourceError
from lce_rig.io.folder.folder import natural_order, pair_names, parse_times

COUNTERS = [f"{k:05d}" for k in range(6)]


def test_equal_names_are_paired_whatever_their_order():
    pairing = pair_names(COUNTERS, COUNTERS[::-1])
    assert pairing.method == "stem" and pairing.pairs == [(k, 5 - k) for k in range(6)]


def test_a_few_without_partner_are_left_out():
    assert pair_names([*COUNTERS, "x"], [*COUNTERS[:-1], "y"]).pairs == [(k, k) for k in range(5)]


def test_images_of_one_name_share_its_cloud():
    assert pair_names(["00000", "00000", "00001"], ["00000", "00001"]).pairs == [(0, 0), (1, 0), (2, 1)]


def test_names_that_are_times_within_the_tolerance_are_paired_by_time():
    images, clouds = (
        ["10.000000", "11.000000", "12.000000"],
        ["9.990000", "11.020000", "12.010000", "13.000000"],
    )
    pairing = pair_names(images, clouds)
    assert pairing.method == "time" and pairing.pairs == [(0, 0), (1, 1), (2, 2)]


def test_times_too_far_apart_fall_back_to_sorted_order_and_say_how_far():
    images, clouds = (
        ["2311.422000", "2376.322000", "2415.224000"],
        ["2311.405000", "2376.205000", "2415.106000"],
    )
    pairing = pair_names(images, clouds)
    assert pairing.method == "order" and pairing.pairs == [(0, 0), (1, 1), (2, 2)]
    assert "0.118 s" in pairing.reason


def test_different_counters_of_equal_number_are_paired_in_order():
    assert pair_names(["a1", "a2", "a10"], ["b3", "b4", "b5"]).method == "order"


def test_nothing_is_paired_by_guesswork():
    with pytest.raises(SourceError):
        pair_names(["a1", "a2", "a3"], ["b1", "b2"])
    with pytest.raises(SourceError):
        pair_names(["a1", "a2", "a3"], ["b1", "b2"], "order")
    with pytest.raises(SourceError):
        pair_names(["a1"], ["b1"], "stem")
    with pytest.raises(SourceError):
        pair_names(["a1"], ["b1"], "time")
    with pytest.raises(SourceError):
        pair_names(["1.5"], ["9.5"], "time")


def test_explicit_methods_are_obeyed():
    assert pair_names(COUNTERS, COUNTERS[::-1], "order").pairs == [(k, k) for k in range(6)]
    assert pair_names(["1.0", "2.0"], ["2.4", "1.4"], "time", 0.5).pairs == [(0, 1), (1, 0)]


def test_only_names_that_are_times_are_taken_for_times():
    assert parse_times(["2311.422000"]).tolist() == [2311_422_000_000]
    assert parse_times(["1700000000123456789"]).tolist() == [1_700_000_000_123_456_789]
    assert parse_times(["1700000000123456"]).tolist() == [1_700_000_000_123_456_000]
    assert parse_times(["00012", "00013"]) is None and parse_times([]) is None
    assert parse_times(["1.5", "cover"]) is None


def test_numbers_in_names_are_ordered_as_numbers():
    assert sorted(["s10", "s9", "s1", "a"], key=natural_order) == ["a", "s1", "s9", "s10"]


@given(
    st.lists(st.integers(0, 30), unique=True), st.lists(st.integers(0, 30), unique=True), st.floats(0.01, 9)
)
def test_pairs_by_time_are_one_to_one_and_within_the_tolerance(left, right, tolerance_s):
    images, clouds = [f"{v}.0" for v in left], [f"{v}.25" for v in right]
    try:
        pairing = pair_names(images, clouds, "time", tolerance_s)
    except SourceError:
        return
    assert len({i for i, _ in pairing.pairs}) == len({j for _, j in pairing.pairs}) == len(pairing.pairs)
    assert all(abs(left[i] - right[j] - 0.25) <= tolerance_s for i, j in pairing.pairs)


def test_names_beyond_any_time_are_no_times():
    assert parse_times(["9999999999999999999"]) is None
    assert parse_times(["9999999999.5"]) is None
