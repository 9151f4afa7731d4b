"""From recordings with raw events to captures, end to end, against the truth of the simulator."""

from dataclasses import replace

import numpy as np
import pytest

from lce_rig.collect.offline import collect
from lce_rig.core.data import Events, Image
from lce_rig.core.errors import SourceError
from lce_rig.core.geometry import rotation_angle
from lce_rig.core.results import ImageBoard
from lce_rig.detect.events.reconstructor import Reconstructor
from lce_rig.detect.events.search import find_event_board
from lce_rig.io import SourceOptions, open_recording
from lce_rig.session import Session
from tests.io.events.aedat4_files import RawFrame, write_aedat4, write_davis

from . import simulated_moves as moves

EXPOSURE_US = 8000


def run(folder, *paths):
    options = SourceOptions(is_part=len(paths) > 1)
    with Session.resume(folder, moves.rig()) as session:
        recordings = [open_recording(path, session.rig, options) for path in paths]
        return session, collect(session, recordings)


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    return moves.bag(tmp_path_factory.mktemp("whole") / "whole.bag", list(moves.samples()))


@pytest.fixture(scope="module")
def lidar(tmp_path_factory):
    return moves.bag(tmp_path_factory.mktemp("lidar") / "lidar.bag", moves.without(Image, Events))


@pytest.fixture(scope="module")
def collected(tmp_path_factory, whole):
    return run(tmp_path_factory.mktemp("collected") / "s", whole)


def whole_stream():
    parts = moves.events()
    columns = {n: np.concatenate([getattr(e, n) for e in parts]) for n in ("t_ns", "x", "y", "polarity")}
    return replace(parts[0], **columns, host_ns=None)


def off_truth(T_cam_board, stamp_ns):
    """Distance in m, and angle in rad, of a pose from the true one; the print may be read upside down."""
    truth = moves.recording().T_sensor_board("davis", stamp_ns)
    turns = [
        rotation_angle(T_cam_board[:3, :3] @ flip, truth[:3, :3])
        for flip in (np.eye(3), np.diag([-1, -1, 1]))
    ]
    return float(np.linalg.norm(T_cam_board[:3, 3] - truth[:3, 3])), float(min(turns))


def test_collect_slow_board_has_its_events(collected):
    session, report = collected
    assert report.captured == ["000000"] and not report.errors and report.has_events
    (capture,) = session.captures
    assert (capture.image_keys, capture.lidars) == ([("davis", "frames")], ["lidar"])
    scan, image, events = capture.scan("lidar"), capture.image("davis", "frames"), capture.events("davis")
    truth = whole_stream().between(
        scan.stamp_ns - 1_200_000_000, scan.stamp_ns + int(scan.offset_ns.max()) + 150_000_000
    )
    for name in ("t_ns", "x", "y", "polarity"):
        assert np.array_equal(getattr(events, name), getattr(truth, name)), name
    assert abs(image.stamp_ns - scan.stamp_ns - 50_000_000) < 1_000_000
    distance_m, angle_rad = off_truth(np.array(capture.meta["T_cam_board"]["davis.frames"]), image.stamp_ns)
    assert distance_m < 0.02 and angle_rad < np.radians(2)
    speed_mps = capture.meta["speed_mps"]
    assert speed_mps == pytest.approx(float(moves.recording().trajectory.speed_mps(image.stamp_ns)), abs=0.06)
    assert 1 < capture.meta["events_px"] < 50


