"""A robot beside its siblings."""

import json
import shutil
from dataclasses import replace

import numpy as np
import pytest

import lce_rig as lce
from lce_rig.cli.main import run
from lce_rig.core.geometry import exp_so3, perturb, pose
from lce_rig.fleet.history import history_of
from lce_rig.fleet.siblings import compare, deviations, limit_of, mountings
from lce_rig.fleet.table import Row, as_table, result_columns, write_table

SIGMA = np.array([1e-3, 1e-3, 1e-3, *np.radians([0.03, 0.03, 0.03])])
SPREAD = np.array([3e-3, 3e-3, 3e-3, *np.radians([0.4, 0.4, 0.4])])
NOMINAL = pose(exp_so3(np.array([0.1, 1.5, -0.2])), np.array([0.1, -0.2, 0.05]))


@pytest.fixture
def fleet(row):
    """One session of each of 30 robots, mounted with a spread."""
    rng = np.random.default_rng(0)

    def make(robot, mounted=None, **changes):
        own = SPREAD * rng.normal(size=6) if mounted is None else mounted
        known = {
            "session_sha256": robot,
            "T_cam_lidar": tuple(perturb(NOMINAL, own + SIGMA * rng.normal(size=6)).ravel().tolist()),
            "cov": tuple(np.diag(SIGMA**2)[np.triu_indices(6)].tolist()),
            "cov_shared": tuple(np.zeros(21).tolist()),
            "nominal": tuple(NOMINAL.ravel().tolist()),
            "nominal_source": "cad",
            "nominal_tolerance_deg": 5.0,
            "nominal_tolerance_m": 0.1,
        }
        return row(robot, **(known | changes))

    return make


def test_tolerances_of_mounting_are_measured_and_the_outlier_is_named(fleet):
    rows = [fleet(f"r{k}") for k in range(60)]
    rows.append(fleet("r_bent", 8 * SPREAD * np.eye(6)[4]))
    table = as_table(rows)
    (mounting,) = mountings(table, history_of(table))
    assert len(mounting.robots) == 61 and mounting.tolerance_deg == 5.0
    assert np.all(np.abs(mounting.spread / SPREAD - 1) < 0.6)
    assert np.all(np.abs(mounting.median) < SPREAD)
    assert [(mounting.robots[robot], axis) for robot, axis in mounting.outliers] == [("r_bent", 4)]


def test_robots_of_another_drawing_are_no_siblings(fleet):
    other = tuple(perturb(NOMINAL, np.full(6, 0.01)).ravel().tolist())
    rows = [fleet(f"r{k}") for k in range(6)] + [fleet(f"s{k}", nominal=other) for k in range(4)]
    table = as_table(rows)
    assert [len(each.robots) for each in mountings(table, history_of(table))] == [6, 4]


def test_a_robot_known_less_well_needs_to_be_farther_apart():
    apart = np.zeros((9, 6))
    apart[:8, 0] = np.linspace(-1, 1, 8)
    apart[8, 0] = 5
    sigma = np.full((9, 6), 0.1)
    near = deviations(apart, sigma)[8, 0]
    sigma[8] = 5.0
    assert near > 4 > 1.2 > deviations(apart, sigma)[8, 0]


def test_robots_of_two_kinds_name_nobody(fleet):
    shifted = 20 * SPREAD * np.eye(6)[3]
    rng = np.random.default_rng(1)
    rows = [
        fleet(f"r{k}", 0.1 * SPREAD * rng.normal(size=6) + (shifted if k % 3 == 0 else 0)) for k in range(30)
    ]
    table = as_table(rows)
    (mounting,) = mountings(table, history_of(table))
    assert not mounting.is_one_kind and mounting.outliers == []
    assert compare(fleet("new", shifted), table) == []


def test_few_siblings_name_nobody():
    assert limit_of(5, 5) == np.inf
    assert 3.5 < limit_of(60, 60) < 4.5
    assert limit_of(60, 1) < limit_of(60, 60)


def test_a_new_result_is_compared_with_its_siblings_and_with_its_past(fleet):
    rows = [fleet(f"r{k}") for k in range(30)]
    for day in range(2, 6):
        again = {"date": f"2026-01-{day:02d}T10:00:00Z", "session_sha256": f"r0-{day}", "folder": f"r0/{day}"}
        rows.append(fleet("r0", np.zeros(6), **again))
    rows[0] = replace(rows[0], T_cam_lidar=rows[-1].T_cam_lidar)
    table = as_table(rows)
    as_before = fleet("r0", np.zeros(6), date="2026-02-01T10:00:00Z", session_sha256="new")
    assert compare(as_before, table) == []
    bent = fleet("r0", 10 * SPREAD * np.eye(6)[3], date="2026-02-01T10:00:00Z", session_sha256="new")
    since, beside = compare(bent, table)
    assert (since.code, since.figures["axes"]) == ("fleet.moved_last", ("rotation_x",))
    assert (beside.code, beside.figures["n_siblings"]) == ("fleet.apart_from_siblings", 29)
    assert beside.figure("apart_deg") == pytest.approx(4.0, abs=0.5)
    assert all(finding.severity == "note" for finding in (since, beside))
    assert compare(replace(bent, session_sha256="r0-5"), as_table(rows[-1:])) == []
    assert compare(bent, as_table(rows[1:4])) == []


@pytest.mark.long
def test_calibrate_notes_what_the_registry_knows(simulated, tmp_path):
    own = tmp_path / "session"
    shutil.copytree(simulated, own)
    result = lce.calibrate(lce.Session.open(own))
    (pair,) = result.pairs
    columns = result_columns(pair, result.session.rig, {})
    rng = np.random.default_rng(0)
    rows = []
    for k in range(12):
        T = perturb(pair.T_cam_lidar, np.radians(5) * np.eye(6)[4] + 1e-3 * rng.normal(size=6))
        known = {**columns, "T_cam_lidar": tuple(T.ravel().tolist())}
        rows.append(Row(f"r{k}", rig=result.session.rig.name, date="2026-01-01T00:00:00Z", **known))
    write_table(tmp_path / "fleet.parquet", as_table(rows))
    before = (own / "rig.yaml").read_bytes()
    assert run(["calibrate", str(own), "--registry", str(tmp_path), "--no-report"]) == 0
    (written,) = json.loads((own / "calibration/result.json").read_text())["pairs"]
    notes = [each for each in written["findings"] if each["code"] == "fleet.apart_from_siblings"]
    assert [each["severity"] for each in notes] == ["note"]
    assert (notes[0]["figures"]["axis"], notes[0]["figures"]["n_siblings"]) == ("rotation_y", 12)
    assert written["verdict"] == pair.verdict
    assert (own / "rig.yaml").read_bytes() == before
