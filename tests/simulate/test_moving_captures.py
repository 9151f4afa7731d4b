"""Captures of a moving board: images, scans and events show one board at their own times."""

from dataclasses import replace

import numpy as np
import pytest

from lce_rig.core.geometry import transform
from lce_rig.simulate import HandMotion, SimulationOptions, simulate_captures, truth_extrinsics
from lce_rig.simulate.sampling import StagedBoard
from lce_rig.simulate.stage import set_stage
from tests.exact_lidar import EXACT

from .conftest import PERFECT, QUIET_EVENTS, make_rig

MOVING = SimulationOptions(carrier="person", motion="moving", hand=HandMotion(speed_mps=(0.15, 0.3)))
QUIET = replace(
    MOVING,
    carrier="none",
    lidar=EXACT,
    camera=PERFECT,
    events=QUIET_EVENTS,
    hand=HandMotion(speed_mps=(0.3, 0.3)),
    distance_m=(1.4, 2.0),
)
BRIEF = replace(QUIET, events_span_s=(0.2, 0.1))
CHANNELS = {"frames": {"kind": "frames"}, "events": {"kind": "events"}}


def moving_rig(**channels):
    camera = make_rig().cameras["cam"].model_dump()
    return make_rig(cameras={"cam": {**camera, "channels": channels or CHANNELS}})


@pytest.fixture(scope="module")
def rig():
    return moving_rig()


@pytest.fixture(scope="module")
def captures(rig):
    return list(simulate_captures(rig, n_captures=2, seed=5, options=MOVING))


@pytest.fixture(scope="module")
def quiet(rig):
    return next(simulate_captures(rig, n_captures=1, seed=6, options=BRIEF))


def stamp_of(image):
    assert image.stamp_ns is not None
    return image.stamp_ns


def found_corners(rig, image, T_cam_board):
    """Corners refined in an image from the true ones, and the truth (N, 2)."""
    import cv2

    corners = transform(T_cam_board, rig.board.to_board().corners())
    truth, _ = rig.cameras["cam"].to_intrinsics().project(corners)
    start = truth.astype(np.float32).reshape(-1, 1, 2)
    found = cv2.cornerSubPix(image.grey, start, (4, 4), (-1, -1), (3, 50, 1e-4)).reshape(-1, 2)
    return found, truth


@pytest.mark.long
def test_truth_at_any_time_is_the_same_for_camera_and_lidar(rig, captures):
    T_cam_lidar = truth_extrinsics(rig, 5, MOVING)["cam", "lidar"]
    for capture in captures:
        scan_ns = capture.scans[0].stamp_ns or 0
        times_ns = scan_ns + np.array([-300_000_000, 0, 70_000_000])
        T_lidar_board = capture.T_sensor_board("lidar", times_ns)
        assert np.allclose(capture.T_sensor_board("cam", times_ns), T_cam_lidar @ T_lidar_board, atol=1e-12)
        assert np.array_equal(capture.T_lidar_board["lidar"], capture.T_sensor_board("lidar", scan_ns))
        picture_ns = stamp_of(capture.images[0])
        assert np.array_equal(capture.T_cam_board["cam"], capture.T_sensor_board("cam", picture_ns))


@pytest.mark.long
def test_pictures_and_events_surround_the_scan(captures):
    phases_ns = []
    for capture in captures:
        scan_ns, events = capture.scans[0].stamp_ns or 0, capture.events[0]
        phases_ns.append(stamp_of(capture.images[0]) - scan_ns - 50_000_000)
        assert abs(phases_ns[-1]) <= 25_000_000
        assert (events.sensor, events.width_px, events.height_px) == ("cam", 346, 260)
        assert events.t_ns[0] == pytest.approx(scan_ns - 1.2e9, abs=2e7)
        assert events.t_ns[-1] == pytest.approx(scan_ns + 0.15e9, abs=2e7)
        assert np.all(np.diff(events.t_ns) >= 0) and np.all(events.t_ns % 1000 == 0)
        assert capture.scans[0].offset_ns is not None
    assert np.ptp(phases_ns) > 1_000_000, "the camera runs freely"


