"""PCD files of every kind are read, and damaged ones say what is wrong with them."""

import struct
from contextlib import suppress

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lce_rig.core.errors import SourceError, reading
from lce_rig.core.pcd import decode_pcd, encode_pcd
from tests.damage import damaged

KINDS = ["F4", "F8", "U1", "U2", "U4", "U8", "I1", "I2", "I4", "I8"]
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


@st.composite
def clouds(draw):
    """A cloud with fields of any type and order, and its header's types."""
    n_fields = draw(st.integers(1, 6))
    kinds = draw(st.lists(st.sampled_from(KINDS), min_size=n_fields, max_size=n_fields))
    n_points = draw(st.integers(0, 20))
    dtype = np.dtype([(f"f{k}", f"<{kind[0].lower()}{kind[1]}") for k, kind in enumerate(kinds)])
    rng = np.random.default_rng(draw(st.integers(0, 2**32)))
    cloud = np.zeros(n_points, dtype)
    for name in dtype.names:
        base = dtype[name].base
        if base.kind == "f":
            cloud[name] = rng.normal(size=cloud[name].shape)
        else:
            info = np.iinfo(base)
            cloud[name] = rng.integers(info.min, info.max, cloud[name].shape, dtype=base, endpoint=True)
    return cloud, kinds


def header(cloud, kinds, encoding):
    names = " ".join(cloud.dtype.names)
    sizes, types = " ".join(k[1] for k in kinds), " ".join(k[0] for k in kinds)
    return (
        f"VERSION 0.7\nFIELDS {names}\nSIZE {sizes}\nTYPE {types}\nCOUNT {' '.join('1' for _ in kinds)}\n"
        f"WIDTH {len(cloud)}\nHEIGHT 1\nPOINTS {len(cloud)}\nDATA {encoding}\n"
    ).encode()


def columns(cloud):
    return [cloud[name] for name in cloud.dtype.names]


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
    cloud, kinds = given_cloud
    assert_equal(decode_pcd(header(cloud, kinds, "binary") + cloud.tobytes()), cloud)


@given(clouds())
def test_ascii_clouds_of_any_layout_are_read_exactly(given_cloud):
    cloud, kinds = given_cloud
    rows = [" ".join(repr(column[k].item()) for column in columns(cloud)) for k in range(len(cloud))]
    assert_equal(decode_pcd(header(cloud, kinds, "ascii") + "\n".join(rows).encode()), cloud)


@given(clouds())
def test_compressed_clouds_of_any_layout_are_read_exactly(given_cloud):
    cloud, kinds = given_cloud
    raw = b"".join(np.ascontiguousarray(column).tobytes() for column in columns(cloud))
    packed = store_lzf(raw)
    data = header(cloud, kinds, "binary_compressed") + struct.pack("<II", len(packed), len(raw)) + packed
    assert_equal(decode_pcd(data), cloud)


@pytest.mark.parametrize("encoding", ["ascii", "binary", "binary_compressed"])
@given(data=st.data())
def test_damaged_clouds_are_read_or_refused(encoding, data):
    cloud = np.array([(1.5, -2, 4), (3, 4, 5)], dtype=[("x", "<f4"), ("t", "<f8"), ("ring", "<u2")])
    body = {
        "ascii": b"1.5 -2 4\n3 4 5\n",
        "binary": cloud.tobytes(),
        "binary_compressed": struct.pack("<II", 29, 28) + store_lzf(cloud.tobytes()),
    }[encoding]
    whole = header(cloud, ["F4", "F8", "U2"], encoding) + body
    with suppress(SourceError), reading("a.pcd"):
        assert decode_pcd(data.draw(damaged(whole))).dtype.names


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


def test_encoding_and_decoding_are_inverse():
    cloud = np.array([(1.5, -2, 40000)], dtype=[("x", ">f8"), ("ring", "i2"), ("t", "<u4")])
    assert_equal(decode_pcd(encode_pcd(cloud, ["made here"])), cloud)


def test_headers_as_matlab_writes_them_are_read():
    points = np.arange(8, dtype="<f4")
    read = decode_pcd(MATLAB + points.tobytes())
    assert read["intensity"].tolist() == [3.0, 7.0]
    assert_equal(decode_pcd(MATLAB.replace(b"\n", b"\r\n") + points.tobytes()), read)


def test_padding_fields_are_no_obstacle():
    head = b"FIELDS x _ y _\nSIZE 4 1 4 1\nTYPE F U F U\nCOUNT 1 3 1 1\nWIDTH 1\nHEIGHT 2\nPOINTS 2\n"
    read = decode_pcd(head + b"DATA ascii\n1 0 0 0 2 0\nnan 0 0 0 4 0\n")
    assert read["x"][0] == 1 and np.isnan(read["x"][1]) and read["y"].tolist() == [2, 4]


@pytest.mark.parametrize(
    "data",
    [
        b"",
        b"PK\x03\x04" * 50,
        MATLAB,
        MATLAB + bytes(16),
        MATLAB.replace(b"DATA binary", b"DATA ascii") + b"1 2 3 4\n",
        MATLAB.replace(b"DATA binary", b"DATA ascii") + b"1 2 3 4\n5 6 7\n",
        MATLAB.replace(b"binary", b"binary_compressed") + struct.pack("<II", 9, 31),
    ],
)
def test_missing_points_are_an_error(data):
    with pytest.raises(SourceError), reading("a.pcd"):
        decode_pcd(data)
