"""Which picture belongs to which cloud."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from lce_rig.core.errors import SourceError
from lce_rig.io.folder.file_pairs import natural_order, pair_names, parse_times
from tests.notes import has_note

COUNTERS = [f"{k:05d}" for k in range(6)]


def test_equal_names_are_paired_whatever_their_order():
    pairing = pair_names(COUNTERS, COUNTERS[::-1])
    assert pairing.method == "stem" and pairing.pairs == tuple((k, 5 - k) for k in range(6))


def test_a_few_without_partner_are_left_out_and_said():
    pairing = pair_names([*COUNTERS, "x"], [*COUNTERS[:-1], "y"])
    assert has_note([pairing.explanation], "5 pairs", "equal file", "2 images", "1 point clouds")
    assert (pairing.lone_images, pairing.lone_clouds) == ((5, 6), (5,))


def test_of_files_with_one_name_each_has_a_partner_of_its_own_as_far_as_they_go():
    pairing = pair_names(["00000", "00000", "00001"], ["00000", "00001", "00001"], "stem")
    assert pairing.pairs == ((0, 0), (1, 0), (2, 1))
    assert (pairing.lone_images, pairing.lone_clouds) == ((), (2,))
    twice = pair_names(sorted(COUNTERS * 2), sorted(COUNTERS * 2))
    assert twice.pairs == tuple((k, k) for k in range(12)) and not twice.lone_clouds


def test_names_that_are_times_within_the_tolerance_are_paired_by_time():
    images, clouds = (
        ["10.000000", "11.000000", "12.000000"],
        ["9.990000", "11.020000", "12.010000", "13.000000"],
    )
    pairing = pair_names(images, clouds)
    assert pairing.method == "time" and pairing.pairs == ((0, 0), (1, 1), (2, 2))
    assert pairing.lone_clouds == (3,)


def test_times_too_far_apart_fall_back_to_sorted_order_and_say_how_far():
    images, clouds = (
        ["2311.422000", "2376.322000", "2415.224000"],
        ["2311.405000", "2376.205000", "2415.106000"],
    )
    pairing = pair_names(images, clouds)
    assert pairing.method == "order" and pairing.pairs == ((0, 0), (1, 1), (2, 2))
    assert "0.118 s" in pairing.explanation


def test_different_counters_of_equal_number_are_paired_in_order():
    assert pair_names(["a1", "a2", "a10"], ["b3", "b4", "b5"]).method == "order"


def test_nothing_is_paired_by_guesswork():
    with pytest.raises(SourceError):
        pair_names(["a1", "a2", "a3"], ["b1", "b2"])
    with pytest.raises(SourceError, match="3 and 2"):
        pair_names(["a1", "a2", "a3"], ["b1", "b2"], "order")
    with pytest.raises(SourceError):
        pair_names(["a1"], ["b1"], "stem")
    with pytest.raises(SourceError, match="not times"):
        pair_names(["a1"], ["b1"], "time")
    with pytest.raises(SourceError):
        pair_names(["1.5"], ["9.5"], "time")


def test_explicit_methods_are_obeyed():
    assert pair_names(COUNTERS, COUNTERS[::-1], "order").pairs == tuple((k, k) for k in range(6))
    assert pair_names(["1.0", "2.0"], ["2.4", "1.4"], "time", 0.5).pairs == ((0, 1), (1, 0))


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
    assert len(pairing.pairs) + len(pairing.lone_images) == len(left)


def test_names_beyond_any_time_are_no_times():
    assert parse_times(["9999999999999999999"]) is None
    assert parse_times(["9999999999.5"]) is None
