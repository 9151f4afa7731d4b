#!/usr/bin/env python3
"""Fill the figures of README.md and docs/ from docs/figures.json, which `scripts/bench.py --record` writes.

Marks in the pages, which no reader sees, name the figures:

    <!-- figure: KEY -->0.016 deg<!-- / -->           in a sentence or a cell
    | label <!-- row: PREFIX: A, -, B --> | ... |     cells of a row: PREFIX.A, one left as it is, PREFIX.B
    | label <!-- row: KEY, KEY --> | ... |            the same with whole keys
"""

import json
import re
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[1]
FILE = ROOT / "docs" / "figures.json"
PAGES = tuple(
    ROOT / name
    for name in (
        "README.md",
        "docs/benchmarks.md",
        "docs/how-accuracy-was-tested.md",
        "docs/intrinsics.md",
        "docs/without-a-board.md",
    )
)
_LEFT = "-"
_FIGURE = re.compile(r"(<!-- figure: (\S+) -->).*?(<!-- / -->)")
_ROW = re.compile(r"<!-- row: (?:(\S+): )?(.*?) -->")

Figures = dict[str, dict[str, Any]]
"""By key: `value`, a list; `unit`, its format; `command`; date `measured`; `commit`."""


def read_figures() -> Figures:
    """Read the file."""
    figures: Figures = json.loads(FILE.read_text(encoding="utf-8"))
    return figures


def write_figures(figures: Figures) -> None:
    """Write the file, a line for each figure."""
    lines = [f"{json.dumps(key)}: {json.dumps(figures[key])}" for key in sorted(figures)]
    FILE.write_text("{\n" + ",\n".join(lines) + "\n}\n", encoding="utf-8")


def shown_keys() -> set[str]:
    """Name the figures that the pages show."""
    return {key for page in PAGES for key in _keys(page.read_text(encoding="utf-8"))}


def fill(text: str, figures: Figures) -> str:
    """Fill a page's figures.

    Raises:
        KeyError: a page shows a figure that is not in the file.
    """
    filled = _FIGURE.sub(lambda mark: f"{mark[1]}{_printed(figures[mark[2]])}{mark[3]}", text)
    return "".join(_fill_row(line, figures) for line in filled.splitlines(keepends=True))


def fill_pages() -> None:
    """Fill all pages."""
    figures = read_figures()
    for page in PAGES:
        page.write_text(fill(page.read_text(encoding="utf-8"), figures), encoding="utf-8")


def _keys(text: str) -> Iterator[str]:
    yield from (mark[2] for mark in _FIGURE.finditer(text))
    for mark in _ROW.finditer(text):
        yield from (key for key in _row_keys(mark) if key != _LEFT)


def _row_keys(mark: re.Match[str]) -> list[str]:
    prefix, names = mark.groups()
    return [name if name == _LEFT or not prefix else f"{prefix}.{name}" for name in names.split(", ")]


def _fill_row(line: str, figures: Figures) -> str:
    mark = _ROW.search(line)
    if mark is None:
        return line
    cells = line.split("|")
    # The line begins with a bar: cell 0 is empty, cell 1 holds label and mark.
    for place, key in enumerate(_row_keys(mark), 2):
        if key != _LEFT:
            cells[place] = f" {_printed(figures[key])} "
    return "|".join(cells)


def _printed(figure: dict[str, Any]) -> str:
    return str(figure["unit"]).format(*figure["value"])


if __name__ == "__main__":
    fill_pages()
    sys.stdout.write("\n".join(map(str, PAGES)) + "\n")
