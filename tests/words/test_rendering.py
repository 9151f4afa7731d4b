import pytest

from lce_rig.core.findings import Finding, ranked, worst
from lce_rig.words import rendering
from lce_rig.words.rendering import Phrase, as_json, describe, figures_apart, recommend, sentence


@pytest.fixture(autouse=True)
def table(monkeypatch: pytest.MonkeyPatch) -> None:
    table = {
        "t.rings": Phrase("{n} rings at {distance_m:.1f} m", "come {closer_m:1cm} closer"),
        "t.rms": Phrase(lambda finding: f"rms of {finding.subject}", actions={"hold": "hold it still"}),
        "t.limit": Phrase(
            "error {error_m:mm} (limit {limit_m:mm}), tilt {tilt_deg:.0f} deg ({max_tilt_deg:g} deg)"
        ),
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


@pytest.mark.parametrize(
    ("error_m", "limit_m", "tilt_deg", "words"),
    [
        (0.013, 0.012, 61.2, "error 13 mm (limit 12 mm), tilt 61 deg (60 deg)"),
        (0.0122, 0.012, 60.04, "error 12.2 mm (limit 12.0 mm), tilt 60.04 deg (60 deg)"),
        (0.012, 0.012, 60.0, "error 12 mm (limit 12 mm), tilt 60 deg (60 deg)"),
    ],
)
def test_a_figure_is_printed_so_that_it_differs_from_its_limit(
    error_m: float, limit_m: float, tilt_deg: float, words: str
) -> None:
    figures = {"error_m": error_m, "limit_m": limit_m, "tilt_deg": tilt_deg, "max_tilt_deg": 60.0}
    assert describe(Finding("t.limit", figures=figures)) == words


def test_two_significant_digits_suffice_unless_figure_and_limit_agree_in_them() -> None:
    assert figures_apart(0.2034, 0.2) == ("0.203", "0.2")
    assert figures_apart(112.0, 10.0) == ("112", "10")
    assert figures_apart(0.2, 0.2) == ("0.2", "0.2")


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
