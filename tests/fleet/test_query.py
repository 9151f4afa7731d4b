"""Rows chosen by a condition."""

import pytest

from lce_rig.core.errors import UsageError
from lce_rig.fleet.registry import SCHEMA, Registry, as_table
from lce_rig.fleet.storage import Storage


@pytest.fixture
def registry(tmp_path, row):
    registry = Registry(Storage.at(tmp_path))
    rows = [
        row("r1", "2025-12-01", folder="r1/a", verdict="fail"),
        row("r1", "2026-02-01", folder="r1/b", verdict="fail", findings=("verdict.a", "verdict.b")),
        row("r2", "2026-02-01", folder="r2/c", verdict="pass"),
        row("r3", None, folder="r3/d", verdict=None, status="timed_out"),
    ]
    registry.write_table(as_table(rows))
    return registry


@pytest.mark.parametrize(
    ("where", "found"),
    [
        ("", ["r1/a", "r1/b", "r2/c", "r3/d"]),
        ("verdict = 'fail' and date > '2026-01-01'", ["r1/b"]),
        ("status <> 'ok' or robot like '%2'", ["r2/c", "r3/d"]),
        ("list_contains(findings, 'verdict.b')", ["r1/b"]),
        ("n_used > 100", []),
    ],
)
def test_a_condition_chooses_rows(registry, where, found):
    chosen = registry.read_table(where=where)
    assert chosen["folder"].to_pylist() == found
    assert chosen.column_names == SCHEMA.names
    assert registry.read_table(["folder", "robot"], where).column_names == ["folder", "robot"]


@pytest.mark.parametrize(
    "where",
    [
        "wheels = 4",
        "verdict = ",
        "true); copy (select 1) to 'x.csv'; --",
        "robot in (select content from read_text('/etc/hostname'))",
    ],
)
def test_a_wrong_condition_names_the_columns(registry, where, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(UsageError) as caught:
        registry.read_table(where=where)
    assert "sigma_rotation_deg" in caught.value.hint
    assert not (tmp_path / "x.csv").exists()
