"""Events as one file: exact, repeatable, readable by numpy alone."""

import io

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lce_rig.core.data import Events
from lce_rig.core.event_file import decode_events, encode_events


def events_at(t_ns: list[int], host_ns: int | None = None) -> Events:
    n = len(t_ns)
    x, y = (np.arange(n) * 7 % 346).astype(np.uint16), (np.arange(n) % 260).astype(np.uint16)
    return Events("cam", np.array(t_ns, np.int64), x, y, np.arange(n) % 3 == 0, 346, 260, host_ns)


@given(
    t_ns=st.lists(st.integers(-(2**60), 2**60), max_size=30).map(sorted),
    host_ns=st.none() | st.integers(0, 2**62),
)
def test_events_come_back_to_the_nanosecond(t_ns: list[int], host_ns: int | None) -> None:
    events = events_at(t_ns, host_ns)
    found = decode_events(encode_events(events), "cam")
    for name in ("t_ns", "x", "y", "polarity"):
        assert getattr(found, name).dtype == getattr(events, name).dtype
        assert np.array_equal(getattr(found, name), getattr(events, name))
    assert (found.sensor, found.width_px, found.height_px, found.host_ns) == ("cam", 346, 260, host_ns)


def test_the_same_events_give_the_same_bytes() -> None:
    events = events_at(list(range(0, 10**6, 1000)))
    assert encode_events(events) == encode_events(events)


def test_whole_microseconds_are_stored_as_such() -> None:
    with np.load(io.BytesIO(encode_events(events_at([1000, 2000])))) as archive:
        assert archive["t_us"].tolist() == [1, 2]


@pytest.mark.parametrize(
    ("columns", "cause"),
    [
        ({}, "no times"),
        ({"t": [1], "x": [1], "y": [1]}, "no column polarity"),
        ({"t": [1, 2], "x": [1], "y": [1], "p": [1]}, "unequal length"),
        ({"t": [1], "x": [-1], "y": [1], "p": [1]}, "beyond any sensor"),
        ({"t": np.array([None]), "x": [1], "y": [1], "p": [1]}, "archive of events"),
        ({"t": [1], "x": 1, "y": [1], "p": [1]}, "column x is no list of numbers"),
        ({"t": [1], "x": [1], "y": [1], "p": ["on"]}, "column polarity is no list of numbers"),
        ({"t": [1], "x": [1], "y": [1], "p": [1], "resolution_px": 346}, "no width and height"),
    ],
)
def test_what_is_no_archive_of_events_is_refused_in_words(columns: dict[str, object], cause: str) -> None:
    buffer = io.BytesIO()
    np.savez(buffer, **columns)
    with pytest.raises(ValueError, match=cause):
        decode_events(buffer.getvalue(), "cam")


@given(cut=st.integers(0, 2000), flip=st.integers(0, 2000))
def test_damage_is_an_error_in_words_or_changes_nothing(cut: int, flip: int) -> None:
    events = events_at(list(range(0, 10**6, 10_000)))
    whole = encode_events(events)
    damaged = bytearray(whole)
    damaged[flip % len(whole)] ^= 0x40
    for data in (whole[: cut % len(whole)], bytes(damaged)):
        try:
            found = decode_events(data, "cam")
        except ValueError as error:
            assert str(error)
        else:
            assert np.array_equal(found.t_ns, events.t_ns)
            assert np.array_equal(found.x, events.x)
