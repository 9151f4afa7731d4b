"""Boards badly visible in scans: refused or marked with the cause, never a wrong pass.

Most captures are of a simulated Mid-360, whose scans are accumulated for a second.
"""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml

from lce_rig.cli.main import run
from lce_rig.core.geometry import difference, pose
from lce_rig.core.pcd import encode_pcd
from lce_rig.io.ros.bag_recorder import BagRecorder
from lce_rig.rig import dump_rig, load_rig
from lce_rig.session import Session
from tests.detect.scans import Box
from tests.shared import half_size, make_once

# Of six freedoms, beyond which chance brings one of a thousand.
CHI2 = 22.5
TWO_LIDARS = Path(__file__).parents[1] / "rigs" / "two_lidars.yaml"


@pytest.fixture(scope="session")
def standing():
    """A session of seven boards that stand still, and its profile."""

    def make(folder):
        folder.mkdir()
        (folder / "rig.yaml").write_text(dump_rig(half_size(load_rig("mid360"))))
        words = ["--rig", folder / "rig.yaml", folder / "session", "--captures", 7, "--seed", 2]
        assert run(["simulate", *map(str, words)]) == 0

    return make_once("standing", make)


@pytest.fixture
def spoil(standing, tmp_path):
    """Write that session with its scans changed, given each with the board's pose before the LiDAR."""
    truth = json.loads((standing / "session" / "truth.json").read_text())

    def write(change):
        source = Session.open(standing / "session")
        with Session.create(tmp_path / "session", source.rig) as writer:
            for capture in source.captures:
                boards = truth["captures"][capture.name]["boards"]
                T_lidar_board = np.array(boards["lidar"]["T_sensor_board"])
                scan = change(capture.scan("lidar"), T_lidar_board)
                writer.add_capture([capture.image("cam", "frames")], [scan], {})
        shutil.copy(standing / "session" / "truth.json", tmp_path / "session")
        return tmp_path / "session"

    return write


def codes_of(lce_rig, session):
    """List the code of each capture that `check` refuses."""
    (pair,) = json.loads(lce_rig("check", session, "--json").out)["pairs"]
    return [each["refusal"]["code"] for each in pair["captures"].values() if not each["is_usable"]]


def assert_is_within_its_claim(session):
    """Compare the session's result with its truth."""
    truth = json.loads((session / "truth.json").read_text())
    (pair,) = json.loads((session / "calibration" / "result.json").read_text())["pairs"]
    off = difference(np.array(pair["T_cam_lidar"]), np.array(truth["T_cam_lidar"]))
    assert off @ np.linalg.solve(np.array(pair["cov"]), off) < CHI2


def turned(scan, deg_s):
    """Rotate a LiDAR about its axis while it scans."""
    angle = np.radians(deg_s) * 1e-9 * scan.offset_ns
    x, y, z = scan.points.T
    points = [np.cos(angle) * x - np.sin(angle) * y, np.sin(angle) * x + np.cos(angle) * y, z]
    return replace(scan, points=np.stack(points, axis=1).astype(np.float32))


@pytest.mark.long
@pytest.mark.parametrize("deg_s", [1.0, 4.0])
def test_turning_lidar_scans_are_refused(lce_rig, spoil, deg_s):
    session = spoil(lambda scan, _: turned(scan, deg_s))
    assert codes_of(lce_rig, session).count("lidar.moved") >= 4
    assert lce_rig("calibrate", session).code == 6


@pytest.mark.long
def test_moving_board_scans_are_refused(lce_rig, standing, tmp_path):
    words = (tmp_path / "moving", "--rig", standing / "rig.yaml", "--motion", "moving", "--captures", 3)
    assert lce_rig("simulate", *words).code == 0
    codes = codes_of(lce_rig, tmp_path / "moving")
    assert len(codes) == 3 and "lidar.moved" in codes
    assert lce_rig("calibrate", tmp_path / "moving").code == 6


@pytest.mark.long
@pytest.mark.parametrize(("deg_s", "n_captures"), [(0.0, 1), (2.0, 0)], ids=["standing", "turning"])
def test_collect_turning_lidar_is_rejected(lce_rig, standing, tmp_path, deg_s, n_captures):
    source = Session.open(standing / "session")
    capture = source.captures[0]
    image, scan = capture.image("cam", "frames"), turned(capture.scan("lidar"), deg_s)
    with BagRecorder.in_folder(tmp_path / "bag", source.rig) as recorder:
        for k in range(5):
            begun_ns = scan.stamp_ns + k * 10**9
            recorder.write(replace(image, stamp_ns=begun_ns + 5 * 10**8, host_ns=begun_ns + 5 * 10**8))
            recorder.write(replace(scan, stamp_ns=begun_ns, host_ns=begun_ns + 10**9))
        bag = recorder.path
    outcome = lce_rig("collect", tmp_path / "s", "--rig", standing / "rig.yaml", "--from", bag)
    assert outcome.code == (0 if n_captures else 6)
    assert len(Session.open(tmp_path / "s").captures) == n_captures
    *_, collected = map(json.loads, (tmp_path / "s" / "journal.jsonl").read_text().splitlines())
    assert ("lidar.moved" in collected["counts"]) == (not n_captures)


