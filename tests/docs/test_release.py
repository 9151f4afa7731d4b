"""One version, and files for the package's users that say the same as the code."""

import re
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


def test_the_container_runs_without_root_and_offline_verbs_without_network():
    lines = (ROOT / "scripts" / "docker" / "Dockerfile").read_text("utf-8")
    (user,) = re.findall(r"^USER (\d+)", lines, re.MULTILINE)
    assert int(user) > 0
    services = yaml.safe_load((ROOT / "scripts" / "docker" / "compose.yaml").read_text("utf-8"))["services"]
    assert services["lce-rig"]["network_mode"] == "none"
    assert services["attached"]["network_mode"] == "host"


def test_udev_rules_are_made_of_matches_and_assignments():
    term = r'(ENV\{\w+\}|ATTRS?\{\w+\}|SUBSYSTEM|MODE)(==|=)"[^"]+"'
    rules = (ROOT / "lce_rig" / "devices" / "60-lce-rig.rules").read_text("utf-8").splitlines()
    for rule in (line for line in rules if line and not line.startswith("#")):
        terms = [re.fullmatch(term, each) for each in rule.split(", ")]
        assert {each and each[2] for each in terms} == {"==", "="}
