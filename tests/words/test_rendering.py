import pytest

from lce_rig.core.findings import Finding, ranked, worst
from lce_rig.words import rendering
from lce_rig.words.rendering import Phrase, as_json, describe, recommend, sentence


@pytest.fixture(autouse=True)
def table(monkeypatch: pytest.MonkeyPatch) -> None:
    table = {
        "t.rings": Phrase("{n} rings at {distance_m:.1f} m", "come {closer_m:1cm} closer"),
        "t.rms": Phrase(lambda finding: f"rms of {finding.subject}", actions={"hold": "hold it still"}),
    }
    monkeypatch.setattr(rendering, "phrases", lambda: table)


def test_figures_are_scaled_to_the_unit_that_is_printed() -> None:
    found = Finding("t.rings", "error", "velodyne", {"n": 2, "distance_m": 4.04, "closer_m": 0.8})
    assert sentence(found) == "2 rings at 4.0 m: come 80.0 cm closer"
    assert as_json(found)["figures"] == {"n": 2, "distance_m": 4.04, "closer_m": 0.8}


def test_a_figure_that_is_not_finite_reads_as_unknown() -> None:
    assert "unknown cm" in recommend(
        Finding("t.rings", figures={"n": 2, "distance_m": 1.0, "closer_m": float("nan")})
    )


def test_the_action_named_by_the_finding_is_given() -> None:
    found = Finding("t.rms", "warning", "000003", action="hold")
    assert (describe(found), recommend(found)) == ("rms of 000003", "hold it still")
    assert recommend(Finding("t.rms", "warning", "000003")) == ""


def test_the_worst_finding_decides_and_order_is_kept_otherwise() -> None:
    notes = [Finding("a", "note"), Finding("b", "error"), Finding("c", "warning"), Finding("d", "error")]
    assert worst(notes) == "error" and worst([]) == "note"
    assert [finding.code for finding in ranked(notes)] == ["b", "d", "c", "a"]


def test_a_figure_asked_for_as_a_number_must_be_one() -> None:
    with pytest.raises(TypeError):
        Finding("a", figures={"axis": "x"}).figure("axis")
