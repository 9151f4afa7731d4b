"""Events as one file: exact, repeatable, readable by numpy alone."""

import io
from contextlib import suppress

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lce_rig.core.data import Events
from lce_rig.core.errors import SourceError, reading
from lce_rig.core.event_file import decode_events, encode_events
from tests.damage import damaged


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
    "columns",
    [
        {},
        {"t_us": [1], "x": [1]},
        {"t_us": [1, 2], "x": [1], "y": [1]},
        {"t_us": [1 << 60], "x": [1], "y": [1]},
        {"t_us": [1], "x": [-1], "y": [1]},
        {"t_us": [1], "x": [1 << 16], "y": [1]},
        {"t_us": [0.5], "x": [1], "y": [1]},
        {"t_us": [1], "x": 1, "y": [1]},
    ],
)
def test_other_archives_are_refused(columns: dict[str, object]) -> None:
    buffer = io.BytesIO()
    np.savez(buffer, **columns, polarity=[True], resolution_px=[346, 260])
    with pytest.raises(ValueError, match=r"\w"):
        decode_events(buffer.getvalue(), "cam")


def test_pickled_objects_are_never_loaded() -> None:
    buffer = io.BytesIO()
    np.savez(buffer, t_us=np.array([None], object), x=[1], y=[1], polarity=[True], resolution_px=[1, 1])
    with pytest.raises(ValueError, match="pickle"):
        decode_events(buffer.getvalue(), "cam")


@given(data=damaged(encode_events(events_at(list(range(0, 10**6, 10_000))))))
def test_damaged_archives_give_events_or_an_error_that_names_the_file(data: bytes) -> None:
    with suppress(SourceError), reading("capture/events.npz"):
        events = decode_events(data, "cam")
        assert len(events.t_ns) == len(events.x) == len(events.y) == len(events.polarity)
