"""Files of an event camera's own recorder as recordings: events, frames, and faults."""

from dataclasses import replace

import numpy as np
import pytest

from lce_rig.core.data import Events, Image, Stream
from lce_rig.core.errors import SourceError
from lce_rig.io.recording import serials_of
from lce_rig.rig import load_rig
from tests.io.events import encoders
from tests.io.events.aedat4_files import RawFrame, write_aedat4, write_davis
from tests.io.events.encoders import listed, random_events
from tests.io.events.test_files import WRITERS
from tests.io.rig_samples import opened
from tests.notes import has_note
from tests.shared import changed

T0_US = 1_700_000_000_000_000
EVENTS = replace(random_events(20_000, 3, start_us=T0_US, step_us=250), sensor="davis")
PIECES = [EVENTS.select(slice(k, k + 500)) for k in range(0, 20_000, 500)]
GREY = np.random.default_rng(0).integers(0, 256, (260, 346), dtype=np.uint8)
FRAMES = [RawFrame(T0_US + 40_000 * k, 8000, GREY) for k in range(5)]
EVENT_STREAM, FRAME_STREAM = Stream("davis", "events", "events"), Stream("davis", "frames", "images")


def events_of(recording):
    return [event for s in recording.samples() if isinstance(s, Events) for event in listed(s)]


def images_of(recording):
    return [s for s in recording.samples() if isinstance(s, Image)]


def test_davis_file_gives_events_and_frames(tmp_path, rles):
    recording = opened(write_davis(tmp_path / "a.aedat4", PIECES, FRAMES), rles)
    assert recording.n_samples >= 1  # by the size of the file, most of which are events
    assert set(recording.streams) == {EVENT_STREAM, FRAME_STREAM}
    assert events_of(recording) == listed(EVENTS)
    images = images_of(recording)
    assert [(i.sensor, i.channel) for i in images] == [("davis", "frames")] * 5
    assert [i.stamp_ns for i in images] == [(T0_US + 40_000 * k + 4000) * 1000 for k in range(5)]
    assert all(np.array_equal(i.pixels, GREY) for i in images)
    assert has_note(recording.notes, "a.aedat4", "davis.frames", "mid exposure", "8.0 ms")


def test_frames_alone_are_a_recording_too(tmp_path, rles):
    recording = opened(write_davis(tmp_path / "a.aedat4", [], FRAMES), rles)
    assert set(recording.streams) == {FRAME_STREAM} and len(images_of(recording)) == 5
    assert has_note(recording.notes, "no stream")


def test_davis_file_frames_need_a_channel(tmp_path, rles):
    channels = {"events": rles.cameras["davis"].channels["events"]}
    path = write_davis(tmp_path / "a.aedat4", PIECES, FRAMES)
    recording = opened(path, changed(rles, cameras__davis__channels=channels))
    assert images_of(recording) == [] and events_of(recording) == listed(EVENTS)
    assert has_note(recording.notes, "frames skipped", "davis", "no channel")


def test_davis_file_unordered_images_are_skipped_and_counted(tmp_path, rles):
    path = write_davis(
        tmp_path / "a.aedat4",
        PIECES,
        [FRAMES[0], replace(FRAMES[1], exposure_us=-90_000, style="dv"), FRAMES[2]],
    )
    recording = opened(path, rles)
    assert len(images_of(recording)) == 2
    assert has_note(recording.notes, "a.aedat4", "frames: 1")


@pytest.mark.parametrize("name", ["a.aedat4", "a.h5", "a.raw"])
def test_every_kind_of_file_is_opened_by_its_suffix(tmp_path, rles, name):
    WRITERS[name](tmp_path / name, EVENTS)
    assert len(events_of(opened(tmp_path / name, rles))) == len(EVENTS)


def test_event_file_serial_numbers_are_reported(tmp_path, rles):
    write_aedat4(tmp_path / "a.aedat4", [EVENTS], "DAVIS346_00000499")
    local = [(t - T0_US, x, y, p) for t, x, y, p in listed(EVENTS)]
    head = b"% evt 3.0\n% geometry 346x260\n% serial_number 00050423\n% end\n"
    (tmp_path / "b.raw").write_bytes(head + encoders.evt3(local))
    write_aedat4(tmp_path / "c.aedat4", [EVENTS])
    found = [serials_of(opened(tmp_path / name, rles)) for name in ("a.aedat4", "b.raw", "c.aedat4")]
    assert found == [{"davis": "00000499"}, {"davis": "00050423"}, {}]


def test_event_file_misfits_are_refused(tmp_path, rles):
    write_aedat4(tmp_path / "none.aedat4", [])
    write_aedat4(tmp_path / "a.aedat4", [EVENTS])
    with pytest.raises(SourceError, match=r"none\.aedat4"):
        opened(tmp_path / "none.aedat4", rles)
    with pytest.raises(SourceError, match="346x260"):
        opened(tmp_path / "a.aedat4", changed(rles, cameras__davis__resolution_px=(640, 480)))
    with pytest.raises(SourceError) as caught:
        opened(tmp_path / "a.aedat4", load_rig("rlfs"))
    assert "kind: events" in caught.value.hint
    with pytest.raises(SourceError):
        opened(tmp_path / "a.aedat4", rles, camera="left")


def test_event_file_takes_first_camera(tmp_path, rles):
    write_aedat4(tmp_path / "a.aedat4", [EVENTS])
    both = changed(rles, cameras__right=rles.cameras["davis"])
    assert has_note(opened(tmp_path / "a.aedat4", both).notes, "events assigned", "camera davis")
    right = opened(tmp_path / "a.aedat4", both, camera="right")
    assert {s.sensor for s in right.samples()} == {"right"} and next(iter(right.streams)).sensor == "right"


def test_davis_torn_file_gives_its_beginning(tmp_path, rles):
    whole = write_davis(tmp_path / "whole.aedat4", PIECES, FRAMES).read_bytes()
    (tmp_path / "torn.aedat4").write_bytes(whole[: len(whole) * 3 // 5])
    recording = opened(tmp_path / "torn.aedat4", rles)
    found, images = events_of(recording), images_of(recording)
    assert 0 < len(found) < len(EVENTS) and found == listed(EVENTS)[: len(found)] and 1 <= len(images) < 5
    assert has_note(recording.notes, "1 torn ends")
