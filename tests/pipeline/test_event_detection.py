"""Images are reconstructed once from raw events, at the time of the board in the scan."""

from dataclasses import replace

import numpy as np
import pytest

import lce_rig as lce
from lce_rig.core.data import Image, Scan
from lce_rig.core.findings import Refusal
from lce_rig.core.results import ImageBoard
from lce_rig.pipeline.detect_session import event_picture, picture_stamp_ns
from lce_rig.rig import load_rig, parse_rig
from lce_rig.session import Session
from tests.calibrate.boards import simulate
from tests.detect.moving_board import CENTRE_PX, HEIGHT_PX, WIDTH_PX, Motion, board_events

MS = 1_000_000
T0_NS = 1_700_000_000_000_000_000
SCAN_NS = T0_NS + 1_150 * MS
PROFILE = f"""
format_version: 1
name: small
board: {{inner_corners: [6, 4], square_m: 0.07, width_m: 0.546, height_m: 0.406}}
lidars:
  lidar: {{frame: velodyne, timestamps: {{reference: first_firing, expected_offset_s: 0.0}}}}
cameras:
  dvs:
    resolution_px: [{WIDTH_PX}, {HEIGHT_PX}]
    intrinsics: {{fx_px: 200, fy_px: 200, cx_px: {CENTRE_PX[0]}, cy_px: {CENTRE_PX[1]}}}
    channels:
      events: {{kind: events, timestamps: {{reference: mid_exposure, expected_offset_s: 0.0}}}}
"""


@pytest.fixture(scope="module")
def stream():
    events = board_events(Motion(), 1.4, threshold=0.6)
    return replace(events, sensor="dvs", t_ns=events.t_ns + T0_NS)


def bare_scan(stamp_ns=SCAN_NS):
    points = np.random.default_rng(0).normal(size=(50, 3)).astype(np.float32) + [5, 0, 0]
    return Scan(
        "lidar", stamp_ns, points.astype(np.float32), np.zeros(50, np.float32), np.zeros(50, np.int16)
    )


def session_of(folder, events, profile=PROFILE, **more):
    with Session.create(folder / "session", parse_rig(profile)) as session:
        scan = bare_scan(more.pop("stamp_ns", SCAN_NS))
        session.add_capture(more.pop("images", []), [scan], {}, [events])
    return session


def found_in(session, **more):
    return lce.detect_boards(session, **more).images["dvs", "events"]["000000"]


@pytest.fixture(scope="module")
def seen(tmp_path_factory, stream):
    session = session_of(tmp_path_factory.mktemp("seen"), stream)
    assert isinstance(found_in(session), ImageBoard)
    return session


def test_event_board_is_found_at_mid_scan(seen):
    board = found_in(seen)
    assert board.stamp_ns == SCAN_NS + 50 * MS
    assert len(board.track_ns) == 4
    assert board.events.events_px_s > 5


def test_event_detection_and_image_are_cached(seen):
    files = sorted((seen.path / "detections").rglob("*.npz"))
    kinds = sorted(file.name.split(".", 1)[1] for file in files)
    assert kinds == ["dvs.events.npz", "dvs.events.picture.npz", "lidar.npz"]
    changed = [file.stat().st_mtime_ns for file in files]
    picture = event_picture(seen, seen.captures[0], "dvs", "events")
    assert (picture.sensor, picture.channel, picture.stamp_ns) == ("dvs", "events", SCAN_NS + 50 * MS)
    found_in(seen)
    assert sorted((seen.path / "detections").rglob("*.npz")) == files
    assert [file.stat().st_mtime_ns for file in files] == changed


def test_event_time_applies_clock_offsets(tmp_path, stream):
    profile = PROFILE.replace("first_firing, expected_offset_s: 0.0", "first_firing, expected_offset_s: 0.02")
    profile = profile.replace("mid_exposure, expected_offset_s: 0.0", "mid_exposure, expected_offset_s: 3.5")
    early = replace(stream, t_ns=stream.t_ns - 3_480 * MS)
    board = found_in(session_of(tmp_path, early, profile))
    assert board.stamp_ns == SCAN_NS + 50 * MS + 20 * MS - 3_500 * MS


def test_event_time_is_median_of_first_board(seen):
    rig = load_rig("rles")
    lidar = replace(simulate(1, 0)[0].lidar, stamp_ns=SCAN_NS)
    offset_ns = 31 * MS + np.arange(len(lidar.points))
    timed = replace(lidar, offset_ns=offset_ns)
    capture = seen.captures[0]

    def stamp(lidars):
        return picture_stamp_ns(rig, capture, "davis", "events", lidars)

    assert stamp({"lidar": [timed, lidar]}) == SCAN_NS + round(np.median(offset_ns))
    assert stamp({"lidar": [lidar]}) == SCAN_NS + 50 * MS
    assert stamp({"lidar": Refusal("lidar.no_plate")}) == SCAN_NS + 50 * MS
    assert stamp({}) is None


def test_other_scan_gives_another_image(tmp_path, stream):
    first = found_in(session_of(tmp_path / "a", stream))
    other = session_of(tmp_path / "b", stream, stamp_ns=SCAN_NS - 40 * MS)
    # The cache travels along: the samples are the same, only the stamp is not.
    (tmp_path / "a" / "session" / "detections").rename(other.path / "detections")
    assert first.stamp_ns - found_in(other).stamp_ns == 40 * MS


def test_a_stored_picture_is_taken(tmp_path, stream):
    blank = Image("dvs", "events", SCAN_NS, np.full((HEIGHT_PX, WIDTH_PX), 128, np.uint8))
    session = session_of(tmp_path, stream, images=[blank])
    assert found_in(session).code == "image.low_contrast"


def test_damaged_events_are_refused_as_damaged(tmp_path, stream):
    session = session_of(tmp_path, stream)
    path = session.captures[0].path / "dvs.events.npz"
    path.write_bytes(path.read_bytes()[:-100])
    board = found_in(session)
    assert board.code == "read.error" and "damaged" in board.figures["what"]
