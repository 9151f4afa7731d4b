"""A LiDAR with constantly long ranges is calibrated with a profile that states the offset."""

import numpy as np
import pytest

import lce_rig as lce
from lce_rig.core.geometry import difference
from lce_rig.detect.finder import BoardFinder
from lce_rig.export import extrinsics
from lce_rig.pipeline.detect_session import detection_digest
from lce_rig.rig import dump_rig, parse_rig
from lce_rig.simulate import simulate_captures, truth_extrinsics
from tests.saved_results import made_calibration
from tests.shared import changed, compute_once

OFFSET_M, SEED = 0.06, 4
SOUND = lce.load_rig("rlfs")
LONG = changed(SOUND, lidars__lidar__range_offset_m=OFFSET_M)


def simulated(n_captures):
    """Simulate captures of a LiDAR with an offset of its driver's ranges."""
    return compute_once(
        f"long ranges {n_captures}",
        lambda: list(simulate_captures(LONG, n_captures=n_captures, seed=SEED)),
    )


def fill(folder, captures):
    session = lce.Session.create(folder, SOUND)
    for capture in captures:
        session.add_capture(capture.images, capture.scans, {})
    return session


@pytest.fixture(scope="module")
def captures():
    return simulated(1)


@pytest.fixture
def session(captures, tmp_path):
    with fill(tmp_path / "session", captures) as session:
        yield session


def distance_m(rig, capture):
    """Distance of the board that the truth places nearest to a detected one."""
    (scan,) = capture.scans
    found = BoardFinder(rig).scan(scan)
    truth = capture.T_lidar_board["lidar"][:3, 3]
    return min(np.linalg.norm(board.T_lidar_board[:3, 3] - truth) for board in found)


def test_finder_subtracts_range_offset(captures):
    off = [[distance_m(rig, capture) for capture in captures] for rig in (SOUND, LONG)]
    assert np.array(off[0]) == pytest.approx(OFFSET_M, abs=0.01)
    assert np.max(off[1]) < 0.01


def test_session_scan_is_corrected_and_capture_is_not(session, captures):
    session.rig = LONG
    capture = session.captures[0]
    recorded, corrected = capture.scan("lidar"), session.scan(capture, "lidar")
    np.testing.assert_array_equal(recorded.points, captures[0].scans[0].points)
    ranges_m = [np.linalg.norm(scan.points.astype(float), axis=1) for scan in (recorded, corrected)]
    np.testing.assert_allclose(ranges_m[0] - ranges_m[1], OFFSET_M, atol=1e-5)


def test_profile_range_offset_comes_back():
    assert parse_rig(dump_rig(LONG)) == LONG
    assert "range_offset_m: 0.06" in dump_rig(LONG, is_whole=False)
    assert "range_offset_m" not in dump_rig(SOUND, is_whole=False)


def test_detections_belong_to_a_range_offset(session):
    assert detection_digest(SOUND) != detection_digest(LONG)

    def distances_m():
        found = lce.detect_boards(session).lidars["lidar"]
        return {name: boards[0].quality.distance_m for name, boards in found.items()}

    before = distances_m()
    session.adopt(LONG)
    after = distances_m()
    shorter = [before[name] - after[name] for name in before]
    assert np.median(shorter) == pytest.approx(OFFSET_M, abs=0.01)


@pytest.mark.long
def test_calibrate_with_range_offset_recovers_truth(tmp_path):
    truth = truth_extrinsics(LONG, SEED)["cam", "lidar"]
    with fill(tmp_path / "session", simulated(12)) as session:
        without = lce.calibrate_session(session).of("cam")
        session.adopt(LONG)
        result = lce.calibrate_session(session).of("cam")
    error = difference(truth, result.T_cam_lidar)
    assert np.sqrt(error @ np.linalg.solve(result.cov, error) / 6) < 2.5
    assert np.linalg.norm(error[:3]) < 0.012
    # Without it, the planes disagree and the squares are reported as the cause.
    assert without.verdict == "fail" and result.verdict == "pass"


def test_extrinsics_state_range_offset():
    calibration = made_calibration(np.eye(4), np.eye(6))
    assert extrinsics._pair(calibration, LONG)["lidar_range_offset_m"] == OFFSET_M
    assert "lidar_range_offset_m" not in extrinsics._pair(calibration, SOUND)
