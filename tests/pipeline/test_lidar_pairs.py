"""Two LiDARs that saw the same plate: their relative pose, and cases that must not pass."""

from dataclasses import replace

import numpy as np
import pytest

from lce_rig.core.calibration import ResultFile, read_result
from lce_rig.core.errors import NotEnoughDataError, ProfileError
from lce_rig.core.findings import Refusal
from lce_rig.core.geometry import difference, exp_so3, invert, perturb, pose
from lce_rig.detect.detection import Detections
from lce_rig.detect.findings import LIDAR_OTHER_SIZE
from lce_rig.export import ExportJob, write_exports
from lce_rig.judge.sensor_pairs import Loop, loop_findings
from lce_rig.pipeline.calibration import calibrate_detections
from lce_rig.rig import Rig
from lce_rig.rig.loading import dump_rig, parse_rig
from tests.calibrate.boards import Scenario, scan_board

T_LEFT_RIGHT = pose(exp_so3(np.radians([3.0, -2.0, 25.0])), np.array([0.1, -0.5, 0.05]))
PLATE = {"type": "plain", "width_m": 0.9, "height_m": 0.7}
ROUGH = {"rpy_deg": [0, 0, 25], "translation_m": [0.1, -0.5, 0.0], "tolerance_deg": 6}


def make_rig(board=PLATE, model="VLP-16", nominal=True):
    return Rig.model_validate(
        {
            "format_version": 1,
            "name": "pair",
            "board": board,
            "lidars": {
                "left": {"model": "VLP-16", "frame": "left_link", "topic": "/left", "rate_hz": 10},
                "right": {"model": model, "frame": "right_link", "topic": "/right", "rate_hz": 10},
            },
            "nominal_extrinsics": [{"camera": "left", "lidar": "right", **ROUGH}] if nominal else [],
        }
    )


def scan_both(n, seed, board, *, n_moved=0, move=None):
    """Scan boards with both LiDARs; the right one moves before the last `n_moved`."""
    rng, scenario = np.random.default_rng(seed), Scenario(range_sigma_m=0.01)
    left = {}
    right = {}
    while len(left) < n:
        T_right = T_LEFT_RIGHT
        if len(left) >= n - n_moved and move is not None:
            T_right = perturb(T_LEFT_RIGHT, move)
        bearing, distance_m = np.radians(rng.uniform(-30, 30)), rng.uniform(1.6, 3.5)
        centre = distance_m * np.array([np.cos(bearing), np.sin(bearing), rng.uniform(-0.12, 0.12)])
        normal = -centre / np.linalg.norm(centre)
        across = np.cross([0, 0, 1], normal)
        across /= np.linalg.norm(across)
        facing = np.column_stack([across, np.cross(normal, across), normal])
        tilt = np.radians(rng.uniform(10, 40)) * exp_so3(np.array([0, 0, rng.uniform(0, 6.3)]))[:, 0]
        R = facing @ exp_so3(tilt) @ exp_so3(np.array([0, 0, np.radians(45 + rng.uniform(-20, 20))]))
        T = pose(R, centre)
        found = [scan_board(T_a, rng, scenario, board) for T_a in (T, invert(T_right) @ T)]
        if found[0] is not None and found[1] is not None:
            name = f"{len(left):06d}"
            left[name], right[name] = [found[0]], [found[1]]
    return {"left": left, "right": right}


def calibrate(rig, scans):
    (result,), shortages = calibrate_detections(rig, Detections({}, scans))
    assert not shortages
    return result


def codes(result):
    return {finding.code for finding in result.findings if finding.severity != "note"}


@pytest.mark.long
def test_lidar_pairs_pose_fits_covariance():
    rig, chi2 = make_rig(), []
    for seed in range(4):
        result = calibrate(rig, scan_both(20, seed, rig.board.to_board()))
        off = difference(result.T_cam_lidar, T_LEFT_RIGHT)
        assert np.degrees(np.linalg.norm(off[3:])) < 0.15
        assert np.linalg.norm(off[:3]) < 0.006
        chi2.append(off @ np.linalg.solve(result.cov, off))
        assert (result.camera, result.channels, result.lidar) == ("left", (), "right")
        assert result.verdict == "pass", result.findings
    assert np.mean(chi2) < 9


@pytest.mark.parametrize("sides", [(0.7, 0.7), (0.9, 0.7)])
def test_lidar_pairs_symmetric_plate_is_fine(sides):
    rig = make_rig({"type": "plain", "width_m": sides[0], "height_m": sides[1]})
    scans = scan_both(14, 3, rig.board.to_board())
    n_fold = 4 if sides[0] == sides[1] else 2
    rng = np.random.default_rng(0)
    for found in scans["right"].values():
        turn = pose(exp_so3(np.array([0, 0, 2 * np.pi / n_fold * rng.integers(n_fold)])), np.zeros(3))
        found[0] = replace(found[0], T_lidar_board=found[0].T_lidar_board @ turn)
    result = calibrate(rig, scans)
    off = difference(result.T_cam_lidar, T_LEFT_RIGHT)
    assert result.verdict != "fail"
    assert off @ np.linalg.solve(result.cov, off) < 25


@pytest.mark.long
def test_equal_lidars_never_pass_without_nominal_pose():
    rig = make_rig(nominal=False)
    result = calibrate(rig, scan_both(14, 1, rig.board.to_board()))
    assert result.verdict == "marginal"
    assert codes(result) == {"verdict.lidars_unnamed"}
    rig = make_rig(model="HDL-32E", nominal=False)
    assert not codes(calibrate(rig, scan_both(14, 1, rig.board.to_board())))


