"""`lce-rig simulate` of a moving board: sessions with raw events, recordings, and truth that fits both."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from lce_rig.cli.main import run
from lce_rig.core.data import Events, Image, Scan
from lce_rig.core.data_sheets import find_data_sheet
from lce_rig.core.geometry import Array, invert, transform
from lce_rig.io import open_recording
from lce_rig.io.events import open_events
from lce_rig.io.protocol import ContinuousRecording
from lce_rig.rig import Rig, dump_rig, load_rig
from lce_rig.session import Session
from lce_rig.simulate import HandMotion, SimulatedCapture, SimulationOptions, simulate_captures

# The placement is 1.3 m away: squares are 9 px wide, even to a camera of half the resolution.
SEED = 9
CHOICES = ("--carrier", "none", "--speed", "0.25", "0.3", "--frame-offset", "0.12", "--event-offset", "-0.3")
OPTIONS = replace(
    SimulationOptions.for_rig("rles", motion="moving"),
    carrier="none",
    hand=HandMotion(speed_mps=(0.25, 0.3), carry_mps=0.3),
    frame_offset_s=0.12,
    event_offset_s=-0.3,
)


def small_rig(*channels: str) -> Rig:
    """The rig rles with a camera of half the resolution, which simulates in a quarter of the time."""
    document = json.loads(load_rig("rles").model_dump_json())
    camera = document["cameras"]["davis"]
    camera["resolution_px"] = (173, 130)
    for key in ("fx_px", "fy_px", "cx_px", "cy_px"):
        camera["intrinsics"][key] /= 2
    camera["channels"] = {name: camera["channels"][name] for name in channels}
    return Rig.model_validate(document)


def write_profile(folder: Path, *channels: str) -> Path:
    path = folder / "small.yaml"
    path.write_text(dump_rig(small_rig(*channels)))
    return path


@pytest.fixture(scope="module")
def rig() -> Rig:
    return small_rig("frames", "events")


@pytest.fixture(scope="module")
def moving(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A session of one capture of a moving board."""
    folder = tmp_path_factory.mktemp("moving")
    profile = write_profile(folder, "frames", "events")
    words = ["--rig", profile, folder / "s", "--motion", "moving", "--captures", 1, "--seed", SEED, *CHOICES]
    assert run(["simulate", *map(str, words)]) == 0
    return folder / "s"


@pytest.fixture(scope="module")
def simulated(rig: Rig) -> SimulatedCapture:
    """What the first capture was made from."""
    return next(simulate_captures(rig, n_captures=1, seed=SEED, options=OPTIONS))


@pytest.fixture(scope="module")
def truth(moving: Path) -> dict[str, Any]:
    document: dict[str, Any] = json.loads((moving / "truth.json").read_text())
    return document


def test_a_capture_holds_a_picture_a_scan_and_raw_events(moving: Path) -> None:
    (capture,) = Session.open(moving).captures
    capture.check()
    assert capture.image_keys == [("davis", "frames")], "pictures of events are made at detection"
    assert (capture.lidars, capture.event_cameras) == (["lidar"], ["davis"])


def test_the_session_holds_exactly_what_was_simulated(moving: Path, simulated: SimulatedCapture) -> None:
    capture = Session.open(moving).captures[0]
    image, scan, events = capture.image("davis", "frames"), capture.scan("lidar"), capture.events("davis")
    assert np.array_equal(image.pixels, simulated.images[0].pixels)
    assert np.array_equal(scan.points, simulated.scans[0].points)
    assert (image.stamp_ns, scan.stamp_ns) == (simulated.images[0].stamp_ns, simulated.scans[0].stamp_ns)
    for column in ("t_ns", "x", "y", "polarity"):
        assert np.array_equal(getattr(events, column), getattr(simulated.events[0], column))


def test_events_surround_their_scan_by_the_stamps_of_their_own_clock(moving: Path) -> None:
    capture = Session.open(moving).captures[0]
    stamp_ns, t_ns = capture.scan("lidar").stamp_ns or 0, capture.events("davis").t_ns
    assert t_ns[0] == pytest.approx(stamp_ns - 1.2e9, abs=2e7)
    assert t_ns[-1] == pytest.approx(stamp_ns + 0.15e9, abs=2e7)


