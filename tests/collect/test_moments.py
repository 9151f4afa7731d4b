"""A continuous recording is cut where the board stands still and differs from what is there."""

import shutil

import numpy as np
import pytest

from lce_rig.collect import CollectOptions, collect
from lce_rig.io import open_recording
from lce_rig.rig import dump_rig, parse_rig
from lce_rig.session import Session


@pytest.fixture(scope="module")
def bag(tmp_path_factory, visit, write_bag):
    return write_bag(tmp_path_factory.mktemp("bag") / "visit.bag", visit)


@pytest.fixture(scope="module")
def collected(tmp_path_factory, bag, rig):
    path = tmp_path_factory.mktemp("collected") / "s"
    with Session.create(path, rig) as session:
        report = collect(session, [open_recording(bag, rig)])
    return path, report


def test_two_stands_become_two_captures_and_the_way_between_none(collected, paths):
    path, report = collected
    captures = Session.open(path).captures
    assert report.captured == [c.name for c in captures] == ["000000", "000001"]
    assert report.counts.by_code()["calibrate.same_placement"] == 1
    assert not report.errors
    for capture, placement in zip(captures, (paths["left"], paths["right"]), strict=True):
        truth = paths["T_cam_lidar"] @ placement.to_pose()
        found = np.array(capture.meta["T_cam_board"]["cam.frames"])
        np.testing.assert_allclose(found[:3, 3], truth[:3, 3], atol=0.02)
        assert capture.meta["motion_m"] < 0.005
        image, scan = capture.image("cam", "frames"), capture.scan("lidar")
        assert abs(image.stamp_ns - scan.stamp_ns - 50_000_000) < 1_000_000 and len(scan.points) == 28_800


def test_a_rejected_placement_is_not_captured_again_from_its_recording(collected, bag, rig, tmp_path):
    shutil.copytree(collected[0], tmp_path / "s")
    with Session.resume(tmp_path / "s", rig) as session:
        session.reject("000001")
        report = collect(session, [open_recording(bag, rig)])
    assert (report.captured, report.n_resumed, report.n_rejected, len(session.captures)) == ([], 1, 1, 1)


def test_a_second_run_captures_nothing_again(collected, bag, rig):
    path, _ = collected
    with Session.resume(path, rig) as session:
        report = collect(session, [open_recording(bag, rig)])
    assert (report.captured, report.n_resumed, len(session.captures)) == ([], 2, 2)


@pytest.mark.long
def test_a_recording_stops_at_the_target_or_says_what_is_missing(tmp_path, bag, rig):
    with Session.create(tmp_path / "one", rig) as session:
        report = collect(session, [open_recording(bag, rig)], CollectOptions(target=1))
    assert (len(report.captured), report.n_missing) == (1, 0)
    with Session.resume(tmp_path / "one", rig) as session:
        report = collect(session, [open_recording(bag, rig)], CollectOptions(target=5))
    assert (len(session.captures), report.n_missing) == (2, 3)


def test_a_torn_bag_gives_the_captures_before_the_damage_and_an_error(tmp_path, visit, write_bag, rig):
    bag = write_bag(tmp_path / "torn.bag", visit)
    damaged = bytearray(bag.read_bytes())
    place = damaged.index(b"op=\2", int(0.45 * len(damaged)))
    damaged[place : place + 2] = b"??"
    bag.write_bytes(bytes(damaged))
    with Session.create(tmp_path / "s", rig) as session:
        report = collect(session, [open_recording(bag, rig)])
    assert report.captured == ["000000"]
    (error,) = report.errors
    assert "torn.bag" in error.what and "could be" not in error.hint


def test_a_board_that_never_stands_still_is_never_captured(tmp_path, stage, paths, write_bag, rig):
    path = paths["carry"]((paths["left"], 1), (paths["right"], 1), n_moving=8)
    bag = write_bag(tmp_path / "a.bag", stage.frames(path))
    with Session.create(tmp_path / "s", rig) as session:
        report = collect(session, [open_recording(bag, rig)])
        assert report.captured == []
        # A hand never holds a board quite still: how much is still enough is an option.
        loose = CollectOptions(max_motion_m=0.5)
        assert collect(session, [open_recording(bag, rig)], loose).captured == ["000000"]


def test_clocks_that_are_apart_are_said_and_bridged_by_the_profile(tmp_path, stage, paths, write_bag, rig):
    samples = sorted(stage.frames([paths["left"]] * 9, lag_ns=3 * 10**9), key=lambda s: s.stamp_ns)
    bag = write_bag(tmp_path / "a.bag", samples)
    with Session.create(tmp_path / "apart", rig) as session:
        report = collect(session, [open_recording(bag, rig)])
    assert report.captured == []
    ((alone, n),) = [each for each in report.counts.counts() if each[0].code == "read.no_image_at_scan"]
    assert n == 9 and 2.2 <= alone.figure("nearest_s") < 2.3
    channel = rig.cameras["cam"].channels["frames"]
    stamps = channel.timestamps.model_copy(update={"expected_offset_s": -3.0})
    channels = {"frames": channel.model_copy(update={"timestamps": stamps})}
    cameras = {"cam": rig.cameras["cam"].model_copy(update={"channels": channels})}
    bridged = parse_rig(dump_rig(rig.model_copy(update={"cameras": cameras})))
    with Session.create(tmp_path / "bridged", bridged) as session:
        assert len(collect(session, [open_recording(bag, bridged)]).captured) == 1
