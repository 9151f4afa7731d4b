"""Refusals of scans name a fault of the recording that prevents the detection."""

import numpy as np

from lce_rig.core.data import Scan
from lce_rig.core.findings import Refusal
from lce_rig.detect.detection import Detections
from lce_rig.pipeline.detect_session import detect_boards, unlike_models
from lce_rig.session import Session


def room(rig, every):
    """Every k-th point of a room without a board, in firing order."""
    sheet = rig.lidars["lidar"].data_sheet()
    azimuth, elevation = np.meshgrid(
        np.linspace(-np.pi, np.pi, 1800, endpoint=False), np.radians(sheet.elevations_deg), indexing="ij"
    )
    rho = np.minimum(4 / np.abs(np.cos(azimuth)), 5 / np.maximum(np.abs(np.sin(azimuth)), 1e-9))
    points = np.stack([rho * np.cos(azimuth), rho * np.sin(azimuth), rho * np.tan(elevation)], axis=-1)
    ring = np.broadcast_to(np.arange(elevation.shape[1], dtype=np.int16), azimuth.shape).ravel()[::every]
    points = points.reshape(-1, 3)[::every].astype(np.float32)
    return Scan("lidar", None, points, np.zeros(len(points), np.float32), ring)


def refusal_of_room(rig, path, every):
    with Session.create(path, rig) as session:
        name = session.add_capture([], [room(rig, every)], {})
        found = detect_boards(session).lidars["lidar"][name]
    assert isinstance(found, Refusal)
    return found


def test_detect_skipped_points_are_named(rig, tmp_path):
    found = refusal_of_room(rig, tmp_path / "s", every=4)
    assert found.code == "lidar.rings_skipped" and found.figures["n_rings"] == 16
    assert "point_filter_num: 1" in found.advice and "lidars.lidar.model" in found.advice


def test_detect_whole_scan_names_no_skipped_points(rig, tmp_path):
    assert refusal_of_room(rig, tmp_path / "s", every=1).code != "lidar.rings_skipped"


def test_unlike_models_boards_hide_nothing(rig, tmp_path):
    with Session.create(tmp_path / "s", rig) as session:
        name = session.add_capture([], [room(rig, every=4)], {})
        # As if the board had been found in it.
        (finding,) = unlike_models(session, Detections({}, {"lidar": {name: []}}))
        assert finding.code == "recording.rings_skipped" and finding.figures["n_seen"] <= 8
        assert unlike_models(session, detect_boards(session)) == []


def test_unlike_models_thin_rings_are_named(rig, tmp_path):
    with Session.create(tmp_path / "s", rig) as session:
        session.add_capture([], [room(rig, every=3)], {})
        (finding,) = unlike_models(session, detect_boards(session))
        assert finding.code == "recording.points_skipped" and finding.figures["n"] == 3
