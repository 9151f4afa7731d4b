"""The folders of results, and the table that follows them."""

import pytest

from lce_rig.core.errors import SessionError
from lce_rig.fleet.registry import ROWS, SUPERSEDED, TABLE, Registry, write_rows
from lce_rig.fleet.storage import Storage


def write(registry, row, *files):
    """Write a result of a session that failed, with further files."""
    row = row | {"status": "failed"}
    with registry.result(row["folder"]) as draft:
        for name in files:
            (draft / name).write_text(row["folder"])
        write_rows(draft, [row])
    return [row]


def folders(table):
    return table["folder"].to_pylist()


def test_registry_table_is_in_order(registry, row):
    late = row("r1", "2026-02-01", folder="r1/b", source="1")
    early = row("r1", "2026-01-01", folder="r1/a", source="2")
    other = row("r0", "2026-03-01", folder="r0/c", source="3")
    fresh = [document for each in (late, early, other) for document in write(registry, each)]
    assert folders(registry.consolidate(fresh)) == ["r0/c", "r1/a", "r1/b"]
    assert folders(registry.read_table()) == ["r0/c", "r1/a", "r1/b"]


def test_registry_lost_table_is_rewritten(registry, row):
    rows = [row("r1", folder=f"r1/{k}", source=str(k)) for k in range(3)]
    registry.consolidate(write(registry, rows[0]))
    for each in rows[1:]:
        write(registry, each)  # as if the process had been killed before writing the table
    whole = registry.consolidate()
    assert folders(whole) == ["r1/0", "r1/1", "r1/2"]
    (registry.place.local / TABLE).write_bytes(b"torn")
    assert registry.consolidate().equals(whole)
    assert registry.consolidate(rebuild=True).equals(whole)


def test_registry_later_result_replaces(registry, row):
    """The earlier one is kept."""
    write(registry, row(folder="r1/old", source="s", finished="2026-01-01T00:00:00Z"), "result.json")
    write(registry, row(folder="r1/new", source="s", finished="2026-01-02T00:00:00Z"))
    assert folders(registry.consolidate()) == ["r1/new"]
    assert (registry.place / "r1").names() == ["new"]
    aside = registry.place / SUPERSEDED / "r1"
    assert (aside / "old" / "result.json").read() == b"r1/old"
    # The captures are put back, and changed again.
    write(registry, row(folder="r1/old", source="s", finished="2026-01-03T00:00:00Z"), "result.json")
    assert folders(registry.consolidate()) == ["r1/old"]
    write(registry, row(folder="r1/new", source="s", finished="2026-01-04T00:00:00Z"))
    assert folders(registry.consolidate(rebuild=True)) == ["r1/new"]
    assert aside.names() == ["new", "old", "old-2"]
    assert registry.folders() == ["r1/new"]


def test_registry_keeps_files_missing_in_new_result(registry, row):
    write(registry, row(folder="r1/a"), "same.txt", "result.json")
    (registry.place.local / "r1/a/notes.txt").write_text("mine")
    write(registry, row(folder="r1/a"))
    aside = registry.place / SUPERSEDED / "r1"
    assert (aside / "a").names() == [ROWS, "notes.txt", "result.json", "same.txt"]
    write(registry, row(folder="r1/a"), "same.txt", "result.json")
    write(registry, row(folder="r1/a"), "same.txt", "result.json")
    assert aside.names() == ["a"], "nothing was lost: a failure, and the same files"


def test_registry_failed_write_keeps_folder(registry, row):
    write(registry, row(folder="r1/a", n_used=1), "old.txt")
    with pytest.raises(RuntimeError), registry.result("r1/a") as draft:
        (draft / "half.txt").write_text("")
        raise RuntimeError
    assert (registry.place / "r1/a").names() == [ROWS, "old.txt"]
    write(registry, row(folder="r1/a", n_used=2), "new.txt")
    assert (registry.place / "r1/a").names() == [ROWS, "new.txt"]
    assert registry.rows("r1/a")[0]["n_used"] == 2


@pytest.mark.parametrize(
    "content",
    [
        "{",
        "[]",
        '{"format_version": 9, "rows": []}',
        '{"format_version": 1, "rows": [{}]}',
        '{"format_version": 1, "rows": [{"status": "failed", "n_used": "many"}]}',
        '{"format_version": 1, "rows": [{"status": "failed", "date": {"a": 1}}]}',
        '{"format_version": 1, "rows": [{"status": "ok"}]}',
        '{"format_version": 1, "rows": 1}',
    ],
)
def test_registry_damaged_file_affects_only_its_session(registry, row, content):
    """A row has status ok, but its result.json is damaged."""
    folder = "r1/20260105T100000Z-0123456789ab"
    write(registry, row(folder=folder), "result.json")
    write(registry, row("r2", folder="r2/b"))
    (registry.place.local / folder / ROWS).write_text(content)
    table = registry.consolidate(rebuild=True)
    assert folders(table) == [folder, "r2/b"]
    (damaged,) = registry.rows(folder)
    assert (damaged["status"], damaged["cause"]) == ("failed", "fleet.damaged")
    assert damaged["date"] == "2026-01-05T10:00:00Z"


def test_a_row_stays_within_its_folder(registry, row):
    write(registry, row(folder="r1/a"))
    text = (registry.place.local / "r1/a" / ROWS).read_text()
    (registry.place.local / "r1/a" / ROWS).write_text(text.replace('"r1', '"../../etc'))
    assert [(each["robot"], each["folder"]) for each in registry.rows("r1/a")] == [("r1", "r1/a")]


def test_a_registry_that_cannot_be_written_is_an_error(tmp_path, row):
    (tmp_path / "file").write_text("")
    with pytest.raises(SessionError):
        write(Registry(Storage.at(tmp_path / "file")), row())
    with pytest.raises(SessionError, match="file"):
        Registry(Storage.at(tmp_path / "file")).consolidate()
