"""A session stores data exactly, and has one writer at a time."""

import json

import numpy as np
import pytest

from lce_rig.core.data import Image, Scan
from lce_rig.core.errors import SessionError
from lce_rig.rig import dump_rig, load_rig
from lce_rig.session import Session, discard_if_empty
from lce_rig.session.durable import load_arrays, store_arrays
from tests.shared import changed


def test_capture_is_read_exactly_as_written(tmp_path, rig, samples):
    images, scans = samples(1)
    with Session.create(tmp_path / "s", rig) as session:
        name = session.add_capture(images, scans, {"source": {"key": "k"}})
    (capture,) = Session.open(tmp_path / "s").captures
    image, scan = capture.image("cam", "frames"), capture.scan("lidar")
    assert (name, capture.name, capture.meta) == ("000000", "000000", {"source": {"key": "k"}})
    assert np.array_equal(image.pixels, images[0].pixels)
    assert (image.stamp_ns, scan.stamp_ns, scan.host_ns) == (10**18 + 1, 10**18 + 1, 10**18 + 6)
    for field in ("points", "intensity", "ring", "offset_ns"):
        given, read = getattr(scans[0], field), getattr(scan, field)
        assert given.dtype == read.dtype and np.array_equal(given, read), field


@pytest.mark.parametrize("offsets", [[-5, 7], [0, 2**40], [0, 2**32 - 1]])
def test_times_of_any_size_survive(tmp_path, rig, offsets):
    scan = Scan("lidar", 0, np.ones((2, 3), np.float32), np.zeros(2, np.float32), np.zeros(2, np.int16),
                np.array(offsets, dtype=np.int64))  # fmt: skip
    session = Session.create(tmp_path / "s", rig)
    session.add_capture([], [scan], {})
    assert session.captures[0].scan("lidar").offset_ns.tolist() == offsets


def test_other_rig_names_differing_keys(tmp_path, rig, samples):
    with Session.create(tmp_path / "s", rig) as session:
        session.add_capture(*samples(0), {})
    text = dump_rig(rig).replace("square_m: 0.07", "square_m: 0.06")
    (tmp_path / "other.yaml").write_text(text)
    with pytest.raises(SessionError, match=r"board\.square_m"):
        Session.resume(tmp_path / "s", load_rig(tmp_path / "other.yaml"))
    with pytest.raises(SessionError):
        Session.resume(tmp_path / "s", load_rig("rles"))
    Session.resume(tmp_path / "s", rig).close()


def test_a_session_without_captures_takes_another_profile(tmp_path, rig):
    Session.create(tmp_path / "s", rig).close()
    Session.resume(tmp_path / "s", load_rig("rles")).close()
    assert Session.open(tmp_path / "s").rig == load_rig("rles")


def test_resume_other_driver_is_accepted(tmp_path, rig, samples):
    with Session.resume(tmp_path / "s", rig) as session:
        session.add_capture(*samples(0), {})
    moved = changed(rig, cameras__cam__driver__device="/dev/video7")
    with Session.resume(tmp_path / "s", moved) as session:
        assert session.rig == moved and len(session.captures) == 1
    assert Session.open(tmp_path / "s").rig.cameras["cam"].driver.device == "/dev/video7"


def test_discard_only_an_empty_session(tmp_path, rig, samples):
    for name in ("empty", "captured", "noted"):
        with Session.create(tmp_path / name, rig) as session:
            if name == "captured":
                session.add_capture(*samples(0), {})
    (tmp_path / "noted" / "truth.json").write_text("{}")
    assert discard_if_empty(tmp_path / "empty") and not (tmp_path / "empty").exists()
    for name in ("captured", "noted", "never"):
        assert not discard_if_empty(tmp_path / name)
    assert len(Session.open(tmp_path / "captured").captures) == 1
    assert Session.open(tmp_path / "noted").captures == []


def test_session_allows_one_writer_and_many_readers(tmp_path, rig, samples):
    first = Session.create(tmp_path / "s", rig)
    with pytest.raises(SessionError):
        Session.resume(tmp_path / "s", rig)
    with pytest.raises(SessionError):
        Session.open(tmp_path / "s").add_capture(*samples(0), {})
    first.close()
    Session.resume(tmp_path / "s", rig).close()


