"""Results take an earlier one's place whole, and the last usable one is kept."""

from dataclasses import replace

import pytest

from lce_rig.core.calibration import read_result
from lce_rig.core.errors import NotEnoughDataError, ResultRefusedError, SessionError, UsageError
from lce_rig.pipeline.result_files import Result, result_content, stored_results, with_profile_of
from lce_rig.pipeline.verification import profile_behind
from lce_rig.rig import load_rig
from lce_rig.session import Session
from tests.export.conftest import calibration, reason, some_pose
from tests.shared import changed, files_up_to

GOOD = calibration(captures_used=())
OTHER = calibration(some_pose((1.2, -1.3, 1.0)), captures_used=())
FAILED = calibration(verdict="fail", findings=(reason("too few"),), captures_used=())


def write(session, *calibrations, report=False, force=False):
    """Most of these tests need no page, which takes longer than all other files."""
    return Result(session, calibrations).write(report=report, force=force)


@pytest.fixture
def session(tmp_path):
    with Session.create(tmp_path / "s", load_rig("rles")) as made:
        yield made


@pytest.fixture
def folder(session):
    return session.path / "calibration"


def names(folder):
    return {path.name for path in folder.iterdir()}


def pose_in(folder):
    return read_result(folder / "result.json").pairs[0].T_cam_lidar


def test_write_keeps_previous_with_exports(session, folder):
    first = write(session, GOOD)
    assert first.previous is None
    (folder / "overlays").mkdir()
    (folder / "overlays" / "000000.png").write_bytes(b"drawn")
    exported = (folder / "extrinsics.yaml").read_bytes()
    second = write(session, OTHER)
    assert second.has_usable_previous and second.previous == folder / "previous"
    assert (pose_in(folder) == OTHER.T_cam_lidar).all()
    assert (pose_in(folder / "previous") == GOOD.T_cam_lidar).all()
    assert (folder / "previous" / "extrinsics.yaml").read_bytes() == exported
    assert (folder / "extrinsics.yaml").read_bytes() != exported
    assert (folder / "previous" / "overlays" / "000000.png").read_bytes() == b"drawn"
    assert "overlays" not in names(folder)
    assert "previous" not in names(folder / "previous")


def test_write_failures_keep_last_usable(session, folder):
    write(session, GOOD)
    for k in range(3):
        failed = calibration(verdict="fail", findings=(reason(f"{k}"),), captures_used=())
        written = write(session, failed, force=k == 1)
        assert written.has_usable_previous
        assert k == 1 or names(folder) == {"result.json", "previous"}
    assert (pose_in(folder / "previous") == GOOD.T_cam_lidar).all()
    assert (folder / "previous" / "extrinsics.yaml").exists()
    write(session, OTHER)
    assert (pose_in(folder / "previous") == GOOD.T_cam_lidar).all()


def test_write_one_camera_keeps_the_other(tmp_path):
    rig = load_rig("rles")
    cameras = {
        name: changed(rig.cameras["davis"], frame=name, optical_frame=f"{name}_optical")
        for name in ("left", "right")
    }
    session = Session(tmp_path / "s", changed(rig, cameras=cameras), None)
    folder = session.path / "calibration"
    session.path.mkdir()
    (session.path / "rig.yaml").touch()
    left, right = replace(GOOD, camera="left"), replace(GOOD, camera="right")
    write(session, left, right)
    for k in range(3):
        write(session, replace(OTHER, camera="left", findings=(reason(f"{k}"),)))
        kept = read_result(folder / "previous" / "result.json").pairs
        assert [c.camera for c in kept] == ["left", "right"]
    write(session, left, right)
    assert [c.camera for c in read_result(folder / "previous" / "result.json").pairs] == ["left"]


def test_write_keeps_last_failed_if_no_other(session, folder):
    write(session, FAILED)
    written = write(session, calibration(verdict="fail", captures_used=()), force=True)
    assert written.previous is not None and not written.has_usable_previous
    assert read_result(folder / "previous" / "result.json").pairs[0].findings == (reason("too few"),)


def test_write_same_result_keeps_previous(session, folder):
    write(session, GOOD)
    write(session, OTHER)
    (folder / "overlays").mkdir()
    (folder / "overlays" / "000000.png").write_bytes(b"drawn")
    write(session, OTHER)
    assert (folder / "overlays" / "000000.png").read_bytes() == b"drawn"
    assert (pose_in(folder / "previous") == GOOD.T_cam_lidar).all()