def test_collect_davis_file_equals_bag(tmp_path, collected, lidar):
    frames = [s for s in moves.samples() if isinstance(s, Image)]
    raw = [RawFrame(f.stamp_ns // 1000 - EXPOSURE_US // 2, EXPOSURE_US, f.pixels) for f in frames]
    file = write_davis(tmp_path / "davis.aedat4", moves.events(), raw)
    session, report = run(tmp_path / "s", lidar, file)
    assert report.captured == ["000000"]
    one, other = session.captures[0], collected[0].captures[0]
    assert one.content_sha256 == other.content_sha256
    for read in (lambda c: c.image("davis", "frames").stamp_ns, lambda c: c.scan("lidar").stamp_ns):
        assert read(one) == read(other)
    assert np.array_equal(one.events("davis").t_ns, other.events("davis").t_ns)
    _, again = run(tmp_path / "s", file, lidar)
    assert (again.captured, again.n_known) == ([], 1)


@pytest.mark.long
def test_collect_events_only_keeps_no_image(tmp_path, lidar):
    write_aedat4(tmp_path / "events.aedat4", _with_hot_pixels(moves.events()))
    session, report = run(tmp_path / "s", lidar, tmp_path / "events.aedat4")
    assert report.captured == ["000000"]
    (capture,) = session.captures
    assert (capture.image_keys, capture.event_cameras) == ([], ["davis"])
    middle_ns = capture.scan("lidar").stamp_ns + 50_000_000
    distance_m, angle_rad = off_truth(np.array(capture.meta["T_cam_board"]["davis.events"]), middle_ns)
    assert distance_m < 0.03 and angle_rad < np.radians(3)
    # What was kept is enough to see the board again, from a cold start.
    rig = session.rig
    _, board = find_event_board(
        capture.events("davis"),
        middle_ns,
        Reconstructor(),
        rig.board.to_board(),
        rig.cameras["davis"].to_intrinsics(),
        rig.quality,
    )
    assert isinstance(board, ImageBoard) and off_truth(board.T_cam_board, middle_ns)[0] < 0.03


def _with_hot_pixels(packets):
    """Twenty pixels that fire 300 times a second, whatever they see."""
    rng = np.random.default_rng(0)
    x, y = rng.integers(0, 346, 20).astype(np.uint16), rng.integers(0, 260, 20).astype(np.uint16)
    mixed = []
    for packet in packets:
        t_ns = np.arange(packet.t_ns[0], packet.t_ns[-1], 3_333_000)
        which = np.arange(len(t_ns) * 20) % 20
        noise = replace(packet, t_ns=np.repeat(t_ns, 20), x=x[which], y=y[which], polarity=which % 2 < 1)
        names = ("t_ns", "x", "y", "polarity")
        joined = {n: np.concatenate([getattr(packet, n), getattr(noise, n)]) for n in names}
        mixed.append(replace(packet, **joined).select(np.argsort(joined["t_ns"], kind="stable")))
    return mixed


def test_collect_torn_file_keeps_captures(tmp_path, lidar):
    frames = [s for s in moves.samples() if isinstance(s, Image)]
    raw = [RawFrame(f.stamp_ns // 1000 - EXPOSURE_US // 2, EXPOSURE_US, f.pixels) for f in frames]
    file = write_davis(tmp_path / "davis.aedat4", moves.events(), raw)
    file.write_bytes(file.read_bytes()[: int(0.9 * file.stat().st_size)])
    _, report = run(tmp_path / "s", lidar, file)
    assert report.captured == ["000000"] and not report.errors
    assert any("torn ends" in note for note in report.notes)


@pytest.mark.long
def test_non_overlapping_clocks_are_an_error(tmp_path, lidar):
    late = [replace(e, t_ns=e.t_ns + 1_234_500_000_000) for e in moves.events()]
    write_aedat4(tmp_path / "late.aedat4", late)
    with pytest.raises(SourceError, match=r"davis\.events"):
        run(tmp_path / "s", lidar, tmp_path / "late.aedat4")
    # What can be read of the others is captured all the same.
    good = moves.bag(tmp_path / "good.bag", list(moves.samples()))
    _, report = run(tmp_path / "s", good, lidar, tmp_path / "late.aedat4")
    assert report.captured == ["000000"] and len(report.errors) == 1


def test_captures_with_late_events_are_kept(tmp_path):
    start_ns = moves.recording().start_ns + 900_000_000
    late = [s for s in moves.samples() if not isinstance(s, Events) or s.t_ns[0] >= start_ns]
    session, report = run(tmp_path / "s", moves.bag(tmp_path / "late.bag", late))
    assert report.captured == ["000000"]
    assert session.captures[0].events("davis").t_ns[0] >= start_ns


def test_collect_no_events_needs_still_board(tmp_path):
    _, report = run(tmp_path / "s", moves.bag(tmp_path / "a.bag", moves.without(Events)))
    assert report.captured == [] and not report.has_events