def test_folders_without_session_are_unchanged(tmp_path, rig):
    (tmp_path / "notes.txt").write_text("mine")
    with pytest.raises(SessionError, match=r"notes\.txt"):
        Session.create(tmp_path, rig)
    with pytest.raises(SessionError):
        Session.open(tmp_path)
    assert [p.name for p in tmp_path.iterdir()] == ["notes.txt"]


def test_resume_cut_creation_starts_again(tmp_path, rig):
    Session.create(tmp_path / "s", rig).close()
    (tmp_path / "s" / "session.json").unlink()
    Session.resume(tmp_path / "s", rig).close()
    assert Session.open(tmp_path / "s").captures == []


@pytest.mark.parametrize(
    "text", ["", "{}", "[]", '{"format_version": "x"}', '{"format_version": 99}', "\x00"]
)
def test_a_damaged_marker_is_named(tmp_path, rig, text):
    Session.create(tmp_path / "s", rig).close()
    (tmp_path / "s" / "session.json").write_text(text)
    with pytest.raises(SessionError):
        Session.open(tmp_path / "s")


def test_a_damaged_profile_is_a_session_error(tmp_path, rig):
    Session.create(tmp_path / "s", rig).close()
    (tmp_path / "s" / "rig.yaml").write_text("format_version: 1\nname: [")
    with pytest.raises(SessionError, match=r"rig\.yaml"):
        Session.open(tmp_path / "s")


def test_sensors_that_the_rig_lacks_are_refused(tmp_path, rig, samples):
    images, scans = samples(0)
    session = Session.create(tmp_path / "s", rig)
    with pytest.raises(SessionError, match=r"cam\.events"):
        session.add_capture([Image("cam", "events", None, images[0].pixels)], scans, {})
    with pytest.raises(SessionError):
        session.add_capture(
            images, [Scan("top", None, scans[0].points, scans[0].intensity, scans[0].ring)], {}
        )
    with pytest.raises(SessionError):
        session.add_capture(images * 2, scans, {})
    assert session.captures == []


def test_duplicate_data_is_recognised_despite_timestamps(tmp_path, rig, samples):
    images, scans = samples(5)
    session = Session.create(tmp_path / "s", rig)
    session.add_capture(*samples(4), {})
    session.add_capture(images, scans, {})
    again = Image("cam", "frames", 7, images[0].pixels.copy())
    assert session.find_duplicate([again], scans) == "000001"
    assert session.find_duplicate(*samples(6)) is None
    session.close()
    assert Session.open(tmp_path / "s").find_duplicate([again], scans) == "000001"


def test_the_journal_is_appended_and_a_torn_line_is_skipped(tmp_path, rig):
    session = Session.create(tmp_path / "s", rig)
    with (tmp_path / "s" / "journal.jsonl").open("ab") as file:
        file.write(b'[1]\n{"event"\n\xff\n{"event": "tor')
    session.journal("collected", captured=3)
    assert [e["event"] for e in session.read_journal()] == ["created", "collected"]
    assert session.read_journal()[-1]["captured"] == 3


def test_load_arrays_damage_is_never_wrong(tmp_path):
    file = tmp_path / "detections" / "abc" / "000000.npz"
    arrays = {"b": np.arange(6).reshape(2, 3), "a": np.array([1.5])}
    assert store_arrays(file, arrays)
    whole = file.read_bytes()
    for k in range(0, 8 * len(whole), 37):
        damaged = bytearray(whole)
        damaged[k // 8] ^= 1 << k % 8
        for content in (bytes(damaged), whole[: k // 8]):
            file.write_bytes(content)
            read = load_arrays(file)
            assert read is None or all(
                np.array_equal(read[name], a) for name, a in arrays.items() if name in read
            )
    assert load_arrays(file.with_name("000001.npz")) is None


def test_invalid_metadata_is_refused_without_files(tmp_path, rig, samples):
    session = Session.create(tmp_path / "s", rig)
    with pytest.raises(SessionError):
        session.add_capture(*samples(0), {"x": float("nan")})
    assert list((tmp_path / "s" / "captures").iterdir()) == []
    assert json.loads((tmp_path / "s" / "session.json").read_text())["rig"] == "rlfs"
