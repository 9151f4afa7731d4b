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


@pytest.mark.parametrize(
    ("images", "clouds", "method", "pairs"),
    [
        ([*COUNTERS, "x"], [*COUNTERS[:-1], "y"], "stem", [(k, k) for k in range(5)]),
        (["00000", "00000", "00001"], ["00000", "00001"], "stem", [(0, 0), (1, 0), (2, 1)]),
        (["10.000000", "11.000000"], ["9.990000", "11.020000", "13.000000"], "time", [(0, 0), (1, 1)]),
        (["2311.422000", "2376.322000"], ["2311.405000", "2376.205000"], "order", [(0, 0), (1, 1)]),
        (["a1", "a2", "a10"], ["b3", "b4", "b5"], "order", [(0, 0), (1, 1), (2, 2)]),
    ],
)
def test_names_are_paired_by_the_first_method_that_fits(images, clouds, method, pairs):
    pairing = pair_names(images, clouds)
    assert (pairing.method, pairing.pairs) == (method, pairs)


@pytest.mark.parametrize(
    ("images", "clouds", "method"),
    [
        (["a1", "a2", "a3"], ["b1", "b2"], "auto"),
        (["a1", "a2", "a3"], ["b1", "b2"], "order"),
        (["a1"], ["b1"], "stem"),
        (["a1"], ["b1"], "time"),
        (["1.5"], ["9.5"], "time"),
    ],
)
def test_nothing_is_paired_by_guesswork(images, clouds, method):
    with pytest.raises(SourceError):
        pair_names(images, clouds, method)


def test_explicit_methods_are_obeyed():
    assert pair_names(COUNTERS, COUNTERS[::-1], "order").pairs == [(k, k) for k in range(6)]
    assert pair_names(["1.0", "2.0"], ["2.4", "1.4"], "time", 0.5).pairs == [(0, 1), (1, 0)]


def test_only_names_that_are_times_are_taken_for_times():
    assert parse_times(["2311.422000"]).tolist() == [2311_422_000_000]
    assert parse_times(["1700000000123456789"]).tolist() == [1_700_000_000_123_456_789]
    assert parse_times(["1700000000123456"]).tolist() == [1_700_000_000_123_456_000]
    assert parse_times(["00012", "00013"]) is None and parse_times([]) is None
    assert parse_times(["1.5", "cover"]) is None
    assert parse_times(["9999999999999999999"]) is None and parse_times(["9999999999.5"]) is None


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
