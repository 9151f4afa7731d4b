"""Intrinsics of a session with a possibly wrong profile: estimated, compared and written."""

import shutil
from dataclasses import replace

import numpy as np
import pytest

from lce_rig.core.data import Image
from lce_rig.core.errors import NotEnoughDataError, ResultRefusedError, SessionError, UsageError
from lce_rig.io.camera_description import read_cameras
from lce_rig.judge.intrinsics_check import judge_lens
from lce_rig.pipeline.camera_intrinsics import (
    document,
    measure_intrinsics,
    save_profile,
    write_intrinsics,
)
from lce_rig.rig import find_profile, load_rig, parse_rig, set_value
from lce_rig.session import Session
from tests.detect.test_image_board import draw, looking

RLES = find_profile("rles").read_text(encoding="utf-8")
RIG = load_rig("rles")
LENS = RIG.cameras["davis"].to_intrinsics()


@pytest.fixture(scope="module")
def pictures():
    """Eight boards over the whole image, projected with the profile's lens."""
    board, rng = RIG.board.to_board(), np.random.default_rng(1)
    drawn = []
    while len(drawn) < 8:
        ray = LENS.unproject(rng.uniform(0.15, 0.85, 2) * [LENS.width_px, LENS.height_px])
        tilt, about, roll = rng.uniform(15, 45), rng.uniform(0, 360), rng.uniform(20, 70)
        T = looking(tilt, about, roll, tuple(ray * rng.uniform(1.3, 2.2)))
        corners, _ = LENS.project(board.corners() @ T[:3, :3].T + T[:3, 3])
        if LENS.is_inside(corners, 8.0).all():
            drawn.append(draw(board, LENS, T, seed=len(drawn)))
    return drawn


def session_of(path, pictures, channel="frames", **camera):
    """Create a session of images with changed keys of the camera."""
    text = RLES
    for key, value in camera.items():
        text = set_value(text, f"cameras.davis.{key.replace('__', '.')}", value)
    with Session.create(path, parse_rig(text)) as session:
        for pixels in pictures:
            session.add_capture([Image("davis", channel, None, pixels)], [], {})
    return session


@pytest.fixture(scope="module")
def session(pictures, tmp_path_factory):
    return session_of(tmp_path_factory.mktemp("right") / "session", pictures)


@pytest.fixture(scope="module")
def measured(session):
    return measure_intrinsics([session], "davis")


def sigmas_off(measured):
    estimate = measured.estimate
    return (estimate.model.vector(estimate.intrinsics) - estimate.model.vector(LENS)) / estimate.sigma


def test_right_intrinsics_are_confirmed(measured):
    assert measured.channels == ("frames",)
    assert measured.refused == {}
    assert np.abs(sigmas_off(measured)).max() < 4.5
    assert measured.estimate.rms_px < 0.05
    assert measured.check.fits()


def test_wrong_intrinsics_lead_to_the_same_lens_and_fail(pictures, tmp_path):
    wrong = {"intrinsics__fx_px": "230.0", "intrinsics__fy_px": "230.0", "intrinsics__distortion": "[]"}
    measured = measure_intrinsics([session_of(tmp_path / "s", pictures, **wrong)], "davis", model="radtan5")
    assert np.abs(sigmas_off(measured)).max() < 4.5
    assert len(measured.estimate.views) == 8
    assert measured.estimate.rms_px < 0.05
    assert not measured.check.fits()


def test_profile_of_other_resolution_is_accepted(pictures, tmp_path):
    text = set_value(RLES, "cameras.davis.resolution_px", "[692, 520]")
    double = {"fx_px": "699.1", "fy_px": "698.4", "cx_px": "345.5", "cy_px": "253.0"}
    for key, value in double.items():
        text = set_value(text, f"cameras.davis.intrinsics.{key}", value)
    with Session.create(tmp_path / "session", parse_rig(text)) as session:
        for pixels in pictures[:6]:
            session.add_capture([Image("davis", "frames", None, pixels)], [], {})
    measured = measure_intrinsics([session], "davis")
    assert np.abs(sigmas_off(measured)).max() < 4.5
    assert measured.check is None
    assert measured.judgement.code == "intrinsics.better"
    assert save_profile(session, [measured], tmp_path / "new.yaml") == ("davis",)
    camera = load_rig(tmp_path / "new.yaml").cameras["davis"]
    assert camera.resolution_px == (346, 260)
    assert camera.to_intrinsics() == measured.intrinsics


