import os

import pytest

from lce_rig.core.limits import MAX_CHUNK_BYTES, check_size, describe, open_regular, read_file


def test_a_file_is_read_whole(tmp_path):
    path = tmp_path / "a"
    path.write_bytes(b"abc")
    assert read_file(path, 3) == b"abc"


def test_a_file_beyond_the_limit_is_not_read(tmp_path):
    path = tmp_path / "a"
    with path.open("wb") as file:
        file.truncate(1 << 40)  # sparse: takes no disk
    with pytest.raises(ValueError, match="TB"):
        read_file(path)


def test_a_file_to_which_hardly_anything_was_written_is_refused(tmp_path):
    with (tmp_path / "holes").open("wb") as file:
        file.write(b"head")
        file.truncate(1 << 40)
    with pytest.raises(ValueError, match=r"1\.1 TB, of which 0 MB were written"):
        open_regular(tmp_path / "holes")


def test_a_pipe_is_refused_at_once(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(ValueError, match="pipe"):
        open_regular(tmp_path / "pipe")


def test_a_folder_is_an_os_error(tmp_path):
    with pytest.raises(IsADirectoryError):
        open_regular(tmp_path)


@pytest.mark.parametrize("n_bytes", [-1, MAX_CHUNK_BYTES + 1, 1 << 63])
def test_declared_sizes_beyond_reach_are_refused(n_bytes):
    with pytest.raises(ValueError, match="declares"):
        check_size(n_bytes)


def test_values_in_messages_are_short():
    assert len(describe("x" * 10**6)) == 60 and describe(7) == "7"
