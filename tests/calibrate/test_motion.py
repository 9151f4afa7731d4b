"""The motion of a board between pictures, and the clocks of the channels that took them."""

from dataclasses import replace

import numpy as np
import pytest

from lce_rig.calibrate import Clocks, EstimateSettings, estimate_extrinsics, fit_extrinsic
from lce_rig.calibrate.motion.board_motion import deskew, fit_motions, sample_poses
from lce_rig.calibrate.observations import SharedScan
from lce_rig.core.geometry import difference, invert
from tests.calibrate.boards import BOARD, T_FORWARD, Scenario, random_pose, scan_board
from tests.calibrate.moving_boards import Moving, simulate_moving, skew

OPTIONS = EstimateSettings("paper")
TRACKED = Moving(tracked=("events",))


def errors(T_cam_lidar):
    """Measure an extrinsic's error as (deg, mm)."""
    off = difference(T_cam_lidar, T_FORWARD)
    return np.array([np.degrees(np.linalg.norm(off[3:])), 1000 * np.linalg.norm(off[:3])])


def samples_of(captures, noise_px):
    scans = [
        SharedScan((one.capture,), {channel: captures[channel][k].image for channel in captures}, one.lidar)
        for k, one in enumerate(captures["frames"])
    ]
    return sample_poses(scans, Clocks(), noise_px)


def test_fit_motions_rates_match_covariance():
    captures = simulate_moving(40, 3, TRACKED)
    samples = samples_of(captures, {"frames": 0.1, "events": 0.2})
    offset_s = np.array([dict(TRACKED.offset_s)[channel] for channel in samples.channels])
    motions = fit_motions(samples, offset_s)
    speed = np.sqrt(np.mean(motions.rates[:, :3] ** 2))
    assert 0.7 < speed / TRACKED.speed_mps < 1.3
    later = fit_motions(samples, offset_s, only="frames").at(np.full(40, 0.05))
    apart = difference(later, motions.at(np.full(40, 0.05)))
    cov = motions.cov_at(np.full(40, 0.05)) + fit_motions(samples, offset_s, only="frames").cov_at(
        np.full(40, 0.05)
    )
    nees = np.einsum("fi,fij,fj->f", apart, np.linalg.inv(cov), apart)
    assert np.mean(nees) < 6 * 1.5


def test_deskewed_points_lie_on_one_plane():
    rng = np.random.default_rng(5)
    quiet = Scenario(range_sigma_m=0.0)
    T_cam_board = random_pose(rng, quiet, BOARD)
    still = scan_board(invert(T_FORWARD) @ T_cam_board, rng, quiet, BOARD)
    rates = np.array([0.3, -0.2, 0.4, 0.3, -0.2, 0.1])
    moving = skew(still, rates, 0.05)
    R = T_FORWARD[:3, :3].T
    straight = deskew(moving, np.r_[R @ rates[:3], R @ rates[3:]])
    turned, left = (np.linalg.norm(each.plane[:3] - still.plane[:3]) for each in (moving, straight))
    assert np.degrees(turned) > 0.1
    assert np.degrees(left) < 0.01
    assert abs(straight.plane[3] - still.plane[3]) < 2e-4


@pytest.fixture(scope="module")
def followed():
    """Several sessions of moving boards whose events were followed: the captures and what comes of them."""
    sessions = [simulate_moving(20, seed, TRACKED) for seed in range(4)]
    return [(captures, estimate_extrinsics(captures, BOARD, OPTIONS, Clocks())) for captures in sessions]


def scores_of(results, moving):
    return [
        (channel.time_offset_s - dict(moving.offset_s)[channel.channel]) / channel.time_offset_sigma_s
        for result in results
        for channel in result.channels
    ]


@pytest.mark.long
def test_motion_time_offsets_are_found_to_ms(followed):
    results = [result for _, result in followed]
    # Eight scores: the 99.9 % point of chi-squared over its freedoms is 3.3.
    assert np.mean(np.square(scores_of(results, TRACKED))) < 3.3
    assert max(channel.time_offset_sigma_s for result in results for channel in result.channels) < 0.004


@pytest.mark.long
def test_time_offsets_are_found_from_two_images_per_capture():
    moving = Moving()
    results = [
        estimate_extrinsics(simulate_moving(20, s, moving), BOARD, OPTIONS, Clocks()) for s in range(2)
    ]
    # Four scores: the 99.9 % point of chi-squared over its freedoms is 4.6.
    assert np.mean(np.square(scores_of(results, moving))) < 4.6


@pytest.mark.long
def test_motion_compensation_halves_error(followed):
    compensated = [errors(result.T_cam_lidar) for _, result in followed]
    plain = [
        errors(fit_extrinsic(captures["events"], BOARD, OPTIONS).T_cam_lidar) for captures, _ in followed
    ]
    rms, plain_rms = (np.sqrt(np.mean(np.square(e), axis=0)) for e in (compensated, plain))
    assert np.all(rms < plain_rms / 2)
    assert np.all(rms < [0.07, 2.5])