def test_channels_share_lens_and_bad_images_are_named(pictures, tmp_path):
    session = session_of(tmp_path / "session", pictures[:4])
    with Session.open(session.path, writable=True) as writer:
        for pixels in [*pictures[4:], np.full((260, 346), 90, dtype=np.uint8)]:
            writer.add_capture([Image("davis", "events", None, pixels)], [], {})
    (session.path / "captures" / "000003" / "davis.frames.png").write_bytes(b"torn")
    both = measure_intrinsics([session], "davis", channels=["frames", "events"])
    assert [view.channel for view in both.estimate.views] == ["frames"] * 3 + ["events"] * 4
    assert set(both.refused) == {"000003.frames", "000008.events"}
    assert both.refused["000003.frames"].stage == "read"
    assert both.refused["000008.events"].stage == "image"
    assert np.abs(sigmas_off(both)).max() < 4.5
    with pytest.raises(NotEnoughDataError, match="3 of 4") as caught:
        measure_intrinsics([session], "davis", channels=["frames"])
    assert "1 x " in caught.value.hint and "000003" in caught.value.hint


def test_sessions_of_one_camera_share_a_lens(pictures, tmp_path):
    halves = [session_of(tmp_path / name, own) for name, own in (("a", pictures[:4]), ("b", pictures[4:]))]
    both = measure_intrinsics(halves, "davis")
    assert len({view.capture for view in both.estimate.views}) == len(pictures)
    assert np.abs(sigmas_off(both)).max() < 4.5
    with pytest.raises(NotEnoughDataError, match="4 of 4"):
        measure_intrinsics(halves[:1], "davis")


@pytest.mark.parametrize(
    "changes, message",
    [
        ({"board.square_m": "0.05"}, "has another board than"),
        ({"cameras.davis.intrinsics.fx_px": "300.0"}, "differ: cameras.davis.intrinsics.fx_px"),
        ({"name": "other"}, "to rig 'other'"),
    ],
)
def test_sessions_of_different_profiles_are_refused(session, pictures, tmp_path, changes, message):
    text = RLES
    for key, value in changes.items():
        text = set_value(text, key, value)
    with Session.create(tmp_path / "other", parse_rig(text)) as other:
        other.add_capture([Image("davis", "frames", None, pictures[0])], [], {})
    with pytest.raises(SessionError, match=message):
        measure_intrinsics([session, other], "davis")


def test_a_copy_of_a_session_adds_nothing_to_its_lens(session, tmp_path):
    shutil.copytree(session.path, tmp_path / "copy")
    with pytest.raises(SessionError, match="share 8 samples"):
        measure_intrinsics([session, Session.open(tmp_path / "copy")], "davis")


def test_every_file_holds_the_same_lens(session, measured, tmp_path):
    files = write_intrinsics(session, [measured])
    assert {path.name for path in (session.path / "intrinsics").iterdir()} == {path.name for path in files}
    lens = measured.intrinsics
    info = read_cameras(session.path / "intrinsics" / "camera_info_davis.yaml").intrinsics()[0]
    assert (info.matrix == lens.matrix).all()
    (one,) = document(session.rig, [measured])["cameras"]
    assert one["intrinsics"]["cy_px"] == lens.cy_px
    assert one["profile"]["verdict"] == "pass"
    assert one["views_used"] == [f"{k:06d}.frames" for k in range(8)]


def test_intrinsics_keep_files_of_others(pictures, measured, tmp_path):
    session = session_of(tmp_path / "session", pictures[:1])
    folder = session.path / "intrinsics"
    folder.mkdir()
    for name in ("camera_info_davis.yaml", "camera_info_other.yaml", "notes.txt"):
        (folder / name).write_text("earlier")
    other = replace(measured, camera="longer_than_the_name_of_a_file" * 10)
    with pytest.raises(SessionError):
        write_intrinsics(session, [measured, other])
    assert (folder / "camera_info_davis.yaml").read_text() == "earlier"
    assert write_intrinsics(session, [measured]) == [folder / "camera_info_davis.yaml"]
    kept = {"camera_info_davis.yaml", "camera_info_other.yaml", "notes.txt"}
    assert {path.name for path in folder.iterdir()} == kept


def test_new_profile_keeps_comments(session, measured, tmp_path):
    """An existing file is not replaced."""
    save_profile(session, [measured], tmp_path / "new.yaml", is_forced=True)
    rig = load_rig(tmp_path / "new.yaml")
    assert rig.cameras["davis"].to_intrinsics() == measured.intrinsics
    assert rig.board == RIG.board
    assert "# measure it;" in (tmp_path / "new.yaml").read_text()
    with pytest.raises(UsageError, match=r"new\.yaml"):
        save_profile(session, [measured], tmp_path / "new.yaml", is_forced=True)


def test_undetermined_intrinsics_are_refused(session, measured, tmp_path):
    assert measured.judgement.code == "intrinsics.fit"
    unknown = replace(measured, judgement=judge_lens(0.08, 65.0, None))
    assert unknown.judgement.code == "intrinsics.undetermined"
    for kept in (measured, unknown):
        with pytest.raises(ResultRefusedError):
            save_profile(session, [kept], tmp_path / "new.yaml")
        assert not (tmp_path / "new.yaml").exists()
