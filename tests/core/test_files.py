"""Files of samples: exact there and back; damaged ones say what is wrong with them."""

import struct
from contextlib import suppress

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lce_rig.core.data import Events
from lce_rig.core.errors import SourceError, reading
from lce_rig.core.files import decode_events, decode_pcd, encode_events, encode_pcd, parse_json
from tests.damage import damaged

MATLAB = b"""# This PCD file was generated using the MATLAB\xae pcwrite function
# .PCD v.7 - Point Cloud Data file format
VERSION .7
FIELDS x y z intensity
SIZE 4 4 4 4
TYPE F F F F
COUNT 1 1 1 1
WIDTH 2
HEIGHT 1
VIEWPOINT 0 0 0 1 0 0 0
POINTS 2
DATA binary
"""
CLOUD = np.array([(1.5, -2, 4), (3, 4, 5)], dtype=[("x", "<f4"), ("t", "<f8"), ("ring", "<u2")])
HEAD = "VERSION 0.7\nFIELDS x t ring\nSIZE 4 8 2\nTYPE F F U\nCOUNT 1 1 1\nWIDTH 2\nHEIGHT 1\nPOINTS 2\nDATA "
# LZF without anything compressed: one literal run of at most 32 bytes.
PACKED = bytes([27]) + b"".join(CLOUD[name].tobytes() for name in CLOUD.dtype.names or ())
BODIES = {
    "ascii": b"1.5 -2 4\n3 4 5\n",
    "binary": CLOUD.tobytes(),
    "binary_compressed": struct.pack("<II", len(PACKED), 28) + PACKED,
}


@pytest.mark.parametrize("encoding", BODIES)
def test_clouds_of_every_encoding_are_read_exactly(encoding):
    read = decode_pcd(f"{HEAD}{encoding}\n".encode() + BODIES[encoding])
    assert read.dtype.names == CLOUD.dtype.names
    assert read.tolist() == CLOUD.tolist() == decode_pcd(encode_pcd(read, ["made here"])).tolist()


@pytest.mark.parametrize("encoding", BODIES)
@given(data=st.data())
def test_damaged_clouds_are_read_or_refused(encoding, data):
    with suppress(SourceError), reading("a.pcd"):
        assert decode_pcd(data.draw(damaged(f"{HEAD}{encoding}\n".encode() + BODIES[encoding]))).dtype.names


@pytest.mark.parametrize("end", [b"\n", b"\r\n"])
def test_headers_as_matlab_writes_them_are_read(end):
    read = decode_pcd(MATLAB.replace(b"\n", end) + np.arange(8, dtype="<f4").tobytes())
    assert read["intensity"].tolist() == [3.0, 7.0]


@pytest.mark.parametrize(
    "data",
    [
        b"",
        b"PK\x03\x04" * 50,
        MATLAB + bytes(16),
        MATLAB.replace(b"DATA binary", b"DATA ascii") + b"1 2 3 4\n5 6 7\n",
        MATLAB.replace(b"binary", b"binary_compressed") + struct.pack("<II", 9, 31),
    ],
)
def test_missing_points_are_an_error(data):
    with pytest.raises(SourceError), reading("a.pcd"):
        decode_pcd(data)


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
def test_what_is_no_json_is_refused(data):
    with pytest.raises(ValueError):
        parse_json(data)


def test_json_is_read_with_or_without_a_mark_of_its_encoding():
    assert parse_json(b'\xef\xbb\xbf{"a": [1, 2.5, "\\ud83d\\ude00", null]}') == {"a": [1, 2.5, "😀", None]}
