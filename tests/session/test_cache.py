"""A cache entry is what was stored, or not there."""

import shutil

import numpy as np
import pytest

from lce_rig.session import cache


@pytest.fixture
def entry(tmp_path):
    path = tmp_path / "digest" / "000000.cam.npz"
    assert cache.store(path, {"a": np.arange(40.0), "b": np.eye(3)}, {"n": 1})
    return path


def test_every_flipped_bit_is_noticed(entry):
    whole = entry.read_bytes()
    for k in range(0, 8 * len(whole), 7):
        damaged = bytearray(whole)
        damaged[k // 8] ^= 1 << k % 8
        entry.write_bytes(damaged)
        assert cache.load(entry) is None
    entry.write_bytes(whole)
    assert np.array_equal(cache.load(entry).arrays["a"], np.arange(40.0))


def test_an_entry_of_another_place_is_not_there(entry):
    shutil.copy(entry, entry.with_name("000001.cam.npz"))
    assert cache.load(entry.with_name("000001.cam.npz")) is None