@pytest.mark.long
@pytest.mark.parametrize(("n_moved", "turn_deg"), [(7, 1.0), (4, 2.0), (2, 3.0)])
def test_a_lidar_that_moved_between_captures_never_passes(n_moved, turn_deg):
    rig = make_rig()
    move = np.r_[0.01, 0, 0.02, np.radians([0.0, 0.6 * turn_deg, 0.8 * turn_deg])]
    for seed in range(2):
        result = calibrate(rig, scan_both(16, seed, rig.board.to_board(), n_moved=n_moved, move=move))
        assert result.verdict != "pass"
        assert "verdict.moved" in codes(result)


def test_lidar_pairs_cut_boards_are_refused():
    rig = make_rig()
    scans = dict(scan_both(9, 1, rig.board.to_board()))
    cut = LIDAR_OTHER_SIZE.refusal(
        side="height", measured_m=0.5, sigma_m=0.01, profile_m=0.7, distance_m=2.0, hidden_share=0.0
    )
    scans["right"] |= dict.fromkeys(list(scans["right"])[:2], cut)
    result = calibrate(rig, scans)
    assert isinstance(result.captures_refused["000000"], Refusal)
    assert len(result.captures_used) <= 7
    scans["right"] |= dict.fromkeys(list(scans["right"])[:5], cut)
    with pytest.raises(NotEnoughDataError) as caught:
        calibrate(rig, scans)
    assert caught.value.finding.code == "shortage.few_detected"


@pytest.mark.long
def test_lidar_pairs_other_plate_is_refused():
    """The result is that of the other captures."""
    rig = make_rig()
    board = rig.board.to_board()
    scans, rng = scan_both(16, 5, board), np.random.default_rng(0)
    wrong = list(scans["left"])[2::4]
    table = replace(board, width_m=0.86, height_m=0.74)
    for k, name in enumerate(wrong):
        R = exp_so3(np.array([0.0, np.radians(-60.0), 0.0])) @ exp_so3(np.array([0.0, 0.0, 0.6]))
        T = pose(R, np.array([2.2, 1.4 - 0.1 * k, -0.1]))
        scans["left"][name] = [scan_board(T, rng, Scenario(range_sigma_m=0.02), table)]
    alone = {lidar: {k: v for k, v in found.items() if k not in wrong} for lidar, found in scans.items()}
    result, without = calibrate(rig, scans), calibrate(rig, alone)
    assert set(wrong) <= set(result.captures_refused)
    assert np.allclose(result.T_cam_lidar, without.T_cam_lidar, atol=1e-9)
    assert np.allclose(result.cov, without.cov, rtol=1e-6, atol=1e-14)


def test_a_result_of_lidars_is_read_back_and_exported(tmp_path):
    rig = make_rig()
    result = calibrate(rig, scan_both(14, 2, rig.board.to_board()))
    path = tmp_path / "result.json"
    path.write_text(ResultFile(rig=rig.name, pairs=(result,)).text())
    (back,) = read_result(path).pairs
    assert back.is_of_lidars
    assert np.array_equal(back.T_cam_lidar, result.T_cam_lidar)
    files = write_exports([back], rig, tmp_path / "out", is_forced=True)
    assert {file.name for file in files} == {"extrinsics.yaml", "pair.urdf", "static_transforms.txt"}
    (tree,) = ExportJob([back], rig, tmp_path).trees
    (joint,) = tree.above.values()
    assert (joint.parent, joint.child) == ("left_link", "right_link")
    assert np.allclose(joint.T_parent_child, result.T_cam_lidar)


def test_loop_findings_open_loop_is_named():
    cov = np.diag(np.r_[np.full(3, 1e-3), np.full(3, 3e-4)] ** 2)
    T_cam_left = pose(exp_so3(np.radians([80.0, 5.0, 10.0])), np.array([0.0, -0.1, 0.2]))
    T_cam_right, target = T_cam_left @ T_LEFT_RIGHT, make_rig().calibration

    def found(T):
        poses = (T_cam_left, cov), (T_LEFT_RIGHT, cov), (T, cov)
        return loop_findings(Loop(("cam", "left", "right"), *poses), target)

    assert not found(T_cam_right)
    (finding,) = found(perturb(T_cam_right, np.r_[0.0, 0.03, 0.0, np.radians([1.0, 0, 0])]))
    assert (finding.code, finding.subject) == ("verdict.lidars_differ", "left and right")
    assert finding.severity != "note"


def test_plain_plate_profiles_have_no_camera():
    """The profile survives writing and reading."""
    rig = make_rig()
    assert parse_rig(dump_rig(rig)) == rig
    camera = """
cameras:
  cam: {resolution_px: [640, 480], intrinsics: {fx_px: 500, fy_px: 500, cx_px: 320, cy_px: 240}}
"""
    with pytest.raises(ProfileError) as caught:
        parse_rig(dump_rig(rig).replace("cameras: {}\n", camera))
    assert "board.type" in caught.value.what
    lonely = dump_rig(rig)
    start, end = lonely.index("  right:"), lonely.index("cameras:")
    with pytest.raises(ProfileError) as caught:
        parse_rig(lonely[:start] + lonely[end:].partition("nominal_extrinsics")[0])
    assert "cameras" in caught.value.what
