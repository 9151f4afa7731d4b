"""Two cameras with the same boards: no finding if both are right, a finding if one was moved."""

from dataclasses import replace

import numpy as np
import pytest

from lce_rig.calibrate import EstimateSettings, fit_extrinsic
from lce_rig.core.geometry import difference, perturb
from lce_rig.judge.sensor_pairs import camera_findings, pose_from_images, relate, shared_boards
from lce_rig.rig.thresholds import CalibrationSettings
from tests.calibrate.boards import BOARD
from tests.calibrate.two_cameras import LEFT, RIGHT, T_RIGHT_LEFT, simulate_two

OPTIONS = EstimateSettings(laser_bias_sigma_m=0.008, range_offset_sigma_m=0.005)
TARGET = CalibrationSettings()
N_SOUND = 21
TURNED = np.array([0, 0, 0, 0, np.radians(0.5), 0])


def observed(session):
    """Pair both cameras' boards as a calibration would; its consensus is tested elsewhere."""
    return list(zip(session[LEFT], session[RIGHT], strict=True))


def related(session):
    left, right = (fit_extrinsic(session[name], BOARD, OPTIONS) for name in (LEFT, RIGHT))
    return relate(left, right)


def findings(pair):
    return camera_findings(pair, (LEFT, RIGHT), TARGET)


@pytest.fixture(scope="module")
def sound():
    """Sessions of 12 captures, with lasers off by 8 mm and a beam that reaches 8 mm over edges."""
    return [simulate_two(12, seed) for seed in range(N_SOUND)]


@pytest.mark.long
def test_images_pose_error_fits_covariance(sound):
    found = [pose_from_images(observed(session)) for session in sound]
    errors = np.array([difference(each.T_second_first, T_RIGHT_LEFT) for each in found])
    assert np.degrees(np.sqrt(np.mean(np.sum(errors[:, 3:] ** 2, axis=1)))) < 0.03
    assert np.sqrt(np.mean(np.sum(errors[:, :3] ** 2, axis=1))) < 0.001
    nees = [e @ np.linalg.solve(f.cov, e) for e, f in zip(errors, found, strict=True)]
    # 6 expected; the mean of 21 samples of chi square with 6 degrees has a standard error of 0.76, and
    # covariances from 12 captures have heavier tails than that.
    assert 3.5 < np.mean(nees) < 10


@pytest.mark.long
def test_consistent_sessions_have_no_findings(sound):
    for session in sound:
        pair = related(session)
        assert len(pair.captures) == 12
        assert not pair.apart.is_significant
        assert findings(pair) == []


@pytest.mark.parametrize("seed", range(2))
def test_stale_extrinsics_contradict_images(seed):
    """Extrinsics from before the camera was rotated, and captures of both cameras from after it."""
    session = simulate_two(12, seed)
    left, right = (fit_extrinsic(session[name], BOARD, OPTIONS) for name in (LEFT, RIGHT))
    stale = replace(right, T_cam_lidar=perturb(right.T_cam_lidar, 2 * TURNED))
    (apart,) = findings(relate(left, stale))
    assert apart.code == "verdict.cameras_differ"
    assert apart.subject.split(" to ") == [LEFT, RIGHT]
    # Boards are 1.2 to 3.5 m away: 1 deg is 21 to 61 mm.
    assert 0.025 < apart.figure("rms_m") < 0.055


def test_scaled_lens_moves_the_boards():
    session = observed(simulate_two(12, 0))
    longer = []
    for left, right in session:
        T = right.image.T_cam_board.copy()
        T[:3, 3] *= 1.03
        longer.append((left, replace(right, pose=replace(right.image, T_cam_board=T))))
    plain, scaled = (pose_from_images(each) for each in (session, longer))
    assert plain.board_rms_m < 0.002 < 0.012 < scaled.board_rms_m


def test_camera_pair_outlier_board_hardly_matters():
    session = observed(simulate_two(12, 1))
    left, right = session[3]
    wrong = perturb(right.image.T_cam_board, np.array([0.05, 0, 0.1, 0.2, 0, 0]))
    session[3] = left, replace(right, pose=replace(right.image, T_cam_board=wrong))
    error = difference(pose_from_images(session).T_second_first, T_RIGHT_LEFT)
    assert np.degrees(np.linalg.norm(error[3:])) < 0.1
    assert np.linalg.norm(error[:3]) < 0.003


def test_camera_pair_of_few_boards_is_not_judged():
    session = simulate_two(12, 2)
    assert pose_from_images(observed(session)[:3]) is None
    left = fit_extrinsic(session[LEFT][:6], BOARD, OPTIONS)
    right = fit_extrinsic(session[RIGHT][6:], BOARD, OPTIONS)
    assert relate(left, right) is None
    three = relate(left, fit_extrinsic(session[RIGHT][3:], BOARD, OPTIONS))
    assert three.from_images is None
    assert len(three.captures) == 3
    assert findings(three) == []


def test_shared_boards_are_paired_by_scan():
    pairs = observed(simulate_two(12, 3))
    left = {o.capture: o for o, _ in pairs}
    renamed = {f"{k:06d}": replace(o, capture=f"{k:06d}") for k, (_, o) in enumerate(pairs, 100)}
    shared = shared_boards(left, renamed)
    assert [(one.capture, int(other.capture)) for one, other in shared] == [
        (f"{k:06d}", k + 100) for k in range(12)
    ]
