"""PCD files of every kind are read, and damaged ones say what is wrong with them."""

import struct

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lce_rig.core.pcd import decode_pcd, encode_pcd

KINDS = ["F4", "F8", "U1", "U2", "U4", "U8", "I1", "I2", "I4", "I8"]
MATLAB = b"""# This PCD file was generated using the MATLAB
 pcwrite function
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


@st.composite
def clouds(draw):
    """A cloud with fields of any type, count and order, and its header."""
    n_fields = draw(st.integers(1, 6))
    kinds = draw(st.lists(st.sampled_from(KINDS), min_size=n_fields, max_size=n_fields))
    counts = draw(st.lists(st.integers(1, 3), min_size=n_fields, max_size=n_fields))
    n_points = draw(st.integers(0, 20))
    dtype = np.dtype([
        (f"f{k}", f"<{kind[0].lower()}{kind[1]}", () if c == 1 else (c,))
        for k, (kind, c) in enumerate(zip(kinds, counts, strict=True))
    ])  # fmt: skip
    rng = np.random.default_rng(draw(st.integers(0, 2**32)))
    cloud = np.zeros(n_points, dtype)
    for name in dtype.names:
        base = dtype[name].base
        if base.kind == "f":
            cloud[name] = rng.normal(size=cloud[name].shape)
        else:
            info = np.iinfo(base)
            cloud[name] = rng.integers(info.min, info.max, cloud[name].shape, dtype=base, endpoint=True)
    return cloud, kinds, counts


def header(cloud, kinds, counts, encoding):
    names = " ".join(cloud.dtype.names)
    sizes, types = " ".join(k[1] for k in kinds), " ".join(k[0] for k in kinds)
    return (
        f"VERSION 0.7\nFIELDS {names}\nSIZE {sizes}\nTYPE {types}\nCOUNT {' '.join(map(str, counts))}\n"
        f"WIDTH {len(cloud)}\nHEIGHT 1\nPOINTS {len(cloud)}\nDATA {encoding}\n"
    ).encode()


def columns(cloud):
    return [cloud[name].reshape(len(cloud), max(1, cloud[name][:1].size)) for name in cloud.dtype.names]


def store_lzf(data: bytes) -> bytes:
    """LZF without finding anything to compress: literal runs of at most 32 bytes."""
    runs = [data[k : k + 32] for k in range(0, len(data), 32)]
    return b"".join(bytes([len(run) - 1]) + run for run in runs)


def assert_equal(read, given):
    assert read.dtype.names == given.dtype.names
    for name in given.dtype.names:
        np.testing.assert_array_equal(read[name], given[name])


@given(clouds())
def test_binary_clouds_of_any_layout_are_read_exactly(given_cloud):
    cloud, kinds, counts = given_cloud
    assert_equal(decode_pcd(header(cloud, kinds, counts, "binary") + cloud.tobytes()), cloud)


@given(clouds())
def test_ascii_clouds_of_any_layout_are_read_exactly(given_cloud):
    cloud, kinds, counts = given_cloud
    rows = [
        " ".join(repr(v.item()) for column in columns(cloud) for v in column[k]) for k in range(len(cloud))
    ]
    assert_equal(decode_pcd(header(cloud, kinds, counts, "ascii") + "\n".join(rows).encode()), cloud)


@given(clouds())
def test_compressed_clouds_of_any_layout_are_read_exactly(given_cloud):
    cloud, kinds, counts = given_cloud
    raw = b"".join(np.ascontiguousarray(column).tobytes() for column in columns(cloud))
    packed = store_lzf(raw)
    data = (
        header(cloud, kinds, counts, "binary_compressed") + struct.pack("<II", len(packed), len(raw)) + packed
    )
    assert_equal(decode_pcd(data), cloud)


@given(clouds(), st.data())
def test_torn_or_flipped_files_raise_only_value_errors(given_cloud, data):
    cloud, kinds, counts = given_cloud
    encoding = data.draw(st.sampled_from(["ascii", "binary", "binary_compressed"]))
    whole = bytearray(header(cloud, kinds, counts, encoding) + cloud.tobytes())
    for _ in range(data.draw(st.integers(0, 4))):
        whole[data.draw(st.integers(0, len(whole) - 1))] = data.draw(st.integers(0, 255))
    try:
        decode_pcd(bytes(whole[: data.draw(st.integers(0, len(whole)))]))
    except ValueError as error:
        assert str(error)


def test_what_open3d_compresses_is_read(tmp_path):
    import open3d

    points = np.repeat(np.random.default_rng(0).normal(size=(40, 3)).astype(np.float32), 25, axis=0)
    cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(points.astype(np.float64)))
    path = str(tmp_path / "cloud.pcd")
    assert open3d.io.write_point_cloud(path, cloud, compressed=True)
    data = (tmp_path / "cloud.pcd").read_bytes()
    # The repeated points make it use references, which the hand-made files above do not.
    assert b"binary_compressed" in data and len(data) < points.nbytes / 2
    read = decode_pcd(data)
    np.testing.assert_array_equal(np.stack([read["x"], read["y"], read["z"]], axis=1), points)


def test_a_reference_into_what_it_writes_itself_repeats_the_period():
    # "ab", then 7 bytes from 2 bytes back: "ab" + "abababa".
    packed = bytes([1, *b"ab", 5 << 5, 1])
    head = b"FIELDS v\nSIZE 1\nTYPE U\nCOUNT 9\nWIDTH 1\nHEIGHT 1\nPOINTS 1\nDATA binary_compressed\n"
    read = decode_pcd(head + struct.pack("<II", len(packed), 9) + packed)
    assert read["v"][0].tobytes() == b"ababababa"


def test_encoding_and_decoding_are_inverse():
    cloud = np.array([(1.5, -2, 40000)], dtype=[("x", ">f8"), ("ring", "i2"), ("t", "<u4")])
    assert_equal(decode_pcd(encode_pcd(cloud, ["made here"])), cloud)


def test_headers_as_matlab_writes_them_are_read():
    points = np.arange(8, dtype="<f4")
    read = decode_pcd(MATLAB + points.tobytes())
    assert read["intensity"].tolist() == [3.0, 7.0]
    assert_equal(decode_pcd(MATLAB.replace(b"\n", b"\r\n") + points.tobytes()), read)


def test_padding_fields_and_missing_counts_are_read():
    head = b"COLUMNS x _ y _\nSIZE 4 1 4 1\nTYPE F U F U\nWIDTH 1\nHEIGHT 2\nDATA ascii\n"
    read = decode_pcd(head + b"1 0 2 0\n3 0 4 0\n")
    assert read["x"].tolist() == [1, 3] and read["y"].tolist() == [2, 4]


def test_numbers_that_are_not_there_are_read_in_text():
    head = b"FIELDS x ring\nSIZE 4 2\nTYPE F U\nCOUNT 1 1\nWIDTH 3\nHEIGHT 1\nPOINTS 3\nDATA ascii\n"
    read = decode_pcd(head + b"nan 3.0\n-inf nan\n1e-3 5\n")
    assert np.isnan(read["x"][0]) and read["x"][1] == -np.inf and read["ring"].tolist() == [3, 0, 5]


@pytest.mark.parametrize(
    ("data", "cause"),
    [
        (b"", "empty"),
        (b"PK\x03\x04" * 50, "no PCD header"),
        (MATLAB[:150], "no PCD header"),
        (MATLAB, "0 of 2 points"),
        (MATLAB + bytes(31), "1 of 2 points"),
        (MATLAB.replace(b"DATA binary", b"DATA ascii") + b"1 2 3 4\n", "1 of 2 points"),
        (MATLAB.replace(b"DATA binary", b"DATA ascii") + b"1 2 3 4\n5 6 7\n", "cannot be read as numbers"),
        (MATLAB.replace(b"DATA binary", b"DATA ascii") + b"1 2 3\n5 6 7\n", "rows have 3 numbers"),
        (MATLAB.replace(b"binary", b"foo"), "encoding is 'foo'"),
        (MATLAB.replace(b"SIZE 4 4 4 4", b"SIZE 4 4 4"), "4 FIELDS but 3 entries of SIZE"),
        (MATLAB.replace(b"SIZE 4 4 4 4", b"SIZE 4 4 4 3"), "type F of 3 bytes"),
        (MATLAB.replace(b"COUNT 1 1 1 1", b"COUNT 1 1 1 -1"), "COUNT of '-1'"),
        (MATLAB.replace(b"POINTS 2", b"POINTS two"), "how many points"),
        (MATLAB.replace(b"POINTS 2", b"POINTS 99999999999"), "declares 99999999999 points, at most"),
        (MATLAB.replace(b"binary", b"binary_compressed") + bytes(3), "compressed part is not there"),
        (MATLAB.replace(b"binary", b"binary_compressed") + struct.pack("<II", 9, 31), "says 31 bytes"),
        (MATLAB.replace(b"binary", b"binary_compressed") + struct.pack("<II", 9, 32), "0 of 9 compressed"),
        (MATLAB.replace(b"binary", b"binary_compressed") + struct.pack("<II", 2, 32) + b" \5", "damaged"),
    ],
)  # fmt: skip
def test_damage_is_named(data, cause):
    with pytest.raises(ValueError, match=cause):
        decode_pcd(data)
