"""`lce-rig simulate` of a moving board: sessions with raw events, recordings, and truth that fits both."""

import json

import numpy as np
import pytest

from lce_rig.cli.main import run
from lce_rig.core.data import Events, Image, Scan
from lce_rig.io import open_recording
from lce_rig.io.events import open_events
from lce_rig.rig import dump_rig, load_rig
from lce_rig.session import Session
from lce_rig.simulate import SimulationOptions, simulate_captures
from tests.shared import changed, contents, half_size

# The placement is 1.3 m away: squares are 9 px wide, even to a camera of half the resolution.
SEED = 9
OPTIONS = SimulationOptions.for_rig("rles", motion="moving")


def small_rig(*channels):
    """The rig rles with a camera of half the resolution, which simulates in a quarter of the time."""
    rig = half_size(load_rig("rles"))
    kept = {name: rig.cameras["davis"].channels[name] for name in channels}
    return changed(rig, cameras__davis__channels=kept)


def write_profile(folder, *channels):
    path = folder / "small.yaml"
    path.write_text(dump_rig(small_rig(*channels)))
    return path


@pytest.fixture(scope="module")
def rig():
    return small_rig("frames", "events")


@pytest.fixture(scope="module")
def moving(tmp_path_factory):
    """A session of one capture of a moving board."""
    folder = tmp_path_factory.mktemp("moving")
    profile = write_profile(folder, "frames", "events")
    words = ["--rig", profile, folder / "s", "--motion", "moving", "--captures", 1, "--seed", SEED]
    assert run(["simulate", *map(str, words)]) == 0
    return folder / "s"


@pytest.fixture(scope="module")
def simulated(rig):
    """What the first capture was made from."""
    return next(simulate_captures(rig, n_captures=1, seed=SEED, options=OPTIONS))


@pytest.fixture(scope="module")
def truth(moving):
    return json.loads((moving / "truth.json").read_text())


def test_the_session_holds_exactly_what_was_simulated(moving, simulated):
    (capture,) = Session.open(moving).captures
    capture.check()
    assert capture.image_keys == [("davis", "frames")], "pictures of events are made at detection"
    assert (capture.lidars, capture.event_cameras) == (["lidar"], ["davis"])
    image, scan, events = capture.image("davis", "frames"), capture.scan("lidar"), capture.events("davis")
    assert np.array_equal(image.pixels, simulated.images[0].pixels)
    assert np.array_equal(scan.points, simulated.scans[0].points)
    assert (image.stamp_ns, scan.stamp_ns) == (simulated.images[0].stamp_ns, simulated.scans[0].stamp_ns)
    for column in ("t_ns", "x", "y", "polarity"):
        assert np.array_equal(getattr(events, column), getattr(simulated.events[0], column))


def test_simulated_truth_has_speed_and_board(truth, simulated):
    assert truth["motion"] == "moving"
    for sensor, board in truth["captures"]["000000"]["boards"].items():
        expected = simulated.T_sensor_board(sensor, board["t_ns"])
        np.testing.assert_allclose(board["T_sensor_board"], expected, atol=1e-6)
    assert list(truth["captures"]) == ["000000"]
    assert all(0 < capture["speed_mps"] < 0.6 for capture in truth["captures"].values())
    assert np.array(truth["T_cam_lidar"]).shape == (4, 4)


def test_a_rig_of_events_alone_is_simulated_moving(lce_rig, tmp_path):
    profile = write_profile(tmp_path, "events")
    words = ("simulate", "--rig", profile, "--captures", 1)
    outcome = lce_rig(*words, tmp_path / "s")
    assert outcome.code == 0, outcome.err
    (capture,) = Session.open(tmp_path / "s").captures
    assert (capture.image_keys, capture.event_cameras) == ([], ["davis"])
    outcome = lce_rig(*words, tmp_path / "t", "--motion", "still")
    assert outcome.code == 3
    assert "Only frames" in outcome.err and not any((tmp_path / "t").glob("captures/*"))


@pytest.mark.parametrize(
    "words",
    [
        ("s", "--duration", "3"),
        ("s", "--recording", "r"),
        ("--captures", "3", "--recording", "r"),
        ("--motion", "still", "--recording", "r"),
        *(("--duration", value, "--recording", "r") for value in ("nan", "inf", "-0.1")),
    ],
)
def test_simulate_bad_choices_exit_with_2(lce_rig, tmp_path, monkeypatch, words):
    monkeypatch.chdir(tmp_path)
    outcome = lce_rig("simulate", "--rig", "rles", *words)
    assert outcome.code == 2
    assert list(tmp_path.iterdir()) == []


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    """A recording of a quarter of a second."""
    folder = tmp_path_factory.mktemp("recorded")
    profile = write_profile(folder, "frames", "events")
    words = ["--rig", profile, "--recording", folder / "r", "--duration", 0.25, "--seed", 2]
    assert run(["simulate", *map(str, words)]) == 0
    return folder / "r"


def test_simulated_recording_is_readable(recorded, rig):
    assert sorted(path.name for path in recorded.iterdir()) == ["recording.bag", "truth.json"]
    recording = open_recording(recorded / "recording.bag", rig)
    samples = list(recording.samples())
    assert sum(isinstance(sample, Image) for sample in samples) == 5
    assert sum(isinstance(sample, Scan) for sample in samples) == 2
    size = rig.cameras["davis"].resolution_px
    events = list(open_events(recorded / "recording.bag", sensor="davis", resolution=size))
    assert sum(map(len, events)) > 1000
    assert sum(len(sample) for sample in samples if isinstance(sample, Events)) == sum(map(len, events))


def test_a_recording_overwrites_nothing(lce_rig, recorded, tmp_path):
    before = contents(recorded)
    profile = write_profile(tmp_path, "frames", "events")
    outcome = lce_rig("simulate", "--rig", profile, "--recording", recorded)
    assert outcome.code == 5
    assert "exists already" in outcome.err
    assert contents(recorded) == before


def test_a_recording_that_fails_leaves_no_files(lce_rig, tmp_path):
    topics = {f"cameras__davis__channels__{name}__topic": "/davis/shared" for name in ("frames", "events")}
    (tmp_path / "p.yaml").write_text(dump_rig(changed(small_rig("frames", "events"), **topics)))
    outcome = lce_rig(
        "simulate", "--rig", tmp_path / "p.yaml", "--recording", tmp_path / "r", "--duration", 0.25
    )
    assert outcome.code == 5 and "would carry both" in outcome.err
    assert [path.name for path in tmp_path.iterdir()] == ["p.yaml"]
