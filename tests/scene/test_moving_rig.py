"""A rig that drives: its motion from two scans, its edges at the images' time, its clocks compared."""

from dataclasses import replace

import numpy as np
import pytest

from lce_rig.core.calibration import MOTIONS, ResultFile
from lce_rig.core.data import Events
from lce_rig.core.geometry import difference, exp_so3, perturb, pose, transform
from lce_rig.io.ros.bag_recorder import BagRecorder
from lce_rig.pipeline.scene_calibration import View, calibrate_pair, calibrate_scene
from lce_rig.pipeline.watch_drift import SceneCaptures
from lce_rig.rig import NominalExtrinsic, load_rig
from lce_rig.scene.rig_motion import estimate_motion
from lce_rig.timing.scan_pairing import EventCut, Frame
from tests.scene.conftest import deployed, small_rig
from tests.scene.moving_rig import START_NS, MovingRig
from tests.shared import compute_once

pytestmark = pytest.mark.long
PERIOD_NS = 100_000_000
DRIVES = [((0.8, 0.2), 0.35, (0, 0)), ((0.5, -0.3), -0.4, (0.8, 0.5)), ((0.3, -0.5), 0.45, (1.0, -0.5))]


@pytest.fixture(scope="module")
def driven():
    """Captures of three drives: the rig's motion, the scan before, the scan, an image 30 ms or more later."""
    captures = []
    for k, (velocity, turn, at) in enumerate(DRIVES):
        rig = MovingRig.build(small_rig(), 2, (*velocity, 0.0), (0, 0, turn), at)
        for step in (0, 5):
            start_ns = START_NS + step * PERIOD_NS
            before = rig.scan("lidar", start_ns - PERIOD_NS, 10 * k + step)
            scan = rig.scan("lidar", start_ns, 100 + 10 * k + step)
            image = rig.image("cam", start_ns + 30_000_000 + 15_000_000 * k, k)
            captures.append((rig, before, scan, image))
    return captures


def watch_captures(driven, late_ns=0, change=lambda scan: scan, T_cam_lidar=None):
    rig = driven[0][0]
    T = rig.truth("cam", "lidar") if T_cam_lidar is None else T_cam_lidar
    result = ResultFile(rig=rig.stage.rig.name, pairs=(deployed(T),))
    captures = SceneCaptures(rig.stage.rig, result, "the drive")
    for _, before, scan, image in driven:
        stamped = replace(image, stamp_ns=image.stamp_ns - late_ns)
        for each, images in ((before, ()), (scan, (stamped,))):
            captures.take_frame(Frame(each.stamp_ns, images, (change(each),)))
    (pair,) = captures.judge().pairs
    return pair.drift


def test_two_scans_determine_the_motion(driven):
    for rig, before, scan, _ in driven:
        motion = estimate_motion(before, scan)
        T_world_lidar = rig.sensor_at("lidar", before.stamp_ns)
        velocity = T_world_lidar[:3, :3].T @ rig.velocity_mps
        assert np.linalg.norm(motion.velocity_mps - velocity) < 0.08
        assert motion.rate_rad_s == pytest.approx(rig.rate_rad_s, abs=0.012)


def test_standing_rig_scans_give_no_motion(seen):
    standing = MovingRig.build(small_rig(), 2, (0, 0, 0), (0, 0, 0))
    before, scan = (standing.scan("lidar", START_NS + k * PERIOD_NS, k) for k in range(2))
    assert estimate_motion(before, scan).is_still
    assert estimate_motion(before, replace(scan, stamp_ns=None)) is None
    assert estimate_motion(before, replace(scan, stamp_ns=before.stamp_ns + 4 * 10**9)) is None


def test_a_drive_with_true_extrinsics_shows_no_change(driven):
    drift = watch_captures(driven)
    assert drift.n_captures == len(driven)
    assert drift.state == "unchanged" and [f.code for f in drift.findings] == ["scene.unchanged"]
    yaw, aside = (drift.change.tangent[MOTIONS.index(axis)] for axis in ("rotation_y", "translation_x"))
    assert abs(np.degrees(yaw)) < 0.2 and abs(aside) < 0.02


