"""The report of a fleet: page, CSV and JSON."""

import csv
import json

import numpy as np
import pytest

from lce_rig.cli.main import run
from lce_rig.core.errors import SessionError
from lce_rig.core.geometry import perturb
from lce_rig.fleet.report import document, findings, page, write_csv
from lce_rig.fleet.table import Row, as_table, write_table
from lce_rig.fleet.tables import tables_of

SIGMA = np.array([2e-3, 2e-3, 3e-3, *np.radians([0.06, 0.06, 0.04])])


@pytest.fixture
def table(row):
    """Ten robots with eight sessions each, of which <r1> turned; and a session that crashed."""
    rng = np.random.default_rng(0)
    rows = [Row("r5", status="crashed", cause="fleet.signal", date="2026-01-09T00:00:00Z")]
    for robot in ("<r1>", *(f"r{k}" for k in range(9))):
        mounted = 3 * SIGMA * rng.normal(size=6)
        for k in range(8):
            moved = np.radians(0.8) * np.eye(6)[4] if robot == "<r1>" and k > 4 else np.zeros(6)
            T = perturb(np.eye(4), mounted + moved + SIGMA * rng.normal(size=6))
            known = {
                "session_sha256": f"{robot}{k}",
                "T_cam_lidar": tuple(T.ravel().tolist()),
                "cov": tuple(np.diag(SIGMA**2)[np.triu_indices(6)].tolist()),
                "cov_shared": tuple(np.zeros(21).tolist()),
                "nominal": tuple(np.eye(4).ravel().tolist()),
                "collector": "Ann & Bo",
            }
            rows.append(row(robot, f"2026-01-{k + 1:02d}T10:00:00Z", **known))
    return as_table(rows)


def test_the_page_names_who_moved_and_escapes_what_it_is_told(table):
    made = tables_of(table.select)
    text = page(made, table.select, "north")
    assert "<b>&lt;r1&gt;</b>" in text and "<r1>" not in text
    assert "Ann &amp; Bo" in text and "fleet.signal" in text
    assert text.count("<svg") == 2
    assert "http" not in text.replace("http-equiv", "")
    assert text == page(tables_of(table.select), table.select, "north")


def test_findings_and_tables_are_for_programs(table, tmp_path):
    made = tables_of(table.select)
    moved = findings(made)[0]
    assert (moved.code, moved.subject, moved.figures["axes"]) == ("fleet.moved", "<r1>", ("rotation_y",))
    told = json.loads(json.dumps(document(made), allow_nan=False))
    assert told["robots"]["<r1>"] == "moved" and told["n_sessions"] == 80
    assert told["tables"]["changes"][0]["after"] == "2026-01-06T10:00:00Z"
    assert "sessions" not in told["tables"]
    written = {path.stem: path for path in write_csv(made, tmp_path / "csv")}
    (tmp_path / "file").write_text("")
    with pytest.raises(SessionError, match="file"):
        write_csv(made, tmp_path / "file")
    assert set(written) == {*made.tables, "sessions"}
    rows = list(csv.DictReader(written["sessions"].read_text().splitlines()))
    assert len(rows) == 80 and rows[0]["chi2"] == "" and float(rows[1]["chi2"]) > 0


def test_a_page_of_nothing_says_so(row):
    table = as_table([row("r1", T_cam_lidar=None)])
    text = page(tables_of(table.select), table.select, "empty")
    assert "Nothing." in text and "<svg" not in text


def test_the_command_writes_what_is_asked_for(table, tmp_path, capsys):
    registry = tmp_path / "registry"
    registry.mkdir()
    write_table(registry / "fleet.parquet", table)
    out = tmp_path / "out.html"
    more = ["--csv", str(tmp_path / "csv"), "--json", str(tmp_path / "out.json")]
    assert run(["fleet", "report", "--registry", str(registry), "-o", str(out), *more]) == 0
    assert out.read_text().startswith("<!DOCTYPE html>")
    assert json.loads((tmp_path / "out.json").read_text())["format_version"] == 1
    assert (tmp_path / "csv" / "robots.csv").exists()
    assert "<r1>: " in capsys.readouterr().out
    assert run(["fleet", "report", "--registry", str(tmp_path / "none"), "-o", str(out)]) == 4