def test_write_keeps_user_files(session, folder):
    (folder / "previous").mkdir(parents=True)
    (folder / "photos").mkdir()
    notes = [folder / "photos" / "rig.txt", folder / "previous" / "notes.txt"]
    for note in notes:
        note.write_text("on Tuesday")
    assert write(session, GOOD).previous is None
    for result in (OTHER, GOOD, GOOD, FAILED):
        assert write(session, result).previous == folder / "previous"
        assert [note.read_text() for note in notes] == ["on Tuesday"] * 2
    assert "photos" not in names(folder / "previous")


@pytest.mark.parametrize("name", ["calibration", "calibration/previous"])
def test_file_in_place_of_folder_is_refused_and_kept(session, folder, name):
    if name != "calibration":
        write(session, GOOD)
    (session.path / name).write_text("mine")
    with pytest.raises(SessionError):
        write(session, OTHER)
    assert (session.path / name).read_text() == "mine"
    assert not list(session.path.glob(".new-*"))


def test_write_failed_keeps_earlier_result(session, folder):
    write(session, GOOD)
    before = {path: path.read_bytes() for path in folder.iterdir()}
    with pytest.raises(ResultRefusedError):
        write(session, calibration(OTHER.T_cam_lidar * float("nan"), captures_used=()))
    with pytest.raises(SessionError):
        write(session, calibration())
    with files_up_to(1000), pytest.raises(SessionError):
        write(session, OTHER)
    assert {path: path.read_bytes() for path in folder.iterdir()} == before
    assert not list(session.path.glob(".new-*"))


def test_write_folder_as_result_is_kept(session, folder):
    (folder / "result.json").mkdir(parents=True)
    (folder / "result.json" / "note").write_text("mine")
    assert result_content(folder) is None
    write(session, GOOD)
    assert (pose_in(folder) == GOOD.T_cam_lidar).all()
    assert (folder / "previous" / "result.json" / "note").read_text() == "mine"


def test_extrinsics_are_selected_by_camera_name(session):
    result = Result(session, (GOOD,))
    assert result.of(GOOD.camera) is result.of(GOOD.camera, GOOD.lidar) is GOOD
    with pytest.raises(NotEnoughDataError):
        result.of("another")


def test_the_report_stays_with_its_result(session, folder):
    first = write(session, GOOD, report=True)
    assert first.report == folder / "report.html"
    page = first.report.read_bytes()
    write(session, OTHER, report=True)
    assert (folder / "previous" / "report.html").read_bytes() == page != first.report.read_bytes()
    page = first.report.read_bytes()
    again = write(session, OTHER)
    assert again.report is None and first.report.read_bytes() == page
    without = write(session, GOOD)
    assert without.report is None and not first.report.exists()


def test_an_interrupted_report_leaves_a_complete_result(session, folder):
    """The result exists before its report is drawn; a report never stands beside another result."""
    write(session, GOOD, report=True)
    result = Result(session, (OTHER,))
    files = {path.name for path in result.write(report=False).files}
    assert names(folder) == files | {"previous"}
    write(session, GOOD)
    with pytest.raises(SessionError):
        result.write_report()
    assert "report.html" not in names(folder)
    assert result.write().report.exists()


def test_write_other_profile_stays_beside_its_result(session, folder):
    write(session, GOOD)
    own = session.profile_content()
    rig = changed(session.rig, board__square_m=0.071)
    Result(session.with_profile(rig), (OTHER,)).write(name="wide", report=False)
    place = session.path / "results" / "wide"
    assert (session.path / "rig.yaml").read_bytes() == own and names(session.path).isdisjoint({"rig-1.yaml"})
    assert load_rig(place / "rig.yaml") == rig
    assert with_profile_of(session, "wide").rig == rig and with_profile_of(session, None) is session
    assert profile_behind(place / "result.json", read_result(place / "result.json")) == rig
    assert not any(result.is_outdated for result in stored_results(session))
    # The next result of this name has the session's profile; the other one goes with the earlier result.
    Result(session, (GOOD,)).write(name="wide", report=False)
    assert not (place / "rig.yaml").exists()
    earlier = place / "previous" / "result.json"
    assert profile_behind(earlier, read_result(earlier)) == rig
    assert not any(result.is_outdated for result in stored_results(session))


def test_write_other_profile_without_a_name_is_refused(session):
    other = session.with_profile(changed(session.rig, board__square_m=0.071))
    with pytest.raises(UsageError, match="needs a name"):
        write(other, GOOD)
    assert not (session.path / "calibration").exists()