@pytest.mark.long
@pytest.mark.parametrize(("deep_m", "n"), [(0.0, 7), (0.0, 1), (0.1, 7)], ids=["flush", "once", "behind"])
def test_box_touching_plate_gives_no_wrong_result(lce_rig, spoil, deep_m, n):
    """It stands below half of the lower edge of n boards, its face in the plate's plane or a hand behind."""
    rng, n_scans = np.random.default_rng(0), 0

    def touched(scan, T):
        nonlocal n_scans
        n_scans += 1
        if n_scans > n:
            return scan
        middle = [0.15, -(0.626 + 0.35) / 2, -deep_m - 0.15]
        box = Box(pose(T[:3, :3], T[:3, 3] + T[:3, :3] @ middle), (0.35, 0.35, 0.3))
        range_m = np.linalg.norm(scan.points, axis=1)
        rays = scan.points / range_m[:, None]
        to_box_m = box.ranges(rays) + 0.01 * rng.standard_normal(len(rays))
        points = rays * np.minimum(range_m, to_box_m)[:, None]
        return replace(scan, points=points.astype(np.float32))

    session = spoil(touched)
    codes = codes_of(lce_rig, session)
    touched = {"lidar.touching", "lidar.other_plate", "lidar.moved"}
    assert set(codes) <= touched | {"lidar.not_where_expected"}
    assert bool(codes) == (deep_m == 0.0) and len(codes) <= n
    assert lce_rig("calibrate", session).code == (6 if len(codes) > 1 else 0)
    if len(codes) <= 1:
        assert_is_within_its_claim(session)


@pytest.mark.long
def test_board_half_out_of_view_is_refused(lce_rig, spoil):
    def cut(scan, T):
        azimuth = np.arctan2(scan.points[:, 1], scan.points[:, 0])
        return scan.select(np.flatnonzero(azimuth < np.arctan2(T[1, 3], T[0, 3]) + 0.04))

    session = spoil(cut)
    codes = codes_of(lce_rig, session)
    assert len(codes) == 7 and set(codes) <= {"lidar.out_of_view", "lidar.other_plate", "lidar.no_border"}
    assert lce_rig("calibrate", session).code == 6


@pytest.mark.long
@pytest.mark.parametrize(("has_dust", "has_tags"), [(True, True), (False, False), (True, False)])
def test_clouds_without_tags_are_used_whole(lce_rig, standing, tmp_path, has_dust, has_tags):
    """Dust before everything makes a tenth of the returns; tags mark them."""
    source, folder, rng = Session.open(standing / "session"), tmp_path / "folder", np.random.default_rng(0)
    for name in ("img", "pcd"):
        (folder / name).mkdir(parents=True)
    fields = [*((axis, "f4") for axis in "xyz"), *([("tag", "u1")] if has_tags else [])]
    for capture in source.captures:
        cv2.imwrite(str(folder / "img" / f"{capture.name}.png"), capture.image("cam", "frames").pixels)
        points = capture.scan("lidar").points
        is_dust = rng.random(len(points)) < 0.1 * has_dust
        points[is_dust] *= rng.uniform(0.2, 0.9, (is_dust.sum(), 1)).astype(np.float32)
        cloud = np.zeros(len(points), fields)
        for axis, column in zip("xyz", points.T, strict=True):
            cloud[axis] = column
        if has_tags:
            cloud["tag"] = is_dust
        (folder / "pcd" / f"{capture.name}.pcd").write_bytes(encode_pcd(cloud))
    session = tmp_path / "session"
    assert lce_rig("collect", session, "--rig", standing / "rig.yaml", "--from", folder).code == 0
    shutil.copy(standing / "session" / "truth.json", session)
    assert lce_rig("calibrate", session).code == 0
    assert_is_within_its_claim(session)


@pytest.mark.long
@pytest.mark.parametrize(
    ("model", "has_nominal", "finding"),
    [("VLP-16", True, "verdict.exchanged"), ("OS1-64", False, "verdict.other_model")],
)
def test_exchanged_lidar_names_fail(lce_rig, tmp_path, model, has_nominal, finding):
    profile = yaml.safe_load(TWO_LIDARS.read_text())
    profile["lidars"]["side"]["model"] = model
    (tmp_path / "lidars.yaml").write_text(yaml.safe_dump(profile))
    words = (tmp_path / "s", "--rig", tmp_path / "lidars.yaml", "--captures", 8, "--seed", 1)
    assert lce_rig("simulate", *words).code == 0
    source = Session.open(tmp_path / "s")
    rig = source.rig if has_nominal else source.rig.model_copy(update={"nominal_extrinsics": ()})
    with Session.create(tmp_path / "exchanged", rig) as writer:
        for capture in source.captures:
            front, side = (capture.scan(name) for name in ("front", "side"))
            writer.add_capture([], [replace(side, sensor="front"), replace(front, sensor="side")], {})
    assert lce_rig("calibrate", tmp_path / "exchanged").code == 7
    (pair,) = json.loads((tmp_path / "exchanged" / "calibration" / "result.json").read_text())["pairs"]
    assert finding in [each["code"] for each in pair["findings"]]