def test_points_brought_to_one_time_by_the_true_trajectory_lie_on_the_true_board(
    moving: Path, simulated: SimulatedCapture, truth: dict[str, Any]
) -> None:
    scan = Session.open(moving).captures[0].scan("lidar")
    board = truth["captures"]["000000"]["boards"]["lidar"]
    assert scan.stamp_ns is not None and scan.offset_ns is not None
    T_lidar_board = simulated.T_sensor_board("lidar", scan.stamp_ns + scan.offset_ns)
    in_board = transform(invert(T_lidar_board), scan.points[:, None].astype(float))[:, 0]
    is_on = np.all(np.abs(in_board) < [0.38, 0.28, 0.06], axis=1)
    at_one_time = transform(np.array(board["T_sensor_board"]), in_board[is_on])
    assert is_on.sum() > 100
    mean_ns = scan.stamp_ns + scan.offset_ns[is_on].mean()
    assert board["t_ns"] == pytest.approx(mean_ns, abs=1e6)
    plane = invert(np.array(board["T_sensor_board"]))
    distance_m = transform(plane, at_one_time)[:, 2]
    sheet = find_data_sheet("VLP-16")
    assert sheet is not None
    noise = OPTIONS.noise_of(sheet)
    sigma_m = np.hypot(noise.range_sigma_m, noise.laser_sigma_m)
    assert np.sqrt(np.mean(distance_m**2)) < 1.3 * sigma_m
    # A control: the board where it was 0.3 s before does not fit.
    earlier = invert(simulated.T_sensor_board("lidar", board["t_ns"] - 300_000_000))
    assert np.sqrt(np.mean(transform(earlier, at_one_time)[:, 2] ** 2)) > 2 * sigma_m


def test_the_picture_shows_the_board_where_the_truth_has_it(
    moving: Path, rig: Rig, truth: dict[str, Any]
) -> None:
    import cv2

    image = Session.open(moving).captures[0].image("davis", "frames")
    board = truth["captures"]["000000"]["boards"]["davis"]
    assert board["t_ns"] == (image.stamp_ns or 0) - 120_000_000
    corners = transform(np.array(board["T_sensor_board"]), rig.board.to_board().corners())
    expected, _ = rig.cameras["davis"].to_intrinsics().project(corners)
    start = expected.astype(np.float32).reshape(-1, 1, 2)
    found = cv2.cornerSubPix(image.grey, start, (3, 3), (-1, -1), (3, 30, 1e-3)).reshape(-1, 2)
    assert np.sqrt(np.mean((found - expected) ** 2)) < 0.15


def edges_px(rig: Rig, T_cam_board: Array) -> Array:
    """Points (M, 2) along everything on the board that events can tell of: its rim and its squares' sides."""
    board = rig.board.to_board()
    sizes_m, counts = (board.width_m, board.height_m), (board.cols, board.rows)
    lines = []
    for across in (0, 1):
        inner_m = board.square_m * (np.arange(-1, counts[across] + 1) - (counts[across] - 1) / 2)
        for at_m in [*inner_m, -sizes_m[across] / 2, sizes_m[across] / 2]:
            line = np.full((200, 3), at_m)
            line[:, 1 - across] = sizes_m[1 - across] * np.linspace(-0.5, 0.5, 200)
            lines.append(line)
    points = np.concatenate(lines) * [1.0, 1.0, 0.0]
    pixels, _ = rig.cameras["davis"].to_intrinsics().project(transform(T_cam_board, points))
    return np.asarray(pixels)


def test_events_lie_on_the_boards_edges_at_their_own_time(
    moving: Path, rig: Rig, simulated: SimulatedCapture
) -> None:
    from scipy.spatial import cKDTree

    capture = Session.open(moving).captures[0]
    events = capture.events("davis")
    assert capture.scan("lidar").stamp_ns == simulated.scans[0].stamp_ns
    times_ns = (capture.scan("lidar").stamp_ns or 0) + 10_000_000 * np.arange(-60, 10)
    middle_ns = int(times_ns[np.argmax(simulated.trajectory.speed_mps(times_ns + 300_000_000))])
    seen = events.between(middle_ns - 5_000_000, middle_ns + 5_000_000)
    xy = np.stack([seen.x, seen.y], axis=1).astype(float)
    shares = {}
    for offset_ns in (-300_000_000, 0):
        edges = edges_px(rig, simulated.T_sensor_board("davis", middle_ns - offset_ns))
        distance_px, _ = cKDTree(edges).query(xy)
        shares[offset_ns] = np.mean(distance_px < 1.5)
    assert len(seen) > 200
    assert shares[-300_000_000] > 0.9 and shares[0] < 0.6


def test_truth_names_the_clocks_and_the_speed(truth: dict[str, Any]) -> None:
    assert (truth["motion"], truth["frame_offset_s"], truth["event_offset_s"]) == ("moving", 0.12, -0.3)
    assert list(truth["captures"]) == ["000000"]
    assert all(0 < capture["speed_mps"] < 0.6 for capture in truth["captures"].values())
    assert np.array(truth["T_cam_lidar"]).shape == (4, 4)


def test_a_rig_of_events_alone_is_simulated_moving(lce_rig: Any, tmp_path: Path) -> None:
    profile = write_profile(tmp_path, "events")
    words = ("simulate", "--rig", profile, "--captures", 1, "--carrier", "none")
    outcome = lce_rig(*words, tmp_path / "s")
    assert outcome.code == 0, outcome.err
    (capture,) = Session.open(tmp_path / "s").captures
    assert (capture.image_keys, capture.event_cameras) == ([], ["davis"])
    outcome = lce_rig(*words, tmp_path / "t", "--motion", "still")
    assert outcome.code == 3
    assert "only frames" in outcome.err and not any((tmp_path / "t").glob("captures/*"))


