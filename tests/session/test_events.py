"""A session keeps the raw events about each capture, exactly, and vouches for them."""

import hashlib
import json
from dataclasses import replace

import numpy as np
import pytest

from lce_rig.core.data import Events, Image, Scan
from lce_rig.core.errors import SessionError
from lce_rig.session import Session, content_hash

T0_NS = 1_700_000_000_123_456_000
FILE = "davis.events.npz"


def noise_events(seed, n=500):
    rng = np.random.default_rng(seed)
    t_ns = T0_NS + 1000 * np.sort(rng.integers(0, 1_350_000, n))
    x, y = rng.integers(0, 346, n).astype(np.uint16), rng.integers(0, 260, n).astype(np.uint16)
    return Events("davis", t_ns, x, y, rng.random(n) < 0.5, 346, 260, T0_NS + 77)


def noise_samples(seed):
    rng = np.random.default_rng(seed)
    pixels = rng.integers(0, 256, (24, 32), dtype=np.uint8)
    points = rng.normal(size=(50, 3)).astype(np.float32)
    scan = Scan("lidar", T0_NS, points, np.zeros(50, np.float32), np.zeros(50, np.int16))
    return [Image("davis", "frames", T0_NS, pixels)], [scan]


def make_session(path, rles):
    """A session with one capture that has events and one that has none."""
    session = Session.create(path, rles)
    session.add_capture(*noise_samples(0), {}, [noise_events(0)])
    session.add_capture(*noise_samples(1), {})
    return session


def assert_equal(found, given):
    for column in ("t_ns", "x", "y", "polarity"):
        assert getattr(found, column).dtype == getattr(given, column).dtype
        assert np.array_equal(getattr(found, column), getattr(given, column)), column
    for name in ("sensor", "width_px", "height_px", "host_ns"):
        assert getattr(found, name) == getattr(given, name), name


def test_events_come_back_to_the_microsecond(tmp_path, rles):
    make_session(tmp_path / "s", rles).close()
    with_events, without = Session.open(tmp_path / "s").captures
    assert_equal(with_events.events("davis"), noise_events(0))
    assert (with_events.event_cameras, without.event_cameras) == (["davis"], [])
    assert with_events.image_keys == [("davis", "frames")], "a picture of events is made at detection"
    with_events.check()


def test_event_file_is_hashed_in_manifest(tmp_path, rles):
    capture = make_session(tmp_path / "s", rles).captures[0]
    events, data = noise_events(0), (capture.path / FILE).read_bytes()
    with np.load(capture.path / FILE) as archive:
        assert np.array_equal(archive["t_us"] * 1000, events.t_ns)
    manifest = json.loads((capture.path / "meta.json").read_text())
    assert manifest["files"][-1] == {
        "kind": "events",
        "camera": "davis",
        "channel": "events",
        "file": FILE,
        "bytes": len(data),
        "sha256": hashlib.sha256(data).hexdigest(),
        "first_ns": int(events.t_ns[0]),
        "last_ns": int(events.t_ns[-1]),
        "host_ns": events.host_ns,
    }


def test_captures_without_events_keep_format(tmp_path, rles):
    captures = make_session(tmp_path / "s", rles).captures
    manifests = [json.loads((capture.path / "meta.json").read_text()) for capture in captures]
    assert [manifest["format_version"] for manifest in manifests] == [2, 1]
    assert sorted(path.name for path in captures[1].path.iterdir()) == [
        "davis.frames.png", "lidar.pcd", "meta.json",
    ]  # fmt: skip
    assert captures[1].content_sha256 == content_hash(*noise_samples(1))


def test_captures_of_other_events_are_new(tmp_path, rles):
    session = make_session(tmp_path / "s", rles)
    images, scans = noise_samples(0)
    events = noise_events(0)
    later = replace(events, t_ns=events.t_ns + 5_000_000_000, host_ns=None)
    assert session.find_duplicate(images, scans, [later]) == "000000", "stamps are left aside"
    assert session.find_duplicate(images, scans) is None
    for other in (
        noise_events(7),
        replace(events, polarity=~events.polarity),
        replace(events, t_ns=np.append(events.t_ns[:-1], events.t_ns[-1] + 1000)),
    ):
        assert session.find_duplicate(images, scans, [other]) is None
    session.close()
    assert Session.open(tmp_path / "s").find_duplicate(images, scans, [events]) == "000000"


@pytest.mark.parametrize(
    "changes",
    [
        {"sensor": "front"},
        {"width_px": 640, "height_px": 480},
        {"t_ns": noise_events(0).t_ns[::-1]},
        {"x": np.full(500, 346, np.uint16)},
    ],
)
def test_events_of_another_rig_are_refused(tmp_path, rles, changes):
    session = Session.create(tmp_path / "s", rles)
    with pytest.raises(SessionError):
        session.add_capture(*noise_samples(0), {}, [replace(noise_events(0), **changes)])
    assert list((tmp_path / "s" / "captures").iterdir()) == []
