"""Rejected captures are not used, but kept, and restored unchanged."""

import pytest

from lce_rig.core.errors import SessionError
from lce_rig.session import Session
from tests.shared import changed


@pytest.fixture
def session(tmp_path, rig, samples):
    """Three captures, open for writing."""
    with Session.create(tmp_path / "s", rig) as made:
        for seed in range(3):
            made.add_capture(*samples(seed), {"source": {"key": f"k:{seed}"}})
        yield made


def names(captures):
    return [capture.name for capture in captures]


def test_rejected_capture_restores_unchanged(session):
    before = {file.name: file.read_bytes() for file in session.capture("000001").path.iterdir()}
    session.reject("000001", "glare")
    assert (names(session.captures), names(session.rejected)) == (["000000", "000002"], ["000001"])
    with pytest.raises(SessionError, match="000001"):
        session.capture("000001")
    session.restore("000001")
    assert (names(session.captures), names(session.rejected)) == (["000000", "000001", "000002"], [])
    after = {file.name: file.read_bytes() for file in session.capture("000001").path.iterdir()}
    assert after == before
    told = [(entry["event"], entry["capture"]) for entry in session.read_journal()[-2:]]
    assert told == [("rejected", "000001"), ("restored", "000001")]
    assert session.read_journal()[-2]["reason"] == "glare"


def test_rejected_name_and_data_stay_taken(session, samples):
    session.reject("000002")
    assert session.find_duplicate(*samples(2)) == "000002"
    assert session.add_capture(*samples(7), {}) == "000003"
    session.close()
    with Session.open(session.path, writable=True) as again:
        assert again.find_duplicate(*samples(2)) == "000002"
        again.restore("000002")
        assert names(again.captures) == ["000000", "000001", "000002", "000003"]


def test_add_session_copies_captures_once(session, tmp_path, rig, samples):
    with Session.create(tmp_path / "friday", rig) as friday:
        for seed in (2, 7, 8):
            friday.add_capture(*samples(seed), {"source": {"key": f"f:{seed}"}})
    session.reject("000001")
    assert session.add_session(friday) == ["000003", "000004"]
    assert session.add_session(friday) == []
    copied, source = session.capture("000003"), friday.capture("000001")
    assert (copied.contents, copied.meta) == (source.contents, source.meta)
    with Session.create(tmp_path / "other", changed(rig, board__width_m=0.9)) as other:
        other.add_capture(*samples(9), {})
    with pytest.raises(SessionError):
        session.add_session(other)
    assert len(session.captures) == 4


@pytest.mark.parametrize("verb", ["reject", "restore"])
def test_missing_capture_is_named(session, verb):
    with pytest.raises(SessionError, match="000009"):
        getattr(session, verb)("000009")


def test_reject_in_read_only_session_is_refused(session):
    with pytest.raises(SessionError):
        Session.open(session.path).reject("000000")
    assert len(session.captures) == 3


def test_capture_never_replaces_existing_folder(session):
    session.reject("000000")
    (session.path / "captures" / "000000").mkdir()
    (session.path / "captures" / "000000" / "mine.txt").write_text("a user's")
    with pytest.raises(SessionError, match="000000"):
        session.restore("000000")
    assert (session.path / "captures" / "000000" / "mine.txt").read_text() == "a user's"
    assert names(session.rejected) == ["000000"]


def test_capture_does_not_move_without_journal_entry(session):
    (session.path / "journal.jsonl").unlink()
    (session.path / "journal.jsonl").mkdir()
    with pytest.raises(SessionError):
        session.reject("000000")
    assert names(session.captures) == ["000000", "000001", "000002"] and not session.rejected
