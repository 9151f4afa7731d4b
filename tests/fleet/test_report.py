"""The report of a fleet: page and JSON."""

import json

import numpy as np
import pytest

from lce_rig.cli.main import run
from lce_rig.core.geometry import perturb
from lce_rig.fleet.registry import Registry, as_table
from lce_rig.fleet.report import FleetReport
from lce_rig.fleet.storage import Storage

SIGMA = np.array([2e-3, 2e-3, 3e-3, *np.radians([0.06, 0.06, 0.04])])


@pytest.fixture
def registry(row, tmp_path):
    """Ten robots with eight sessions each, of which <r1> turned; and a session that crashed."""
    rng = np.random.default_rng(0)
    rows = [row("r5", status="crashed", cause="fleet.signal", T_cam_lidar=None, verdict=None)]
    for robot in ("<r1>", *(f"r{k}" for k in range(9))):
        for k in range(8):
            moved = np.radians(0.8) * np.eye(6)[4] if robot == "<r1>" and k > 4 else np.zeros(6)
            known = {
                "folder": f"{robot}/{k}",
                "session_sha256": f"{robot}{k}",
                "T_cam_lidar": tuple(perturb(np.eye(4), moved + SIGMA * rng.normal(size=6)).ravel().tolist()),
                "cov": tuple(np.diag(SIGMA**2)[np.triu_indices(6)].tolist()),
                "cov_shared": (0.0,) * 21,
            }
            rows.append(row(robot, f"2026-01-{k + 1:02d}T10:00:00Z", **known))
    place = Registry(Storage.at(tmp_path))
    place.write_table(as_table(rows))
    return place


def test_report_moved_robot_is_escaped(registry):
    text = FleetReport.of(registry).page()
    assert "<b>&lt;r1&gt;</b>" in text and "<r1>" not in text
    assert "fleet.signal" in text
    assert "http" not in text.replace("http-equiv", "")
    assert text == FleetReport.of(registry).page()


def test_the_command_writes_page_and_findings(registry, tmp_path, capsys):
    out, folder = tmp_path / "out.html", str(tmp_path)
    more = ["--json", str(tmp_path / "out.json")]
    assert run(["fleet", "report", "--registry", folder, "-o", str(out), *more]) == 0
    assert out.read_text().startswith("<!DOCTYPE html>") and "<r1>: " in capsys.readouterr().out
    document = json.loads((tmp_path / "out.json").read_text())
    assert document["robots"]["<r1>"] == "moved" and document["n_sessions"] == 80
    (finding,) = document["findings"]
    assert finding["code"] == "fleet.moved" and finding["figures"]["after"] == "2026-01-06T10:00:00Z"
    assert document["causes"] == [{"severity": "no result", "code": "fleet.signal", "rows": 1, "robots": 1}]
    assert run(["fleet", "report", "--registry", folder, "-o", str(out), "--json", "/proc/x/y"]) == 4
    assert run(["fleet", "report", "--registry", str(tmp_path / "none"), "-o", str(out)]) == 4
