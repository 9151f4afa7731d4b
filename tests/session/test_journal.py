from lce_rig.session import Session


def test_lines_that_are_no_entries_are_skipped(tmp_path, rig):
    with Session.create(tmp_path / "s", rig) as session:
        (session.path / "journal.jsonl").write_bytes(
            b'{"event": "a"}\n[1]\n{"event"\n\xff\n{"event": "b"}\n{"event": "c'
        )
        session.journal("d")
        assert [entry["event"] for entry in session.read_journal()] == ["a", "b", "d"]
        (session.path / "journal.jsonl").unlink()
        assert session.read_journal() == []
