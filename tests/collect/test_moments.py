"""Captures from a continuous recording: at still boards in new placements."""

import shutil

import numpy as np
import pytest

from lce_rig.cli.main import run
from lce_rig.collect.offline import collect
from lce_rig.core.errors import NotEnoughDataError, SourceError
from lce_rig.io import open_recording
from lce_rig.rig import dump_rig
from lce_rig.session import Session
from tests.collect.live.replay import placements
from tests.shared import changed

# A board stands, is carried on, stands elsewhere, and is carried back.
VISIT = [0] * 8 + [2, 3, 2, 3] + [1] * 8 + [3, 2, 3, 2] + [0] * 8


@pytest.fixture(scope="module")
def bag(tmp_path_factory, write_bag):
    return write_bag(tmp_path_factory.mktemp("bag") / "visit.bag", VISIT)


@pytest.fixture(scope="module")
def collected(tmp_path_factory, bag, rig):
    path = tmp_path_factory.mktemp("collected") / "s"
    with Session.create(path, rig) as session:
        report = collect(session, [open_recording(bag, rig)])
    return path, report


def test_collect_each_stand_is_captured_once(collected):
    path, report = collected
    captures = Session.open(path).captures
    assert report.captured == [c.name for c in captures] == ["000000", "000001"]
    assert report.counts.by_code()["calibrate.same_placement"] == 1
    assert not report.errors
    for capture, shown in zip(captures, placements(), strict=False):
        found = np.array(capture.meta["T_cam_board"]["davis.frames"])
        np.testing.assert_allclose(found[:3, 3], shown.T_cam_board["davis"][:3, 3], atol=0.02)
        assert capture.meta["motion_m"] < 0.005
        image, scan = capture.image("davis", "frames"), capture.scan("lidar")
        assert abs(image.stamp_ns - scan.stamp_ns - 50_000_000) < 1_000_000
        np.testing.assert_allclose(scan.points, shown.scans[0].points, atol=1e-6)


@pytest.mark.long
def test_collect_rejected_is_not_taken_again(collected, bag, rig, tmp_path):
    shutil.copytree(collected[0], tmp_path / "s")
    with Session.resume(tmp_path / "s", rig) as session:
        session.reject("000001")
        report = collect(session, [open_recording(bag, rig)])
    assert (report.captured, report.n_known, len(session.captures)) == ([], 2, 1)


@pytest.mark.long
def test_collect_target_reached_or_missing(tmp_path, bag, rig):
    with Session.create(tmp_path / "one", rig) as session:
        report = collect(session, [open_recording(bag, rig)], n_wanted=1)
    assert (len(report.captured), report.n_missing) == (1, 0)
    with Session.resume(tmp_path / "one", rig) as session:
        report = collect(session, [open_recording(bag, rig)], n_wanted=5)
    assert (len(session.captures), report.n_missing) == (2, 3)


def test_collect_torn_bag_keeps_captures(tmp_path, write_bag, rig):
    bag = write_bag(tmp_path / "torn.bag", VISIT)
    damaged = bytearray(bag.read_bytes())
    place = damaged.index(b"op=\2", int(0.45 * len(damaged)))
    damaged[place : place + 2] = b"??"
    bag.write_bytes(bytes(damaged))
    with Session.create(tmp_path / "s", rig) as session:
        report = collect(session, [open_recording(bag, rig)])
    assert report.captured == ["000000"]
    (error,) = report.errors
    assert "torn.bag" in error.what and "could be" not in error.hint


@pytest.mark.long
def test_moving_board_is_never_captured(tmp_path, write_bag, rig):
    bag = write_bag(tmp_path / "a.bag", [0, 1, 2, 3] * 3)
    with Session.create(tmp_path / "s", rig) as session:
        assert collect(session, [open_recording(bag, rig)]).captured == []
    # Hands are never quite still: the profile sets the limit.
    loose = changed(rig, quality__max_motion_m=5.0)
    with Session.create(tmp_path / "loose", loose) as session:
        assert collect(session, [open_recording(bag, loose)]).captured


def test_collect_offset_clocks_need_profile(tmp_path, write_bag, rig):
    bag = write_bag(tmp_path / "a.bag", [0] * 9, lag_ns=3 * 10**9)
    with Session.create(tmp_path / "apart", rig) as session, pytest.raises(SourceError) as caught:
        collect(session, [open_recording(bag, rig)])
    assert "channels.frames.timestamps.expected_offset_s" in caught.value.hint
    channels = {"frames": rig.cameras["davis"].channels["frames"]}
    alone = changed(rig, cameras__davis__channels=channels)
    bridged = changed(alone, cameras__davis__channels__frames__timestamps__expected_offset_s=-3.0)
    with Session.create(tmp_path / "bridged", bridged) as session:
        assert len(collect(session, [open_recording(bag, bridged)]).captured) == 1


def test_collect_longest_recording_is_measured(collected):
    assert collected[1].longest_s == pytest.approx(0.1 * (len(VISIT) - 1), abs=0.2)


def test_collect_too_short_recording_names_its_length(tmp_path, write_bag, rig, capsys):
    write_bag(tmp_path / "short.bag", [0] * 3)
    (tmp_path / "rig.yaml").write_text(dump_rig(rig))
    words = ["collect", "--rig", str(tmp_path / "rig.yaml"), str(tmp_path / "s")]
    assert run([*words, "--from", str(tmp_path / "short.bag")]) == NotEnoughDataError.exit_code
    err = capsys.readouterr().err
    assert "which lasts 0.2 s (minimum 0.5 s)" in err and "standing still" in err
