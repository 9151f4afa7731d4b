"""Files of samples: exact round trips; errors of damaged files name the fault."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lce_rig.core.data import Events
from lce_rig.core.files import decode_events, encode_events, parse_json


def events_at(t_ns, host_ns=None):
    n = len(t_ns)
    x, y = (np.arange(n) * 7 % 346).astype(np.uint16), (np.arange(n) % 260).astype(np.uint16)
    return Events("cam", np.array(t_ns, np.int64), x, y, np.arange(n) % 3 == 0, 346, 260, host_ns)


@given(
    t_ns=st.lists(st.integers(-(2**60), 2**60), max_size=30).map(sorted),
    host_ns=st.none() | st.integers(0, 2**62),
)
def test_events_come_back_to_the_nanosecond(t_ns, host_ns):
    events = events_at(t_ns, host_ns)
    data = encode_events(events)
    assert data == encode_events(events)
    read = decode_events(data, "cam")
    for name in ("t_ns", "x", "y", "polarity"):
        assert getattr(read, name).dtype == getattr(events, name).dtype
        assert np.array_equal(getattr(read, name), getattr(events, name))
    assert (read.sensor, read.width_px, read.height_px, read.host_ns) == ("cam", 346, 260, host_ns)


@pytest.mark.parametrize("data", [b"[" * 100_000, b"[NaN]", b"[-Infinity]", b"\xff[1]", b'["\\ud800"]', b""])
def test_parse_json_refuses_invalid_json(data):
    with pytest.raises(ValueError):
        parse_json(data)


def test_parse_json_skips_byte_order_mark():
    assert parse_json(b'\xef\xbb\xbf{"a": [1, 2.5, "\\ud83d\\ude00", null]}') == {"a": [1, 2.5, "😀", None]}