@pytest.mark.parametrize("late_ns", [-100_000_000, 100_000_000])
def test_clock_difference_while_moving_never_passes(driven, late_ns):
    drift = watch_captures(driven, late_ns)
    assert drift.state != "unchanged"
    apart = [f.figures["apart_s"] for f in drift.findings if f.code.startswith("scene.clocks")]
    assert apart == [pytest.approx(1e-9 * late_ns, abs=0.03)]


@pytest.fixture(scope="module")
def straight():
    """Captures of a drive straight ahead, which the clocks and the line of sight explain alike."""
    captures = []
    for k in range(4):
        rig = MovingRig.build(small_rig(), 2, (1.2, 0.0, 0.0), (0, 0, 0), (0.3 * k, 0.0))
        before, scan = (rig.scan("lidar", START_NS + step * PERIOD_NS, 10 * k + step + 1) for step in (-1, 0))
        captures.append((rig, before, scan, rig.image("cam", START_NS + 50_000_000, k)))
    return captures


def test_drift_names_clocks_that_explain_a_change(straight):
    drift = watch_captures(straight, 100_000_000)
    assert drift.state == "changed"
    summary, clocks, *_ = drift.findings
    assert summary.code in ("scene.changed", "scene.elsewhere") and clocks.code == "scene.clocks_instead"
    assert clocks.figures["apart_s"] == pytest.approx(0.1, abs=0.03)


def test_clocks_are_not_named_where_only_the_extrinsics_explain(driven):
    shifted = perturb(driven[0][0].truth("cam", "lidar"), np.array([0.15, 0, 0, 0, 0, 0]))
    drift = watch_captures(driven, T_cam_lidar=shifted)
    assert drift.state == "changed" and abs(drift.change.tangent[0] + 0.15) < 0.05
    assert not [f for f in drift.findings if f.code.startswith("scene.clocks")]


def test_scans_without_firing_times_are_not_used_while_moving(driven):
    drift = watch_captures(driven, change=lambda scan: replace(scan, offset_ns=None))
    assert drift.n_captures == 0 and drift.state == "unknown"
    assert [f.figures["n_captures"] for f in drift.findings if f.code == "scene.no_firing_times"] == [6]


def calibrated(driven, change=lambda scan: scan):
    rig = driven[0][0]
    off = perturb(rig.truth("cam", "lidar"), np.array([0.04, -0.03, 0.03, 0.008, -0.008, 0.006]))
    nominal = NominalExtrinsic(
        camera="cam", lidar="lidar", matrix=off[:3, :3].tolist(), translation_m=off[:3, 3].tolist()
    )
    views = [
        View(str(k), (image,), (change(scan),), previous={"lidar": before})
        for k, (_, before, scan, image) in enumerate(driven)
    ]
    return calibrate_pair(rig.stage.rig, nominal, views)[0]


def test_scene_calibration_moves_edges_to_images(driven):
    c = calibrated(driven)
    tangent = difference(c.T_cam_lidar, driven[0][0].truth("cam", "lidar"))
    assert tangent @ np.linalg.solve(c.cov, tangent) < 16.81
    assert np.degrees(np.linalg.norm(tangent[3:])) < 0.3 and np.linalg.norm(tangent[:3]) < 0.03


def test_scene_calibration_untimed_moving_is_no_result(driven):
    found = calibrated(driven, lambda scan: replace(scan, offset_ns=None))
    assert found.code == "scene_calibration.moving"


