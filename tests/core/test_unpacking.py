import bz2
import os
import zipfile

import pytest

from lce_rig.core.limits import open_regular
from lce_rig.core.unpacking import decompress, open_archive, read_member, unpacked_limit


def test_what_unpacks_to_the_limit_is_taken_and_one_byte_more_is_not():
    packed = bz2.compress(bytes(3_000_000))
    assert decompress(bz2.BZ2Decompressor(), packed, 3_000_000) == bytes(3_000_000)
    with pytest.raises(ValueError, match="unpacks to more than"):
        decompress(bz2.BZ2Decompressor(), packed, 2_999_999)


def test_a_truncated_stream_is_told():
    with pytest.raises(ValueError, match="truncated"):
        decompress(bz2.BZ2Decompressor(), bz2.compress(os.urandom(1000))[:500])


@pytest.mark.parametrize("make", ["lz4", "zstd"])
def test_other_libraries_stop_alike(make):
    if make == "lz4":
        frame = pytest.importorskip("lz4.frame")
        new, packed = frame.LZ4FrameDecompressor, frame.compress(bytes(1 << 22))
    else:
        zstd = pytest.importorskip("backports.zstd")
        new, packed = zstd.ZstdDecompressor, zstd.compress(bytes(1 << 22))
    assert decompress(new(), packed) == bytes(1 << 22)
    with pytest.raises(ValueError, match="unpacks to more than"):
        decompress(new(), packed, 1 << 21)
    with pytest.raises(ValueError, match="truncated"):
        decompress(new(), packed[:-6])


def test_members_of_an_archive_are_read_up_to_the_limit(tmp_path):
    with zipfile.ZipFile(tmp_path / "a.zip", "w", zipfile.ZIP_DEFLATED) as file:
        file.writestr("a", bytes(3_000_000))
    with open_regular(tmp_path / "a.zip") as file:
        archive = open_archive(file)
        (member,) = archive.infolist()
        assert read_member(archive, member, 3_000_000) == bytes(3_000_000)
        with pytest.raises(ValueError, match="'a' declares 3 MB"):
            read_member(archive, member, 2_999_999)


def test_a_member_that_declares_less_than_it_packs_gives_no_more_than_it_declares(tmp_path):
    with zipfile.ZipFile(tmp_path / "a.zip", "w", zipfile.ZIP_DEFLATED) as file:
        file.writestr("a", bytes(50_000_000))
    with open_regular(tmp_path / "a.zip") as file:
        archive = open_archive(file)
        (member,) = archive.infolist()
        member.file_size = 1000
        with pytest.raises(zipfile.BadZipFile):  # The checksum is of all of it.
            read_member(archive, member)


def test_what_may_be_unpacked_grows_with_what_is_stored():
    assert unpacked_limit(0) == 1 << 24
    assert unpacked_limit(10**6) - unpacked_limit(0) == 10**8
