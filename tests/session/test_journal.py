import os

import pytest

from lce_rig.session.session import read_entries


def test_lines_that_are_no_entries_are_skipped(tmp_path):
    path = tmp_path / "journal.jsonl"
    path.write_bytes(
        b'{"event": "a"}\n[1]\n{"event"\n' + b"[" * 100_000 + b'\n\xff\n{"n": NaN}\n{"event": "b"}\n'
    )
    assert [entry["event"] for entry in read_entries(path)] == ["a", "b"]
    assert read_entries(tmp_path / "none") == []


def test_a_pipe_is_no_journal(tmp_path):
    os.mkfifo(tmp_path / "journal.jsonl")
    with pytest.raises(ValueError, match="pipe"):
        read_entries(tmp_path / "journal.jsonl")