def drive_by_events():
    """Pan and tilt a DAVIS346 without frames through a room: profile, truth, and twelve views."""
    rng, views = np.random.default_rng(1), []
    standing = MovingRig.build(load_rig("rles"), 1, (0, 0, 0), (0, 0, 0))
    profile, truth = standing.stage.rig, standing.truth("davis", "lidar")
    lens = profile.cameras["davis"].to_intrinsics()
    for k in range(12):
        heading = exp_so3(np.array([0.0, 0.0, rng.uniform(-np.pi, np.pi)]))
        rig = replace(
            standing,
            velocity_mps=rng.uniform(-0.5, 0.5, 3),
            rate_rad_s=rng.uniform(0.25, 0.6, 3) * rng.choice([-1, 1], 3),
            T_world_start=pose(heading, np.append(rng.uniform(-0.8, 0.8, 2), 0.0)),
        )
        before, scan = (rig.scan("lidar", START_NS + step * PERIOD_NS, 10 * k - step) for step in (-1, 0))
        pixels, is_valid = lens.project(transform(truth, scan.points))
        seen_ns = START_NS + int(np.median(scan.offset_ns[is_valid & lens.is_inside(pixels)]))
        events = rig.events("davis", seen_ns - 16_000_000, seen_ns + 16_000_000, k, n_steps=6)
        cut = EventCut((events,), int(events.t_ns[0]), int(events.t_ns[-1]) + 1, 0, 0)
        views.append(View(str(k), (), (scan,), (cut,), {"lidar": before}))
    return profile, truth, views


@pytest.fixture(scope="module")
def event_drive():
    return compute_once("event_drive", drive_by_events)


def with_nominal(profile, truth):
    """Enter a nominal pose 5 cm and 1 deg off."""
    off = perturb(truth, np.array([0.05, -0.04, 0.06, 0.012, -0.01, 0.014]))
    nominal = NominalExtrinsic(
        camera="davis", lidar="lidar", matrix=off[:3, :3].tolist(), translation_m=off[:3, 3].tolist()
    )
    return profile.model_copy(update={"nominal_extrinsics": (nominal,)})


def calibrated_by_events(profile, truth, views):
    rig = with_nominal(profile, truth)
    return calibrate_pair(rig, rig.nominal_extrinsics[0], views)


def test_scene_calibration_by_events_covers_truth(event_drive):
    profile, truth, views = event_drive
    c, drawn = calibrated_by_events(profile, truth, views)
    tangent = difference(c.T_cam_lidar, truth)
    assert c.channels == ("events",) and len(drawn) == len(views)
    assert tangent @ np.linalg.solve(c.cov, tangent) < 16.81
    assert np.degrees(np.linalg.norm(tangent[3:])) < 0.4 and np.linalg.norm(tangent[:3]) < 0.04


def test_scene_calibration_by_events_needs_motion(event_drive):
    profile, truth, views = event_drive
    standing = [replace(view, previous={"lidar": view.scans[0]}) for view in views[:2]]
    shortage, _ = calibrated_by_events(profile, truth, standing)
    assert shortage.code == "scene_calibration.events_of_standing_rig" and "cannot tell" in shortage.text


def later(sample, by_ns):
    """Move a scan or events to a later time."""
    if isinstance(sample, Events):
        return replace(sample, t_ns=sample.t_ns + by_ns)
    return replace(sample, stamp_ns=sample.stamp_ns + by_ns, host_ns=sample.stamp_ns + by_ns + PERIOD_NS)


def test_scene_calibration_stores_events_of_bag(event_drive, tmp_path):
    profile, truth, views = event_drive
    rig = with_nominal(profile, truth)
    with BagRecorder(tmp_path / "drive.bag", rig) as bag:
        for k, view in enumerate(views):
            for sample in (view.previous["lidar"], *view.scans, view.events[0].events):
                bag.write(later(sample, k * 10**9))
    found = calibrate_scene([tmp_path / "drive.bag"], tmp_path / "out", rig=rig)
    again = calibrate_scene([tmp_path / "out"], "")
    for (c,) in (found.result.pairs, again.result.pairs):
        tangent = difference(c.T_cam_lidar, truth)
        assert len(c.captures_used) == len(views)
        assert tangent @ np.linalg.solve(c.cov, tangent) < 16.81