@pytest.mark.long
def test_extrinsics_covariance_covers_moving_boards(followed):
    nees = []
    for _, result in followed:
        off = difference(result.T_cam_lidar, T_FORWARD)
        nees.append(off @ np.linalg.solve(result.cov, off))
    # The mean of four chi-squared variables of six freedoms lies between these with 99.9 %.
    assert 1.9 < np.mean(nees) < 13.0


@pytest.mark.long
def test_corner_noise_is_estimated_by_channel(followed):
    noise_px = {channel.channel: channel.noise_px for channel in followed[0][1].channels}
    assert noise_px["frames"] == pytest.approx(0.1, rel=0.05)
    assert noise_px["events"] == pytest.approx(0.2, rel=0.05)


def test_tracked_channel_alone_is_compensated():
    captures = {"events": simulate_moving(25, 1, TRACKED)["events"]}
    result = estimate_extrinsics(captures, BOARD, OPTIONS, Clocks())
    (events,) = result.channels
    assert abs(events.time_offset_s - 0.06) < 4 * events.time_offset_sigma_s
    assert np.all(errors(result.T_cam_lidar) < [0.1, 4.0])


@pytest.mark.long
def test_motion_profile_offset_is_subtracted():
    captures = simulate_moving(25, 2, TRACKED)
    clocks = Clocks(channel_offset_s=dict(TRACKED.offset_s))
    for channel in estimate_extrinsics(captures, BOARD, OPTIONS, clocks).channels:
        assert abs(channel.time_offset_s) < 4 * channel.time_offset_sigma_s + 1e-3


@pytest.mark.long
def test_motion_unstamped_images_are_timed():
    moving = Moving(has_stamps=False)
    captures = simulate_moving(25, 0, moving)
    result = estimate_extrinsics(captures, BOARD, OPTIONS, Clocks())
    assert np.all(
        errors(result.T_cam_lidar) < errors(fit_extrinsic(captures["frames"], BOARD, OPTIONS).T_cam_lidar)
    )
    for channel in result.channels:
        assert abs(channel.time_offset_s - dict(moving.offset_s)[channel.channel]) < 0.02


def test_motion_still_boards_give_no_offset():
    captures = simulate_moving(20, 4, Moving(speed_mps=0.0, turn_deg_s=0.0))
    together = estimate_extrinsics(captures, BOARD, OPTIONS, Clocks())
    assert np.all(errors(together.T_cam_lidar) < [0.06, 2.5])
    assert all(channel.time_offset_s is None for channel in together.channels)


def test_motion_single_channel_is_unchanged():
    captures = simulate_moving(12, 0)["frames"]
    plain = fit_extrinsic(captures, BOARD, OPTIONS)
    result = estimate_extrinsics({"frames": captures}, BOARD, OPTIONS, Clocks())
    np.testing.assert_array_equal(result.T_cam_lidar, plain.T_cam_lidar)
    np.testing.assert_array_equal(result.cov, plain.cov)
    assert result.channels[0].time_offset_s is None
    assert result.channel_difference is None


@pytest.mark.long
def test_motion_upside_down_image_is_rotated(followed):
    captures, right = followed[0]
    half_turn = np.diag([-1.0, -1.0, 1.0, 1.0])
    flipped = [
        replace(item, pose=replace(item.image, T_cam_board=item.image.T_cam_board @ half_turn))
        if k % 3 == 0
        else item
        for k, item in enumerate(captures["events"])
    ]
    turned = estimate_extrinsics({**captures, "events": flipped}, BOARD, OPTIONS, Clocks())
    np.testing.assert_allclose(turned.T_cam_lidar, right.T_cam_lidar, atol=1e-6)


def test_motion_same_scan_is_one_placement():
    captures = simulate_moving(15, 0)
    elsewhere = [replace(item, capture=f"1{item.capture[1:]}") for item in captures["events"]]
    result = estimate_extrinsics(
        {"frames": captures["frames"], "events": elsewhere}, BOARD, OPTIONS, Clocks()
    )
    assert len(result.used) == 15
    assert result.same_scan["000003"] == ("000003", "100003")


@pytest.mark.long
def test_motion_channel_difference_is_found(followed):
    apart = (0.03, 0.0, 0.0, 0.0, np.radians(1.0), 0.0)
    moved = estimate_extrinsics(
        simulate_moving(20, 0, replace(TRACKED, apart=apart)), BOARD, OPTIONS, Clocks()
    )

    assert not any(result.channel_difference.is_significant for _, result in followed)
    assert moved.channel_difference.chi2 > 50
    assert np.degrees(np.linalg.norm(moved.channel_difference.tangent[3:])) == pytest.approx(1.0, abs=0.3)