@pytest.mark.long
def test_event_rates_are_those_of_a_davis346(captures):
    for capture in captures:
        events = capture.events[0]
        rate_hz = len(events) / 1.35
        assert 5e4 < rate_hz < 3e6
        assert 0.3 < events.polarity.mean() < 0.7
        per_pixel = np.bincount(events.y.astype(int) * 346 + events.x, minlength=346 * 260) / 1.35
        quiet_hz = np.mean(np.sort(per_pixel)[: len(per_pixel) // 2])
        assert quiet_hz < 0.5, "where nothing moves there is little"
        assert np.sum(per_pixel > 9.0) >= 5 and per_pixel.max() > 50


def test_events_without_noise_reproduce_the_scene(rig, quiet):
    stage = set_stage(rig, 6, BRIEF)
    view = StagedBoard(stage, quiet.trajectory, stage.rng(0)).view("cam")
    noise, events = BRIEF.events, quiet.events[0]
    scan_ns = quiet.scans[0].stamp_ns or 0
    start, end = (
        np.log(view.at(scan_ns + dt).astype(float).ravel() + noise.dark_radiance)
        for dt in (-200_000_000, 100_000_000)
    )
    step = np.where(events.polarity, noise.threshold_on, -noise.threshold_off)
    told = np.bincount(events.y.astype(int) * 346 + events.x, weights=step, minlength=346 * 260)
    assert np.abs(end - start - told).max() <= max(noise.threshold_on, noise.threshold_off) + 1e-4
    assert np.abs(told).max() > 2.0


def test_stamps_mark_the_middle_of_the_exposure(rig):
    options = replace(BRIEF, exposure_s=0.02, events_span_s=(0.0, 0.01))
    for capture in simulate_captures(rig, n_captures=1, seed=8, options=options):
        picture_ns = stamp_of(capture.images[0])
        found, truth = found_corners(rig, capture.images[0], capture.T_cam_board["cam"])
        assert np.sqrt(np.mean((found - truth) ** 2)) < 0.08
        early = capture.T_sensor_board("cam", picture_ns - 10_000_000)
        _, at_start = found_corners(rig, capture.images[0], early)
        assert np.linalg.norm((found - at_start).mean(axis=0)) > 5 * np.linalg.norm(
            (found - truth).mean(axis=0)
        )


@pytest.mark.long
def test_stamps_include_their_channel_offset(rig, quiet):
    late = replace(BRIEF, frame_offset_s=0.12, event_offset_s=-0.015)
    capture = next(simulate_captures(rig, n_captures=1, seed=6, options=late))
    assert stamp_of(capture.images[0]) == stamp_of(quiet.images[0])
    shown = capture.T_sensor_board("cam", stamp_of(capture.images[0]) - 120_000_000)
    assert np.array_equal(capture.T_cam_board["cam"], shown)
    found, truth = found_corners(rig, capture.images[0], shown)
    assert np.sqrt(np.mean((found - truth) ** 2)) < 0.08
    both = capture.events[0], quiet.events[0]
    assert [events.t_ns[0] for events in both] == pytest.approx([both[1].t_ns[0]] * 2, abs=2e7)
    # The same flash of the scene is timestamped 15 ms earlier: activity follows the speed, shifted.
    scan_ns = quiet.scans[0].stamp_ns or 0
    edges = scan_ns + 1_000_000 * np.arange(-150, 90, 10)
    shifted, plain = np.histogram(both[0].t_ns, edges - 15_000_000)[0], np.histogram(both[1].t_ns, edges)[0]
    assert np.corrcoef(shifted[5:], plain[5:])[0, 1] > 0.95
    assert capture.scans[0].points.tobytes() == quiet.scans[0].points.tobytes()
