"""One version, and files for the package's users that agree with the code."""

from pathlib import Path

import yaml

import lce_rig

ROOT = Path(__file__).parents[2]


def test_citation_and_changelog_name_the_version():
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text("utf-8"))
    assert str(citation["version"]) == lce_rig.__version__
    lines = (ROOT / "CHANGELOG.md").read_text("utf-8").splitlines()
    newest = next(line for line in lines if line.startswith("## "))
    assert newest.split()[1] in (lce_rig.__version__, "Unreleased")
