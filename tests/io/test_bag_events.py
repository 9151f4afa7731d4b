"""Raw events in bags beside images and scans: topics, order, clocks, and faults."""

from dataclasses import replace

import numpy as np
import pytest

from lce_rig.core.data import Events, Image, Scan, Stream
from lce_rig.core.errors import SourceError
from lce_rig.io.ros.bag_recorder import open_bag_writer
from lce_rig.timing.scan_pairing import rig_time_ns
from tests.io.events.encoders import listed
from tests.notes import has_note
from tests.shared import changed

from .rig_samples import KINDS, T0_NS, one_second, opened, picture, record, sweep

SIZE = (346, 260)


def events_of(samples):
    return [event for sample in samples if isinstance(sample, Events) for event in listed(sample)]


def with_topic(rles, topic):
    return changed(rles, cameras__davis__channels__events__topic=topic)


@pytest.mark.parametrize("name", KINDS)
def test_bag_events_come_in_order_of_time(tmp_path, rles, name):
    given = one_second()
    recording = opened(record(tmp_path / name, rles, given), rles)
    samples = list(recording.samples())
    assert events_of(samples) == events_of(given)
    assert {e.sensor for e in samples if isinstance(e, Events)} == {"davis"}
    assert [sum(isinstance(s, kind) for s in samples) for kind in (Image, Scan)] == [20, 10]
    assert recording.n_samples == 30
    assert {str(stream): stream.kind for stream in recording.streams} == {
        "davis.events": "events", "davis.frames": "images", "lidar": "scans"
    }  # fmt: skip
    # Scans are received 0.1 s after their first firing; nothing is handed out later than that.
    times_ns = np.array([rig_time_ns(sample, rles) for sample in samples])
    assert (np.maximum.accumulate(times_ns) - times_ns).max() <= 110_000_000


def test_bag_reconstructed_images_are_events(tmp_path, rles):
    images = [replace(picture(k), channel="events") for k in range(3)]
    recording = opened(record(tmp_path / "r.bag", rles, [*images, sweep(0), sweep(1)]), rles)
    assert [s.channel for s in recording.samples() if isinstance(s, Image)] == ["events"] * 3
    assert recording.streams == {Stream("davis", "events", "images"), Stream("lidar", "", "scans")}


def test_bag_only_event_topic_is_taken(tmp_path, rles):
    path = record(tmp_path / "r.bag", rles, one_second(50))
    open_rig = with_topic(rles, None)
    recording = opened(path, open_rig)
    assert has_note(recording.notes, "r.bag", "davis.events", "/davis/events", "only topic")
    assert len(events_of(list(recording.samples()))) == 2500
    asked = opened(path, with_topic(rles, "/elsewhere"), topics={"davis.events": "/davis/events"})
    assert Stream("davis", "events", "events") in asked.streams
    for wrong in ("/nowhere", "/velodyne_points"):
        with pytest.raises(SourceError, match=wrong):
            opened(path, rles, topics={"davis.events": wrong})


def test_bag_single_sensor_is_part_only(tmp_path, rles):
    samples = one_second(50)
    for name, kind in (("events", Events), ("scans", Scan), ("images", Image)):
        path = record(tmp_path / f"{name}.bag", rles, [s for s in samples if isinstance(s, kind)])
        with pytest.raises(SourceError):
            opened(path, rles)
        part = opened(path, rles, is_part=True)
        assert [stream.kind for stream in part.streams] == [name]
        assert all(isinstance(sample, kind) for sample in part.samples())
    nothing = record(tmp_path / "other.bag", rles, [sweep(0)])
    with pytest.raises(SourceError) as caught:
        opened(nothing, changed(rles, lidars__lidar__topic="/other"), is_part=True)
    assert has_note([caught.value.hint], "/velodyne_points", "PointCloud2, 1")


def test_bag_empty_event_topic_reads_images(tmp_path, rles):
    from lce_rig.io.ros.bag_recorder import encode_image, encode_scan
    from lce_rig.io.ros.messages import EVENT_ARRAY_TYPE, typestore

    def write(path, has_pictures):
        with open_bag_writer(path) as writer:
            store = typestore(True)
            writer.add_connection("/davis/events", EVENT_ARRAY_TYPE, typestore=store)
            cloud = writer.add_connection("/velodyne_points", "sensor_msgs/msg/PointCloud2", typestore=store)
            writer.write(cloud, T0_NS, encode_scan(sweep(0), rles.lidars["lidar"], True))
            if has_pictures:
                image = writer.add_connection("/davis/image_raw", "sensor_msgs/msg/Image", typestore=store)
                writer.write(image, T0_NS, encode_image(picture(0), "davis", True))
        return path

    recording = opened(write(tmp_path / "a.bag", True), rles)
    assert has_note(recording.notes, "/davis/events", "a.bag", "no events")
    assert [type(sample) for sample in recording.samples()] == [Scan, Image]
    with pytest.raises(SourceError, match="/davis/events") as caught:
        opened(write(tmp_path / "b.bag", False), rles)
    assert has_note([caught.value.hint], "/davis/events", "EventArray, 0")