def test_a_still_board_makes_no_events_and_help_says_so(lce_rig: Any, tmp_path: Path) -> None:
    profile = write_profile(tmp_path, "frames", "events")
    outcome = lce_rig("simulate", "--rig", profile, tmp_path / "s", "--captures", 1, "--carrier", "none")
    assert outcome.code == 0
    assert Session.open(tmp_path / "s").captures[0].event_cameras == []
    text = " ".join(lce_rig("simulate", "--help").out.split())
    assert "moving board" in text


@pytest.mark.parametrize(
    "words",
    [
        ("s", "--speed", "0.1", "0.2"),
        ("s", "--event-offset", "0"),
        ("s", "--motion", "still", "--flicker", "0.3"),
        ("s", "--motion", "moving", "--speed", "0.3", "0.1"),
        ("s", "--motion", "moving", "--speed", "nan", "1"),
        ("s", "--duration", "3"),
        ("s", "--ros", "2"),
        ("s", "--recording", "r"),
        ("--captures", "3", "--recording", "r"),
        ("--motion", "still", "--recording", "r"),
        ("--speed", "0", "0", "--recording", "r"),
    ],
)
def test_choices_that_cannot_be_meant_exit_with_2_and_write_nothing(
    lce_rig: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, words: tuple[str, ...]
) -> None:
    monkeypatch.chdir(tmp_path)
    outcome = lce_rig("simulate", "--rig", "rles", *words)
    assert outcome.code == 2
    assert list(tmp_path.iterdir()) == []


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A quarter of a second as files."""
    folder = tmp_path_factory.mktemp("recorded")
    profile = write_profile(folder, "frames", "events")
    words = ["--rig", profile, "--recording", folder / "r", "--duration", 0.25, "--seed", 2, "--ros", 2]
    assert run(["simulate", *map(str, words), "--carrier", "none", "--speed", "0", "0.6"]) == 0
    return folder / "r"


def test_a_recording_is_read_by_the_readers_of_recordings(recorded: Path, rig: Rig) -> None:
    assert sorted(path.name for path in recorded.iterdir()) == ["events.aedat4", "recording", "truth.json"]
    recording = open_recording(recorded / "recording", rig)
    assert isinstance(recording, ContinuousRecording)
    samples = list(recording.samples())
    assert sum(isinstance(sample, Image) for sample in samples) == 5
    assert sum(isinstance(sample, Scan) for sample in samples) == 2
    size = rig.cameras["davis"].resolution_px
    streams = [
        list(open_events(recorded / name, sensor="davis", resolution=size))
        for name in ("recording", "events.aedat4")
    ]
    for column in ("t_ns", "x", "y", "polarity"):
        bag, aedat4 = (np.concatenate([getattr(part, column) for part in parts]) for parts in streams)
        assert len(bag) > 1000 and np.array_equal(bag, aedat4)
    assert all(isinstance(part, Events) for part in streams[0])


def test_a_recordings_truth_tells_where_the_board_is_at_any_time(recorded: Path, rig: Rig) -> None:
    track = json.loads((recorded / "truth.json").read_text())["boards"]["lidar"]
    t_ns, T_lidar_board = np.array(track["t_ns"]), np.array(track["T_sensor_board"])
    assert np.all(np.diff(t_ns) == 10_000_000)
    recording = open_recording(recorded / "recording", rig)
    assert isinstance(recording, ContinuousRecording)
    for scan in [sample for sample in recording.samples() if isinstance(sample, Scan)]:
        assert scan.stamp_ns is not None and scan.offset_ns is not None
        nearest = np.rint((scan.stamp_ns - t_ns[0] + scan.offset_ns) / 1e7).astype(int)
        T_board_lidar = invert(T_lidar_board[nearest])
        in_board = transform(T_board_lidar, scan.points[:, None].astype(float))[:, 0]
        is_on = np.all(np.abs(in_board) < [0.37, 0.27, 0.05], axis=1)
        assert is_on.sum() > 100
        assert abs(in_board[is_on, 2].mean()) < 0.006
        assert in_board[is_on, 2].std() < 0.016


def test_a_recording_overwrites_nothing(lce_rig: Any, recorded: Path, tmp_path: Path) -> None:
    before = {path: path.read_bytes() for path in recorded.rglob("*") if path.is_file()}
    profile = write_profile(tmp_path, "frames", "events")
    outcome = lce_rig("simulate", "--rig", profile, "--recording", recorded, "--carrier", "none")
    assert outcome.code == 5
    assert "exists already" in outcome.err
    assert {path: path.read_bytes() for path in recorded.rglob("*") if path.is_file()} == before
