"""A kill, an interrupt or a full disk ends a recording with one error."""

import resource
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from lce_rig.core.errors import SourceError
from lce_rig.io import open_recording
from lce_rig.io.ros.bag_recorder import BagRecorder, FolderRecorder
from lce_rig.rig import Rig, load_rig

from .rig_samples import KINDS, packet, picture, record, sweep


@pytest.fixture(scope="module")
def rles() -> Rig:
    return load_rig("rles")


@pytest.mark.parametrize("name", KINDS)
def test_the_bag_of_a_killed_recorder_is_named_with_its_repair(tmp_path: Path, rles: Rig, name: str) -> None:
    with BagRecorder(tmp_path / name, rles) as recorder:
        samples = [*map(picture, range(40)), *map(sweep, range(20))]
        for sample in samples:
            recorder.write(sample)
        on_disk = tmp_path / name
        left = tmp_path / f"left{on_disk.suffix}"
        # The files as they are at this moment are what a SIGKILL leaves.
        (shutil.copytree if on_disk.is_dir() else shutil.copy)(on_disk, left)
    with pytest.raises(SourceError) as caught:
        open_recording(left, rles)
    assert ("rosbag reindex" if name.endswith(".bag") else "mcap recover") in caught.value.hint


@contextmanager
def files_up_to(n_bytes: int) -> Iterator[None]:
    """Let no file grow beyond a size, as on a disk that is full."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (n_bytes, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


@pytest.mark.parametrize("name", KINDS)
def test_a_full_disk_stops_the_recording(tmp_path: Path, rles: Rig, name: str) -> None:
    samples = [*map(sweep, range(5)), *map(picture, range(50))]
    n_taken = 0
    with files_up_to(3_000_000), BagRecorder(tmp_path / name, rles) as recorder:
        with pytest.raises(SourceError):
            for sample in samples:
                recorder.write(sample)
                n_taken += 1
        with pytest.raises(SourceError):
            recorder.write(samples[0])
    assert 10 < n_taken < 50
    with pytest.raises(SourceError, match=name):
        open_recording(tmp_path / name, rles)


def test_a_disk_that_is_full_at_the_end_is_named_too(tmp_path: Path, rles: Rig) -> None:
    with files_up_to(100_000), pytest.raises(SourceError):
        record(tmp_path / "r.bag", rles, [picture(0), picture(1)])


def test_an_error_of_the_user_of_a_recorder_is_not_hidden_by_a_full_disk(tmp_path: Path, rles: Rig) -> None:
    with files_up_to(100_000), pytest.raises(KeyError), BagRecorder(tmp_path / "r.bag", rles) as recorder:
        recorder.write(picture(0))
        recorder.write(picture(1))
        raise KeyError


def test_a_full_disk_stops_a_folder_with_one_error(tmp_path: Path, rles: Rig) -> None:
    with (
        files_up_to(300_000),
        pytest.raises(SourceError, match=r"events\.aedat4"),
        FolderRecorder(tmp_path / "r", rles) as recorder,
    ):
        for k in range(100):
            recorder.write(packet(k, 6000))
