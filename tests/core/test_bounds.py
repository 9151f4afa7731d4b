"""Bounds on files of others."""

import bz2
import os
import struct

import lz4.frame
import numpy as np
import pytest

from lce_rig.core.bounds import (
    MAX_CHUNK_BYTES,
    BoundedPath,
    Unpacking,
    decoding,
    require_file,
    unpack,
)
from lce_rig.core.errors import SourceError, reading
from lce_rig.io.decoding import read_cloud, read_image


def test_require_file_devices_and_pipes_are_refused(tmp_path):
    (tmp_path / "link").symlink_to("/dev/zero")
    os.mkfifo(tmp_path / "pipe")
    for name in ("link", "pipe"):
        with pytest.raises(SourceError, match="a device or a pipe"), reading(tmp_path / name):
            pytest.fail("it was opened")
    require_file(tmp_path)
    require_file(tmp_path / "missing")


def test_require_file_too_large_is_refused_by_size(tmp_path):
    (tmp_path / "a.png").touch()
    os.truncate(tmp_path / "a.png", 1 << 40)
    require_file(tmp_path / "a.png")
    with pytest.raises(SourceError, match=r"1099511\.6 MB \(limit"):
        read_image(tmp_path / "a.png")


@pytest.mark.parametrize(
    ("pack", "make"),
    [(bz2.compress, bz2.BZ2Decompressor), (lz4.frame.compress, lz4.frame.LZ4FrameDecompressor)],
)
def test_unpack_gives_all_frames_up_to_the_bound(pack, make, monkeypatch):
    monkeypatch.setattr("lce_rig.core.bounds._STEP_BYTES", 1 << 20)
    plain = bytes(range(256)) * 10_000
    packed = pack(plain)
    assert unpack(make, packed) == plain
    assert unpack(make, packed + pack(b"end")) == plain + b"end"
    assert unpack(make, packed, len(plain)) == plain
    with pytest.raises(ValueError, match="unpacks to more than"):
        unpack(make, packed, len(plain) - 1)
    with pytest.raises(EOFError, match="truncated"):
        unpack(make, packed[:-9])


def test_bounded_path_refuses_a_claimed_length(tmp_path):
    path = BoundedPath(tmp_path / "file")
    path.write_bytes(b"abc")
    with path.open("rb") as file:
        assert file.read(2) == b"ab"
        with pytest.raises(ValueError, match="a record claims"):
            file.read(MAX_CHUNK_BYTES + 1)
        assert file.read() == b"c"


def test_unpacking_stops_a_recording_that_swells(tmp_path):
    (tmp_path / "a.bz2").write_bytes(bz2.compress(bytes(MAX_CHUNK_BYTES + (1 << 20))))
    with Unpacking(bz2.open(tmp_path / "a.bz2"), 100) as file, pytest.raises(ValueError, match="far more"):
        while file.read(1 << 24):
            pass


def test_decoding_refuses_oversized_headers():
    with decoding(), pytest.raises(MemoryError):
        np.ones(1 << 28)
    assert np.ones(1 << 20).all()


def las(n_vlrs=0, n_evlrs=0, n_points=1):
    """Write a LAS 1.4 header with a point of zeros."""
    counts = (375, 375, n_vlrs, 0, 20, n_points)
    head = struct.pack("<4sHH16sBB64sHHHIIBHI", b"LASF", 0, 0, bytes(16), 1, 4, b"", 1, 2026, *counts)
    head += bytes(20) + struct.pack("<12d", *[0.001] * 3, *[0.0] * 9)
    head += struct.pack("<QQIQ", 0, 395 if n_evlrs else 0, n_evlrs, n_points)
    return head.ljust(375, b"\0") + bytes(20)


def test_las_counts_beyond_the_file_are_refused(tmp_path):
    path = tmp_path / "a.las"
    path.write_bytes(las())
    assert len(read_cloud(path)) == 1
    for counts in ({"n_vlrs": 2**32 - 1}, {"n_evlrs": 2**32 - 1}, {"n_points": 2**32 - 1}):
        path.write_bytes(las(**counts))
        with pytest.raises(SourceError, match="truncated: 395 of at least"):
            read_cloud(path)
