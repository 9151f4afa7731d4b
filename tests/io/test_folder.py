"""Folders of pictures and clouds, and which picture belongs to which cloud."""

import shutil
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lce_rig.core.errors import SourceError
from lce_rig.core.pcd import encode_pcd
from lce_rig.io import SourceOptions, open_recording
from lce_rig.io.folder import pair_names, parse_times
from lce_rig.rig import load_rig
from tests.notes import has_note


@pytest.fixture
def make_folder(tmp_path, room):
    def make(images=("00000", "00001"), clouds=("00000", "00001"), names=("img", "pcd"), suffix=".png"):
        path = tmp_path / "recording"
        for name in names:
            (path / name).mkdir(parents=True, exist_ok=True)
        for k, stem in enumerate(images):
            cv2.imwrite(str(path / names[0] / f"{stem}{suffix}"), np.full((72, 128, 3), 10 + k, np.uint8))
        for stem in clouds:
            (path / names[1] / f"{stem}.pcd").write_bytes(encode_pcd(room))
        return path

    return make


@pytest.mark.parametrize(
    "names", [("img", "pcd"), ("images", "raw_pcd"), ("IMG", "clouds"), (".", "."), ("a", "b")]
)
def test_folders_are_found_by_name_or_content(make_folder, rig, room, names):
    recording = open_recording(make_folder(names=names), rig)
    (note,) = recording.notes
    assert has_note([note], "2 pairs", "equal file") and "partner" not in note
    assert recording.pairs[1].label == "00001.png + 00001.pcd"
    (image,), (scan,), _ = recording.pairs[1].read()
    assert image.pixels.shape == (72, 128, 3) and image.pixels.max() == 11
    assert (image.sensor, image.channel, scan.sensor) == ("cam", "frames", "lidar")
    np.testing.assert_array_equal(scan.ring, room["ring"])


def test_names_that_are_times_become_stamps(make_folder, rig):
    path = make_folder(["2311.422000", "2376.322000"], ["2311.405000", "2376.205000"])
    recording = open_recording(path, rig)
    (image,), (scan,), _ = recording.pairs[0].read()
    assert image.stamp_ns == 2311_422_000_000 and scan.stamp_ns == 2311_405_000_000
    assert has_note(recording.notes[:1], "sorted order", "0.117 s")


def test_the_same_files_have_the_same_key_wherever_they_lie(make_folder, rig, tmp_path):
    path = make_folder()
    keys = [files.key() for files in open_recording(path, rig).pairs]
    path.rename(tmp_path / "moved")
    assert [files.key() for files in open_recording(tmp_path / "moved", rig).pairs] == keys
    assert len(set(keys)) == 2


def test_channel_and_sensors_can_be_chosen(make_folder):
    rig = load_rig("rles")
    camera = next(iter(rig.cameras))
    recording = open_recording(make_folder(), rig, SourceOptions(channel="events"))
    assert recording.pairs[0].read()[0][0].channel == "events"
    assert has_note(open_recording(make_folder(), rig).notes, "images assigned", f"camera {camera}")
    for wrong in ({"camera": "side"}, {"channel": "depth"}, {"lidar": "top"}):
        with pytest.raises(SourceError, match=next(iter(wrong.values()))):
            open_recording(make_folder(), rig, SourceOptions(**wrong))


def test_missing_folders_and_kinds_are_named(make_folder, rig, tmp_path):
    with pytest.raises(SourceError):
        open_recording(tmp_path / "nowhere", rig)
    with pytest.raises(SourceError, match="recording/pcd"):
        open_recording(make_folder(clouds=[]), rig)
    (tmp_path / "empty").mkdir()
    with pytest.raises(SourceError):
        open_recording(tmp_path / "empty", rig)
    (tmp_path / "a.avi").touch()
    with pytest.raises(SourceError, match=r"a\.avi"):
        open_recording(tmp_path / "a.avi", rig)


def test_folder_ambiguous_clouds_are_refused(make_folder, rig):
    path = make_folder(names=("img", "one"))
    make_folder(names=("img", "two"))
    with pytest.raises(SourceError):
        open_recording(path, rig)


TWO = load_rig(str(Path(__file__).parents[1] / "rigs" / "two_cameras.yaml"))


@pytest.mark.parametrize(
    "names", [("img/left", "img/right"), ("left", "right"), ("images/Left", "images/Right")]
)
def test_folder_of_cameras_shares_a_cloud(make_folder, names):
    make_folder(images=("00000", "00001"), clouds=("00000", "00001", "00002"), names=(names[0], "pcd"))
    recording = open_recording(make_folder(("00001", "00002", "00003"), (), (names[1], "pcd")), TWO)
    seen = [[(i.sensor, i.channel, int(i.pixels.max())) for i in p.read()[0]] for p in recording.pairs]
    left, right = ("left", "frames"), ("right", "frames")
    assert seen == [[(*left, 10)], [(*left, 11), (*right, 10)], [(*right, 11)]]
    folder = Path(names[1]).name
    assert recording.pairs[1].label == f"{Path(names[0]).name}/00001.png + {folder}/00001.png + 00001.pcd"
    of_left, of_right, lone = recording.notes
    assert has_note([of_left], "left: 2 pairs", "0 images", "1 point clouds")
    assert has_note([of_right], "right: 2 pairs", "1 images", "1 point clouds")
    assert "without" in lone and lone.endswith(f" {folder}/00003.png")


