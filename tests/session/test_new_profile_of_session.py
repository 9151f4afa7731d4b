"""A session takes another profile of its rig, keeps the earlier one, and refuses another rig's."""

from pathlib import Path

import pytest

from lce_rig.cli.main import run
from lce_rig.core.errors import SessionError
from lce_rig.rig import dump_rig, load_rig, read_profile
from lce_rig.session import Session
from lce_rig.session.session import discard_if_empty
from tests.shared import changed, contents


def with_square(rig, square_m):
    return changed(rig, board__square_m=square_m)


def test_new_profile_is_used_and_earlier_ones_are_kept(rig, tmp_path):
    path = tmp_path / "s"
    named = rig.of_robot("kestrel")
    Session.create(path, named).close()
    with Session.open(path, writable=True) as session:
        assert session.adopt(rig) == ""
        assert session.adopt(with_square(rig, 0.071)) == "rig-1.yaml"
        assert session.adopt(with_square(rig, 0.072)) == "rig-2.yaml"
        assert session.rig.board.square_m == 0.072
    assert Session.open(path).rig == with_square(named, 0.072)
    assert load_rig(path / "rig-1.yaml") == named
    assert load_rig(path / "rig-2.yaml") == with_square(named, 0.071)
    noted = [entry["earlier"] for entry in session.read_journal() if entry["event"] == "profile"]
    assert noted == ["rig-1.yaml", "rig-2.yaml"]


@pytest.mark.parametrize("changes", [{"name": "other"}, {"lidars__lidar__serial": "B"}, {"cameras": "front"}])
def test_new_profile_other_rig_is_refused(rig, tmp_path, changes):
    if changes == {"cameras": "front"}:
        changes = {"cameras": {"front": rig.cameras["cam"]}, "nominal_extrinsics": ()}
    Session.create(tmp_path / "s", changed(rig, lidars__lidar__serial="A")).close()
    before = contents(tmp_path / "s")
    other = tmp_path / "other.yaml"
    other.write_text(dump_rig(changed(rig, **changes)))
    assert run(["calibrate", str(tmp_path / "s"), "--rig", str(other)]) == SessionError.exit_code
    assert contents(tmp_path / "s") == before


def test_kept_text_ends_with_another_profile(tmp_path):
    path, rig = tmp_path / "s", load_rig("rlfs")
    text = "# mine\n" + read_profile(Path(__file__).parents[2] / "rigs" / "rlfs.yaml")
    with Session.create(path, rig.of_robot("kestrel")) as session:
        session.keep_text(text)
        assert session.profile_text() == text
        session.adopt(with_square(rig, 0.071))
        assert load_rig(path / "profile-1.yaml") == rig
        assert session.profile_text() == dump_rig(session.rig)
        session.keep_text(text)
        assert session.profile_text() == dump_rig(session.rig)


def test_discard_empty_removes_kept_text(rig, tmp_path):
    with Session.create(tmp_path / "s", rig) as session:
        session.keep_text(dump_rig(rig))
    assert discard_if_empty(tmp_path / "s")
    assert not (tmp_path / "s").exists()
