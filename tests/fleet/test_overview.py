"""Verdicts, causes, sensors and collection, counted."""

import pytest

from lce_rig.fleet.overview import cameras, causes, lidars, quality, verdicts
from lce_rig.fleet.table import Row, as_table


def test_verdicts_and_reasons_without_one_are_counted(row):
    table = as_table([row("a"), row("b"), row("b", verdict="fail"), Row("c", status="crashed")])
    rows = {each["result"]: each for each in verdicts(table).to_pylist()}
    assert (rows["pass"]["rows"], rows["pass"]["robots"], rows["fail"]["rows"]) == (2, 2, 1)
    assert rows["crashed"]["share"] == 0.25


def test_causes_are_ranked_and_notes_are_none(row):
    few = {"findings": ("verdict.few_used", "verdict.largest_cause"), "severities": ("warning", "note")}
    table = as_table([row("a", **few), row("a", **few), row("b"), Row("c", cause="fleet.timed_out")])
    assert [(each["code"], each["rows"], each["robots"]) for each in causes(table).to_pylist()] == [
        ("verdict.few_used", 2, 1),
        ("fleet.timed_out", 1, 1),
    ]


def test_collection_is_compared_by_person_and_site(row):
    good = {"collector": "Ann", "site": "Graz", "n_captures": 10, "n_used": 9}
    poor = {"collector": "Bo", "site": "Graz", "n_captures": 10, "n_used": 4, "verdict": "marginal"}
    refused = {"refusals": ("image.blurred", "image.blurred", "lidar.too_few_rings")}
    table = as_table([row("a", **good), row("b", **poor, **refused), row("c", **poor), row("d")])
    first, second = quality(table).to_pylist()
    assert (first["collector"], first["sessions"], first["marginal"]) == ("Bo", 2, 1.0)
    assert (first["used"], first["refusal"]) == (pytest.approx(0.4), "image.blurred")
    assert (second["collector"], second["passed"], second["refusal"]) == ("Ann", 1.0, None)


def test_the_camera_whose_lens_changed_comes_first(row):
    sigma = (1e-3, 1.0, 1.0, 0.5)
    rows = []
    for serial, change in (("A", 0.0), ("B", 0.01)):
        for k in range(6):
            error = (0.001 + (change if k > 2 else 0.0), 0.2, -0.2, 0.0)
            known = {"camera_serial": serial, "lens_error": error, "lens_error_sigma": sigma}
            rows.append(row(serial, f"2026-01-0{k + 1}T00:00:00Z", **known))
    first, second = cameras(as_table(rows[::-1])).to_pylist()
    assert (first["camera_serial"], first["changed"], first["sessions"]) == ("B", "focal_length", 6)
    assert first["change_sigmas"] == pytest.approx(0.01 / (1e-3 * (2 / 3) ** 0.5))
    assert second["change_sigmas"] == pytest.approx(0.0, abs=1e-9)


def test_a_laser_is_compared_with_the_same_laser_of_its_model(row):
    usual = [0.004, -0.002, 0.001, -0.003]
    rows = []
    for serial in ("1", "2", "3", "4", "5"):
        own = list(usual)
        if serial == "3":
            own[2] += 0.02
        known = {"lidar_serial": serial, "laser_range_m": tuple(own), "laser_range_sigma_m": (0.002,) * 4}
        rows += [row(serial, **known), row(serial, **known)]
    first = lidars(as_table(rows)).to_pylist()[0]
    assert (first["lidar_serial"], first["laser"], first["sessions"]) == ("3", 2, 2)
    assert first["range_m"] - first["model_m"] == pytest.approx(0.015, abs=1e-9)


def test_tables_without_such_figures_give_none(row):
    table = as_table([row("a")])
    assert len(lidars(table)) == len(cameras(table)) == len(quality(table)) == 0
