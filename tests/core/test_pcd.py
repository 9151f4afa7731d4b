"""PCD files: exact round trips, files of other writers; errors of damaged files name the fault."""

import struct
from contextlib import suppress

import lzf
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lce_rig.core.errors import SourceError, reading
from lce_rig.core.pcd import decode_pcd, encode_pcd
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
def test_pcd_all_encodings_are_read_exactly(encoding):
    read = decode_pcd(f"{HEAD}{encoding}\n".encode() + BODIES[encoding])
    assert read.dtype.names == CLOUD.dtype.names
    assert read.tolist() == CLOUD.tolist() == decode_pcd(encode_pcd(read, ["made here"])).tolist()


@pytest.mark.parametrize("encoding", BODIES)
@given(data=st.data())
def test_damaged_clouds_are_read_or_refused(encoding, data):
    with suppress(SourceError), reading("a.pcd"):
        assert decode_pcd(data.draw(damaged(f"{HEAD}{encoding}\n".encode() + BODIES[encoding]))).dtype.names


@pytest.mark.parametrize("end", [b"\n", b"\r\n"])
def test_pcd_matlab_header_is_read(end):
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


XYZ = b"FIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\nWIDTH 2\nHEIGHT 1\nPOINTS 2\nDATA ascii\n"
ROWS = b"1 2 3\n4 5 nan\n"


@pytest.mark.parametrize(
    "file",
    [
        XYZ.replace(b"FIELDS x y", b"FIELDS  x\ty").replace(b"SIZE 4 4 4", b"SIZE 4  4 4 ") + ROWS,
        XYZ + ROWS.replace(b"\n", b" \n"),
        XYZ + ROWS.replace(b" ", b"\t"),
        XYZ + ROWS.replace(b" ", b"   ").replace(b"1", b" 1"),
        XYZ.replace(b"COUNT 1 1 1\n", b"") + ROWS,
        XYZ.replace(b"POINTS 2\n", b"") + ROWS,
        XYZ.replace(b"HEIGHT 1\nPOINTS 2\n", b"") + ROWS,
        b"\xef\xbb\xbf" + XYZ + ROWS,
        b"\xef\xbb\xbf# a comment\n\n" + XYZ + ROWS,
        b"# in the header \xae\n".join(line + b"\n" for line in XYZ.split(b"\n")[:-1]) + ROWS,
        XYZ.replace(b"\n", b"\r\n") + ROWS.replace(b"\n", b"\r\n"),
        XYZ.replace(b"FIELDS", b"COLUMNS") + ROWS,
        XYZ.replace(b"DATA ascii", b"data ASCII") + ROWS[:-1],
        XYZ + ROWS.replace(b"\n", b"\n\n") + b"7 8 9\n",
    ],
)
def test_decode_pcd_headers_and_rows_of_any_writer(file):
    np.testing.assert_array_equal(decode_pcd(file).tolist(), [(1, 2, 3), (4, 5, np.nan)])


WIDE = np.array(
    [(1, 2, 3, 9, [5, 6], 4, [0, 0, 0]), (4, 5, 6, 8, [7, 8], 5, [0, 0, 0])],
    [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("x2", "<f8"), ("n", "<i2", 2), ("r", "u1"), ("p", "u1", 3)],
)
WIDE_HEAD = (
    b"FIELDS x y z x normal ring _\nSIZE 4 4 4 8 2 1 1\nTYPE F F F F I U U\nCOUNT 1 1 1 1 2 1 3\n"
    b"WIDTH 1\nHEIGHT 2\nDATA "
)
COLUMNS = b"".join(np.moveaxis(WIDE[name], 0, -1).tobytes() for name in WIDE.dtype.names or ())
PACKED_COLUMNS = lzf.compress(COLUMNS, 2 * len(COLUMNS))


@pytest.mark.parametrize(
    ("encoding", "body"),
    [
        (b"ascii", b"1 2 3 9 5 6 4.0 0 0 0\n4 5 6 8 7 8 5 0 0 0\n"),
        (b"binary", WIDE.tobytes()),
        (
            b"binary_compressed",
            struct.pack("<II", len(PACKED_COLUMNS), len(COLUMNS)) + PACKED_COLUMNS,
        ),
    ],
)
def test_decode_pcd_counts_padding_and_repeated_names(encoding, body):
    read = decode_pcd(WIDE_HEAD + encoding + b"\n" + body)
    assert read.dtype.names == ("x", "y", "z", "normal__0000", "normal__0001", "ring")
    assert read.tolist() == [(1, 2, 3, 5, 6, 4), (4, 5, 6, 7, 8, 5)]


@pytest.mark.parametrize("encoding", [b"ascii", b"binary", b"binary_compressed"])
@pytest.mark.parametrize(
    ("old", "new"), [(b"COUNT 1 1 1", b"COUNT 1 1 9999999"), (b"POINTS 2", b"POINTS 999999999999")]
)
def test_decode_pcd_promises_beyond_the_file_are_refused(encoding, old, new):
    head = XYZ.replace(b"ascii", encoding).replace(old, new)
    with pytest.raises(ValueError, match=r"truncated|values per point"):
        decode_pcd(head + struct.pack("<II", 9992, 2**32 - 1) + bytes(9992))


@pytest.mark.parametrize(
    ("file", "message"),
    [
        (b"hello", "no PCD header"),
        (XYZ.replace(b"TYPE F F F", b"TYPE F F") + ROWS, "3 FIELDS and 2 entries in TYPE"),
        (XYZ.replace(b"SIZE 4 4 4", b"SIZE 4 4 3") + ROWS, "field z is of the unknown type F with 3 bytes"),
        (XYZ.replace(b"SIZE 4 4 4\n", b"") + ROWS, "needs 3 numbers in SIZE, and has none"),
        (XYZ.replace(b"POINTS 2", b"POINTS -2") + ROWS, "needs 1 numbers in POINTS, and has -2"),
        (XYZ.replace(b"ascii", b"zip") + ROWS, "its DATA is 'zip'"),
        (XYZ + b"1,0 2,0 3,0\n4,0 5,0 6,0\n", "not rows of 3 numbers"),
    ],
)
def test_decode_pcd_names_the_fault(file, message):
    with pytest.raises(ValueError, match=message):
        decode_pcd(file)
