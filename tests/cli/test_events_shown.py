"""Output of check, verify and rigs for captures with raw events."""

import json
from dataclasses import replace

import cv2
import numpy as np
import pytest
from matplotlib.colors import to_rgb

from lce_rig.core.calibration import Certificate, Metrics
from lce_rig.core.geometry import invert
from lce_rig.rig import load_rig
from lce_rig.session import Session
from lce_rig.show.overlays.debug_image import BRIGHTER, DARKER
from lce_rig.simulate import SimulationOptions, simulate_captures
from tests.saved_results import made_calibration, write_result


@pytest.fixture(scope="module")
def moving(tmp_path_factory):
    """A session of the rig rles with a capture of a moving board, and the truth; beside it one of frames."""
    rig = load_rig("rles")
    options = replace(SimulationOptions.for_rig("rles", "moving"), events_span_s=(0.9, 0.15))
    path = tmp_path_factory.mktemp("moving") / "session"
    with Session.create(path, rig) as session, Session.create(path.parent / "frames", rig) as frames:
        for capture in simulate_captures(rig, n_captures=1, seed=12, options=options):
            session.add_capture(capture.images, capture.scans, {}, capture.events)
            frames.add_capture(capture.images, capture.scans, {})
            T_cam_lidar = invert(capture.T_world_sensor["davis"]) @ capture.T_world_sensor["lidar"]
    truth = made_calibration(
        T_cam_lidar,
        np.eye(6) * 1e-6,
        camera="davis",
        channels=("events", "frames"),
        certificate=Certificate(True, 0.0),
        metrics=Metrics(0.01, 0.01, 0.1),
        n_captures=1,
        n_detected=1,
    )
    write_result(path / "calibration" / "result.json", rig.name, [truth])
    return path


def coloured(picture, colour):
    return int(np.all(np.abs(picture.astype(int) - colour) < 20, axis=-1).sum())


def test_check_json_has_event_figures(lce_rig, moving):
    document = json.loads(lce_rig("check", moving, "--json").out)
    (pair,) = [pair for pair in document["pairs"] if pair["channel"] == "events"]
    for capture in pair["captures"].values():
        names = {"events_px_s", "events_px", "speed_mps", "turn_deg_s", "smear_m"}
        assert names <= capture["image"].keys()
        assert 0 < capture["image"]["smear_m"] < 0.01


def test_check_debug_images_show_events(lce_rig, moving):
    assert lce_rig("check", moving, "--debug-images").code == 0
    drawn = cv2.imread(str(moving / "debug" / "davis.events.lidar" / "000000.png"))
    frame = cv2.imread(str(moving / "debug" / "davis.frames.lidar" / "000000.png"))
    assert drawn.shape[1] == frame.shape[1] == 1600 and drawn.shape[0] > frame.shape[0] + 300
    lower = drawn[drawn.shape[0] // 2 :, :800]
    for name in (BRIGHTER, DARKER):
        assert coloured(lower, [round(255 * each) for each in to_rgb(name)[::-1]]) > 500


def test_verify_draws_the_lidar_for_each_channel(lce_rig, moving, tmp_path):
    outcome = lce_rig("verify", moving, "-o", tmp_path)
    assert outcome.code == 0, outcome.err + outcome.out
    for channel in ("events", "frames"):
        assert f"davis.{channel} and lidar" in outcome.out
        folder = tmp_path / f"davis.{channel}.lidar"
        assert sorted(file.name for file in folder.iterdir()) == ["000000.png", "index.html"]
        drawn = cv2.imread(str(folder / "000000.png"))
        assert coloured(drawn, (235, 60, 255)) > 300  # magenta: the board in the LiDAR


def test_verify_uses_available_channels(lce_rig, moving):
    words = ["verify", moving.parent / "frames", "--result", moving / "calibration" / "result.json"]
    outcome = lce_rig(*words)
    assert outcome.code == 0, outcome.err
    assert "davis.frames" in outcome.out and "davis.events" not in outcome.out
