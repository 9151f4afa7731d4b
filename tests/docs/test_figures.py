"""Figures of README.md and of the pages on accuracy are those of docs/figures.json."""

import re

import pytest
from bench import PARTS
from figures_page import PAGES, ROOT, fill, read_figures, shown_keys
from fuzz import TARGETS

_SCRIPT = re.compile(r"scripts/(bench|fuzz)\.py (\S+)")


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_page_shows_the_figures_of_the_file(page):
    """Run scripts/figures_page.py after a change of the file."""
    text = page.read_text(encoding="utf-8")
    assert fill(text, read_figures()) == text


def test_file_holds_the_figures_that_pages_show():
    assert read_figures().keys() == shown_keys()


def test_figures_name_commands_that_exist():
    commands = {figure["command"] for figure in read_figures().values()}
    named = {match.groups() for command in commands for match in _SCRIPT.finditer(command)}
    assert named <= {("bench", part) for part in PARTS} | {("fuzz", target) for target in TARGETS}


def test_figures_hold_value_unit_command_date_commit():
    fields = {"value", "unit", "command", "measured", "commit"}
    assert all(figure.keys() == fields and figure["measured"] for figure in read_figures().values())


@pytest.mark.parametrize("page", ["README.md", "docs/benchmarks.md"])
def test_rows_of_figures_are_marked(page):
    text = (ROOT / page).read_text(encoding="utf-8")
    text = text[text.index("## Accuracy" if page == "README.md" else "## Recordings") :]
    tables = re.findall(r"\n\|(?:---\|)+\n((?:\|[^\n]*\n)+)", text)
    rows = [row for table in tables for row in table.splitlines()]
    assert rows
    assert [row for row in rows if "<!-- row: " not in row] == []
