import re
from collections import Counter
from pathlib import Path

import pytest

import lce_rig
from lce_rig.core.findings import Finding, Kind, ranked, worst

PACKAGE = Path(lce_rig.__file__).parent
RINGS = Kind("t.rings", "{n} rings at {distance_m:.1f} m", "come {closer_m:1cm} closer")
LIMIT = Kind(
    "t.limit", "error {error_m:mm} (limit {limit_m:mm}), tilt {tilt_deg:.0f} deg ({max_tilt_deg:g} deg)"
)


def test_figures_are_scaled_to_the_unit_that_is_printed():
    found = RINGS("velodyne", n=2, distance_m=4.04, closer_m=0.8)
    assert found.text == "2 rings at 4.0 m" and "80.0 cm" in found.advice
    assert found.as_json()["figures"] == {"n": 2, "distance_m": 4.04, "closer_m": 0.8}


def test_a_figure_that_is_not_finite_reads_as_unknown():
    assert "unknown cm" in RINGS(n=2, distance_m=1.0, closer_m=float("nan")).advice


@pytest.mark.parametrize(
    ("error_m", "limit_m", "tilt_deg", "words"),
    [
        (0.013, 0.012, 61.2, "error 13 mm (limit 12 mm), tilt 61 deg (60 deg)"),
        (0.0122, 0.012, 60.04, "error 12.2 mm (limit 12.0 mm), tilt 60.04 deg (60 deg)"),
        (0.012, 0.012, 60.0, "error 12 mm (limit 12 mm), tilt 60 deg (60 deg)"),
    ],
)
def test_figure_is_distinguishable_from_its_limit(error_m, limit_m, tilt_deg, words):
    assert LIMIT(error_m=error_m, limit_m=limit_m, tilt_deg=tilt_deg, max_tilt_deg=60.0).text == words


def test_finding_from_file_keeps_its_words():
    found = Finding("t.of_an_old_version", stored=("the text", "the action"))
    assert (found.text, found.advice) == ("the text", "the action")


def test_worst_finding_is_ranked_first():
    notes = [Finding("a", "note"), Finding("b", "error"), Finding("c", "warning"), Finding("d", "error")]
    assert worst(notes) == "error" and worst([]) == "note"
    assert [finding.code for finding in ranked(notes)] == ["b", "d", "c", "a"]


def test_every_declared_kind_is_made_somewhere():
    sources = {path: path.read_text(encoding="utf-8") for path in PACKAGE.rglob("*.py")}
    declared = [
        name for text in sources.values() for name in re.findall(r"^(\w+) = Kind\(", text, re.MULTILINE)
    ]
    assert len(declared) > 150
    words = Counter(word for text in sources.values() for word in re.findall(r"\w+", text))
    assert [name for name in declared if words[name] < 2] == []
