"""A folder filled by several recorders is read as one recording; other folders are not."""

import cv2
import numpy as np
import pytest

from lce_rig.core.data import Events, Image, Scan
from lce_rig.core.errors import SourceError
from lce_rig.io import list_parts, open_recordings
from lce_rig.io.network import Datagram
from lce_rig.io.recording import ContinuousRecording, SourceOptions, check_overlap, join_recordings
from lce_rig.io.ros.bag_recorder import BagRecorder

from .pcap_files import write_datagrams
from .rig_samples import KINDS, T0_NS, one_second
from .vlp16_room import NETWORK_NS, packets_of, room_scans


def record_packets(path):
    packets = packets_of(room_scans(10, T0_NS))
    write_datagrams(
        path,
        (Datagram(p.sent_ns + NETWORK_NS, "127.0.0.1", p.port, p.payload) for p in packets),
    )


def fill(folder, rig, ros=1):
    """Record a second: packets by one recorder, all else in a bag."""
    n_pictures = 0
    with BagRecorder.in_folder(folder, rig, ros) as recorder:
        for sample in one_second():
            if not isinstance(sample, Scan):
                recorder.write(sample)
                n_pictures += isinstance(sample, Image)
    record_packets(folder / "lidar.pcap")
    return n_pictures


def read(folder, rig):
    (joined,) = join_recordings(open_recordings([folder], rig), rig)
    assert isinstance(joined, ContinuousRecording)
    return joined


@pytest.mark.parametrize(("ros", "bag"), list(enumerate(KINDS, start=1)))
def test_recorded_folder_is_one_recording(tmp_path, rles, ros, bag):
    folder = tmp_path / "kept"
    n_pictures = fill(folder, rles, ros)
    assert {each.name for each in folder.iterdir()} == {bag, "lidar.pcap"}
    joined = read(folder, rles)
    samples = list(joined.samples())
    assert sum(isinstance(sample, Image) for sample in samples) == n_pictures
    scans = [sample for sample in samples if isinstance(sample, Scan)]
    # A revolution is whole once the next has begun; the sensor counts whole microseconds.
    assert 8 <= len(scans) <= 10
    assert all(abs((scan.stamp_ns or 0) - T0_NS) < 1.1e9 for scan in scans)
    events = np.concatenate([sample.t_ns for sample in samples if isinstance(sample, Events)])
    assert len(events) == 50 * 4000
    assert joined.key == read(folder, rles).key, "so that a second run knows what was captured"
    with pytest.raises(SourceError, match="kept"):
        BagRecorder.in_folder(folder, rles, ros)


def test_recorded_folder_skips_empty_file(tmp_path, rles):
    folder = tmp_path / "kept"
    fill(folder, rles)
    (folder / "events.aedat4").write_bytes(b"")
    joined = read(folder, rles)
    assert any("skipped" in note and "events.aedat4" in note for note in joined.notes)
    assert sum(isinstance(sample, Events) for sample in joined.samples()) > 0, "those of the bag"
    for file in folder.iterdir():
        file.write_bytes(b"")
    with pytest.raises(SourceError, match=r"recording\.bag|kept"):
        open_recordings([folder], rles)


def test_files_named_after_a_sensor_belong_to_it(tmp_path, rles):
    two = rles.model_copy(update={"lidars": {"left": rles.lidars["lidar"], "right": rles.lidars["lidar"]}})
    for name in ("recording.bag", "left.pcap", "right.pcap", "davis.aedat4", "notes.txt"):
        (tmp_path / name).touch()
    parts = list_parts(tmp_path, two, SourceOptions())
    read_as = [(path.name, given.lidar, given.camera, given.is_part) for path, given in parts]
    assert read_as == [
        (tmp_path.name, None, None, True),
        ("left.pcap", "left", None, True),
        ("right.pcap", "right", None, True),
        ("davis.aedat4", None, "davis", True),
    ]


@pytest.mark.parametrize(
    "files",
    [
        ("img/0.png", "pcd/0.pcd", "raw.h5"),
        ("a_0.mcap", "a_1.mcap"),
        ("a.mcap", "metadata.yaml"),
        ("0.png", "0.pcd"),
        (),
    ],
    ids=["pictures and clouds", "a bag in pieces", "a bag of ROS 2", "all in one", "empty"],
)
def test_other_folders_are_read_as_a_whole(tmp_path, rles, files):
    for name in files:
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).touch()
    options = SourceOptions()
    assert list_parts(tmp_path, rles, options) == [(tmp_path, options)]
    lone = tmp_path / "lone.pcap"
    assert list_parts(lone, rles, options) == [(lone, options)]


def fill_with_pictures(folder, place="webcam", n=5, torn=None):
    """Record a second of packets, and pictures named after their times, ten a second."""
    pictures = folder / place
    pictures.mkdir(parents=True)
    for k in range(n):
        file = pictures / f"{T0_NS // 10**9}.{k:01d}50000.jpg"
        cv2.imwrite(str(file), np.full((72, 128), 10 + k, np.uint8))
        if k == torn:
            file.write_bytes(file.read_bytes()[:100])
    record_packets(folder / "lidar.pcap")


@pytest.mark.parametrize("paths", [["."], ["lidar.pcap", "webcam"], ["webcam", "lidar.pcap"]])
def test_recorded_images_join_packets(tmp_path, rlfs, paths):
    fill_with_pictures(tmp_path / "day", torn=3)
    (joined,) = join_recordings(open_recordings([tmp_path / "day" / p for p in paths], rlfs), rlfs)
    samples = list(joined.samples())
    second_ns = T0_NS // 10**9 * 10**9
    images = [sample for sample in samples if isinstance(sample, Image)]
    assert [image.pixels.flat[0] for image in images] == [10, 11, 12, 14]
    assert [image.stamp_ns for image in images] == [second_ns + k * 10**8 + 5 * 10**7 for k in (0, 1, 2, 4)]
    assert 8 <= sum(isinstance(sample, Scan) for sample in samples) <= 10
    assert any(".350000.jpg" in note for note in joined.notes)


def test_recorded_folder_separates_two_days(tmp_path, rlfs):
    for day in ("monday", "tuesday"):
        fill_with_pictures(tmp_path / day)
    for file in (tmp_path / "tuesday/webcam").iterdir():
        file.rename(file.with_name(f"{int(file.name[:10]) + 86400}{file.name[10:]}"))
    joined = join_recordings(open_recordings([tmp_path / "monday", tmp_path / "tuesday"], rlfs), rlfs)
    assert len(joined) == 2
    list(check_overlap(joined[0].samples(), rlfs, []))  # type: ignore[attr-defined]
    with pytest.raises(SourceError):  # The packets are still monday's.
        list(check_overlap(joined[1].samples(), rlfs, []))  # type: ignore[attr-defined]


def test_recorded_images_without_scans_fail(tmp_path, rlfs):
    """Images without times fail, too."""
    fill_with_pictures(tmp_path)
    with pytest.raises(SourceError):
        open_recordings([tmp_path / "webcam"], rlfs)
    for k, file in enumerate(sorted((tmp_path / "webcam").iterdir())):
        file.rename(file.with_name(f"{k:05d}.jpg"))
    with pytest.raises(SourceError):
        open_recordings([tmp_path / "lidar.pcap", tmp_path / "webcam"], rlfs)
