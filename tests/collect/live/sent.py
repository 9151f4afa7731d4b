"""Samples sent by a rig on the wire, compared with those stored in the session."""

import json
import re
import struct
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from wire.timing import LOOP_NS, PACKET_NS, placement_at

from lce_rig.core import velodyne
from lce_rig.core.data import Scan
from lce_rig.io.velodyne_scans import Vlp16Stream
from lce_rig.session import Session
from tests.collect.live.conftest import LOOPS_PER_HOLD


@dataclass(frozen=True, eq=False)
class Sent:
    """Pictures (N, H, W) and scans of each placement, as they leave the senders."""

    pictures: list[NDArray[np.uint8]]
    scans: list[list[Scan]]


def read_sent(reel, lidar):
    """Decode a reel without any transport."""
    shape = reel.n_pictures, 260, 346
    pictures = [
        np.frombuffer(b"".join(reel.pictures("cam", k)), np.uint8).reshape(shape)
        for k in range(reel.n_placements)
    ]
    return Sent(pictures, [_decode(reel.packets(k), lidar) for k in range(reel.n_placements)])


def check_whole(session):
    """Read every file of every listed capture, and make sure that the journal lists no other."""
    opened = Session.open(session)
    captures = opened.captures
    for capture in captures:
        capture.check()
        assert capture.image_keys and capture.lidars
    names = [entry["capture"] for entry in opened.read_journal() if entry["event"] == "captured"]
    assert set(names) <= {capture.name for capture in captures}
    return captures


def check_sent(capture, sent):
    """Return the placement whose sent samples equal those of a capture bit for bit."""
    scan, image = capture.scan("lidar"), capture.image("cam", "frames")
    shown = [k for k, pictures in enumerate(sent.pictures) if (pictures == image.pixels).all((1, 2)).any()]
    seen = [k for k, scans in enumerate(sent.scans) if any(_are_alike(scan, each) for each in scans)]
    assert len(shown) == 1 and shown == seen
    return shown[0]


def check_stamps(capture, placement, n_placements):
    """Make sure that a capture's stamps lie where its placement was shown."""
    stamp_ns, image = capture.scan("lidar").stamp_ns, capture.image("cam", "frames")
    assert stamp_ns is not None and image.stamp_ns is not None
    assert placement_at(stamp_ns, LOOPS_PER_HOLD, n_placements) == placement
    # Scans begin with a loop, or a revolution or two later; the counter shows whole microseconds.
    late_ns = stamp_ns % (LOOP_NS // 3)
    assert min(late_ns, LOOP_NS // 3 - late_ns) < 2_000
    assert abs(apart_s(capture)) < 0.05


def apart_s(capture, camera="cam"):
    """Measure how far a capture's image lies from the middle of its scan."""
    scan = capture.scan("lidar")
    half_ns = 50_000_000 if scan.offset_ns is None else int(scan.offset_ns.max()) // 2
    return (capture.image(camera, "frames").stamp_ns - scan.stamp_ns - half_ns) * 1e-9


def captured_names(said):
    """List the captures reported as saved."""
    return re.findall(r"captured (\d{6}) \(", said)


def errors(said):
    """List the errors that were printed."""
    return [line for line in said.splitlines() if line.startswith("error:")]


def journal_of(session):
    """Read how each run ended."""
    lines = (session / "journal.jsonl").read_text().splitlines()
    return [entry for entry in map(json.loads, lines) if entry["event"] == "collected live"]


def _decode(packets, lidar):
    """Decode a loop of three revolutions, with its beginning behind it to close the last."""
    stream, scans = Vlp16Stream("lidar", lidar), []
    for k, packet in enumerate([*packets, *packets]):
        us = (k * PACKET_NS // 1000) % velodyne.HOUR_US
        timed = packet[:1200] + struct.pack("<I", us) + packet[1204:]
        scan = stream.push_data(timed, 10**18 + k * PACKET_NS)
        if scan is not None:
            scans.append(scan)
    assert len(scans) >= 3
    return scans


def _are_alike(a, b):
    return a.points.shape == b.points.shape and bool(
        (a.points == b.points).all() and (a.ring == b.ring).all()
    )