def test_one_of_several_cameras_can_be_read_by_itself(make_folder):
    make_folder(names=("img/left", "pcd"))
    path = make_folder(names=("img/right", "pcd"))
    (pair, _) = open_recording(path, TWO, SourceOptions(camera="right")).pairs
    assert [image.sensor for image in pair.read()[0]] == ["right"]
    shutil.rmtree(path / "img" / "right")
    with pytest.raises(SourceError):
        open_recording(path, TWO, SourceOptions(camera="right"))


def test_folder_images_of_one_name_are_two_pairs(make_folder, rig):
    path = make_folder()
    shutil.copy(path / "img" / "00000.png", path / "img" / "00000.bmp")
    assert [len(pair.read()[0]) for pair in open_recording(path, rig).pairs] == [1, 1, 1]


def test_folder_las_without_reader_fails(make_folder, rig, monkeypatch):
    path = make_folder()
    for cloud in (path / "pcd").iterdir():
        cloud.rename(cloud.with_suffix(".las"))
    monkeypatch.setitem(sys.modules, "laspy", None)
    with pytest.raises(SourceError) as refused:
        open_recording(path, rig)
    assert "lce-rig[las]" in refused.value.hint


@pytest.mark.dataset
@pytest.mark.parametrize(
    ("name", "n_pairs", "method"),
    [
        ("rlfs01", 18, "equal file names"),
        ("sss_noise15mm", 20, "sorted order"),
        ("rles01_lf", 19, "equal file names"),
        ("rles02_le", 56, "equal file names"),
        ("acfr_vlp16", 10, "equal file names"),
    ],
)
def test_folder_recordings_pair_as_intended(recordings, rig, name, n_pairs, method):
    recording = open_recording(recordings / name, rig)
    assert len(recording.pairs) == n_pairs and method in recording.notes[0]
    _, (scan,), _ = recording.pairs[-1].read()
    assert len(scan.points) > 10_000 and scan.ring.max() <= 15


COUNTERS = [f"{k:05d}" for k in range(6)]


@pytest.mark.parametrize(
    ("images", "clouds", "how", "pairs"),
    [
        (COUNTERS, COUNTERS[::-1], "names", [(k, 5 - k) for k in range(6)]),
        ([*COUNTERS, "x"], [*COUNTERS[:-1], "y"], "names", [(k, k) for k in range(5)]),
        (["00000", "00000", "00001"], ["00000", "00001"], "names", [(0, 0), (1, 0), (2, 1)]),
        (["10.000000", "11.000000"], ["9.990000", "11.020000", "13.000000"], "time", [(0, 0), (1, 1)]),
        (["2311.422000", "2376.322000"], ["2311.405000", "2376.205000"], "order", [(0, 0), (1, 1)]),
        (["a1", "a2", "a10"], ["b3", "b4", "b5"], "order", [(0, 0), (1, 1), (2, 2)]),
    ],
)
def test_names_are_paired_by_the_first_method_that_fits(images, clouds, how, pairs):
    found, reason = pair_names(images, clouds)
    assert found == pairs and how in reason


@pytest.mark.parametrize(
    ("images", "clouds", "may_count"),
    [(["a1", "a2", "a3"], ["b1", "b2"], True), (["a1"], ["b1"], False), (["1.5"], ["9.5"], False)],
)
def test_folder_ambiguous_names_are_not_paired(images, clouds, may_count):
    with pytest.raises(SourceError):
        pair_names(images, clouds, may_count=may_count)


def test_parse_times_rejects_other_names():
    assert parse_times(["2311.422000"]).tolist() == [2311_422_000_000]
    assert parse_times(["1700000000123456789"]).tolist() == [1_700_000_000_123_456_789]
    assert parse_times(["1700000000123456"]).tolist() == [1_700_000_000_123_456_000]
    assert parse_times(["00012", "00013"]) is None and parse_times([]) is None
    assert parse_times(["1.5", "cover"]) is None
    assert parse_times(["9999999999999999999"]) is None and parse_times(["9999999999.5"]) is None


@given(
    st.lists(st.integers(0, 30), unique=True), st.lists(st.integers(0, 30), unique=True), st.floats(0.01, 9)
)
def test_pairs_by_time_are_one_to_one(left, right, tolerance_s):
    """Each pair is within the tolerance."""
    images, clouds = [f"{v}.0" for v in left], [f"{v}.25" for v in right]
    try:
        pairs, reason = pair_names(images, clouds, tolerance_s, may_count=False)
    except SourceError:
        return
    assert len({i for i, _ in pairs}) == len({j for _, j in pairs}) == len(pairs)
    assert not pairs or "time" in reason
    assert all(abs(left[i] - right[j] - 0.25) <= tolerance_s for i, j in pairs)
