"""Scans are searched again at the position predicted from the other captures."""

from pathlib import Path

import pytest

import lce_rig as lce
from lce_rig.core.findings import Refusal
from lce_rig.detect.detection import Detections, Pair
from lce_rig.pipeline.detect_session import detect_boards, expected_poses, match_sensors

RIGS = Path(__file__).parents[1] / "rigs"


@pytest.fixture(scope="module")
def session(recordings, tmp_path_factory):
    rig = lce.load_rig(RIGS / "os1_64.yaml")
    return lce.collect_from(rig, recordings / "os1_64", tmp_path_factory.mktemp("os1") / "session")


@pytest.mark.dataset
@pytest.mark.long
def test_hidden_boards_are_found_by_images(session):
    detections = detect_boards(session)
    pair = Pair("cam", "frames", "lidar")
    assert len(detections.captures(pair)) == 11
    assert match_sensors(session.rig, detections, pair)[0] == {}
    # Nothing is left to be looked for.
    assert expected_poses(session.rig, detections) == {}


@pytest.mark.dataset
@pytest.mark.long
def test_predict_needs_captures_and_image(session):
    found = detect_boards(session)
    names = found.captures(Pair("cam", "frames", "lidar"))
    refusal = Refusal("lidar.no_returns", figures={"n_points": 0, "min_range_m": 0.4})
    scans = {**found.lidars["lidar"], names[0]: refusal, names[1]: refusal}
    images = {**found.images["cam", "frames"], names[1]: Refusal("image.no_board")}
    expected = expected_poses(session.rig, Detections({("cam", "frames"): images}, {"lidar": scans}))
    assert set(expected["lidar"]) == {names[0]}
    few = {name: images[name] for name in names[:5]}
    assert expected_poses(session.rig, Detections({("cam", "frames"): few}, {"lidar": scans})) == {}
