"""Sessions that determine a LiDAR's constant errors."""

from dataclasses import replace

import numpy as np
import pytest

import lce_rig as lce
from lce_rig.core.errors import ResultRefusedError, UsageError
from lce_rig.core.geometry import perturb
from lce_rig.detect.detection import Detections
from lce_rig.pipeline.measure_lidar import lidar_document, measure_lidar, save_lidar
from lce_rig.rig import load_rig
from tests.calibrate.boards import BOARD, Scenario, simulate
from tests.shared import changed


def seen(moved_m, offset_m=0.0, bias_sigma_m=0.008):
    """Detect boards that move along their normals between scan and image, by a LiDAR of that offset."""
    captures = simulate(
        16, 1, Scenario(laser_bias_sigma_m=bias_sigma_m, range_offset_m=offset_m), board=BOARD
    )
    rng = np.random.default_rng(3)
    lidars = {}
    for item in captures:
        board = item.lidar
        move = moved_m * rng.standard_normal() * board.plane[:3]
        plane = board.plane - np.r_[np.zeros(3), board.plane[:3] @ move]
        points, ends = board.points + move, board.edge_points + move
        T = perturb(board.T_lidar_board, np.r_[move, np.zeros(3)])
        moved = replace(board, points=points, edge_points=ends, plane=plane, T_lidar_board=T)
        lidars[item.capture] = [moved]
    images = {item.capture: item.image for item in captures}
    return Detections({("cam", "frames"): images}, {"lidar": lidars})


@pytest.mark.long
def test_boards_moved_in_capture_are_refused(tmp_path):
    session = lce.Session.create(tmp_path / "session", lce.load_rig("rlfs"))
    errors = measure_lidar([session], found=[seen(0.0)])
    assert errors.n_captures == (16,) and errors.offset_m is None
    with pytest.raises(ResultRefusedError) as refused:
        measure_lidar([session], found=[seen(0.03)])
    assert str(session.path) in refused.value.what
    assert refused.value.hint


@pytest.mark.parametrize("known_m", [0.0, 0.02])
def test_measure_lidar_all_ranges_long_saves_offset(tmp_path, known_m):
    rig = changed(lce.load_rig("rlfs"), lidars__lidar__range_offset_m=known_m)
    with lce.Session.create(tmp_path / "session", rig) as session:
        errors = measure_lidar([session], found=[seen(0.0, 0.06)])
        document = lidar_document(errors)
        save_lidar(session, None, errors, tmp_path / "new.yaml")
    offset_m, sigma_m = errors.offset_m, errors.offset_sigma_m
    assert 0.003 < sigma_m < 0.012
    assert abs(offset_m - 0.06 - known_m) < 3 * sigma_m
    # The lasers' own errors are about that offset.
    assert abs(np.mean([laser["range_m"] for laser in document["lasers"]])) < 1e-6
    saved = load_rig(tmp_path / "new.yaml").lidars["lidar"]
    assert saved.range_offset_m == pytest.approx(offset_m, abs=1e-5)
    assert saved.range_offset_sigma_m == pytest.approx(sigma_m, abs=1e-5)
    assert len(saved.intrinsics.lasers) == len(document["lasers"])


def test_measure_lidar_like_lasers_saves_only_offset(tmp_path):
    rig = changed(lce.load_rig("rlfs"), lidars__lidar__laser_bias_sigma_m=0.0005)
    with lce.Session.create(tmp_path / "session", rig) as session:
        errors = measure_lidar([session], found=[seen(0.0, 0.06, 0.0)])
        save_lidar(session, None, errors, tmp_path / "new.yaml")
    assert errors.offset_m == pytest.approx(0.06, abs=3 * errors.offset_sigma_m)
    assert lidar_document(errors).keys() == {"n_captures", "range_offset_m", "range_offset_sigma_m"}
    saved = load_rig(tmp_path / "new.yaml").lidars["lidar"]
    assert saved.range_offset_m == pytest.approx(errors.offset_m, abs=1e-5) and saved.intrinsics is None


@pytest.mark.long
def test_measure_lidar_moved_and_long_is_refused(tmp_path):
    session = lce.Session.create(tmp_path / "session", lce.load_rig("rlfs"))
    with pytest.raises(ResultRefusedError):
        measure_lidar([session], found=[seen(0.03, 0.06)])


def test_measure_lidar_other_offset_is_refused(tmp_path):
    rig = lce.load_rig("rlfs")
    other = changed(rig, lidars__lidar__range_offset_m=0.06)
    sessions = [lce.Session.create(tmp_path / f"{k}", each) for k, each in enumerate((rig, other))]
    with pytest.raises(UsageError):
        measure_lidar(sessions, found=[seen(0.0)] * 2)


def test_measure_lidar_session_given_twice_is_refused(tmp_path):
    session = lce.Session.create(tmp_path / "session", lce.load_rig("rlfs"))
    with pytest.raises(UsageError, match="given twice"):
        measure_lidar([session, lce.Session.open(session.path)], found=[seen(0.0)] * 2)
