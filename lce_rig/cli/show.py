"""Terminal output: tables, progress bars, notes. Results go to stdout, everything else to stderr."""

import json
import shlex
import shutil
import sys
import textwrap
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
import yaml

from lce_rig.core.findings import Finding
from lce_rig.core.progress import Progress, silent

if TYPE_CHECKING:
    from lce_rig.show.tables import Table

COLOURS = {"pass": "green", "marginal": "yellow", "fail": "red"}
"""Colour of each verdict."""
_MOST_UNBROKEN, _WIDTH = 24, 80
# Indentation of continuation lines: below the text after "-> ".
_HANG = 3
# Shortest and longest time between two lines of progress, s.
_SHORTEST_S, _LONGEST_S = 2.0, 30.0


def note(text: str) -> None:
    """Print a line that is not the result, on stderr."""
    click.echo(wrapped(harmless(text), sys.stderr), err=True)


def say(text: str) -> None:
    """Print a line of the result on stdout."""
    click.echo(wrapped(harmless(text), sys.stdout))


def wrapped(text: str, stream: Any) -> str:
    """Wrap and indent lines at the terminal's width; lines for files stay whole."""
    if not stream.isatty():
        return text
    width = shutil.get_terminal_size().columns

    def fill(line: str) -> str:
        indent = " " * min(len(line) - len(line.lstrip(" ")) + 2, width // 2)
        return textwrap.fill(
            line, width, subsequent_indent=indent, break_long_words=False, break_on_hyphens=False
        )

    return "\n".join(map(fill, text.split("\n")))


def counted(n: int, noun: str) -> str:
    """Write a number with its noun: "1 capture", "2 captures"."""
    return f"{n} {noun}" if n == 1 else f"{n} {noun}s"


def name_ranges(names: Sequence[str]) -> str:
    """List names of captures; three or more successive numbers as "000003 to 000007"."""
    runs: list[list[str]] = []
    for name in names:
        is_next = runs and name.isdigit() and runs[-1][-1].isdigit() and int(name) == int(runs[-1][-1]) + 1
        if is_next:
            runs[-1].append(name)
        else:
            runs.append([name])
    return ", ".join(f"{run[0]} to {run[-1]}" if len(run) > 2 else ", ".join(run) for run in runs)


def cause_lines(cause: str, action: str, colour: str = "none") -> list[str]:
    """Write a cause and its action for `print_parts`, on one line if both fit a terminal's 80 columns."""
    if not action:
        return [f"  [{colour}]{escape(cause)}[/]"]
    if len(f"  {cause} -> {action}") <= _WIDTH:
        return [f"  [{colour}]{escape(cause)}[/] -> {escape(action)}"]
    return [f"  [{colour}]{escape(cause)}[/]", f"    -> {escape(action)}"]


def name_next(verb: str, session: Path, options: str = "") -> None:
    """Print the suggested next command on stderr."""
    note(f"  next         {command(verb, session, options)}")


def command(verb: str, session: Path, options: str = "") -> str:
    """Build a command; the default session is omitted."""
    chosen = "" if session == Path("session") else f" {shlex.quote(str(session))}"
    return f"lce-rig {verb}{chosen}{options}"


def warn(text: str) -> None:
    """Print a warning on stderr."""
    click.secho(wrapped(f"warning: {harmless(text)}", sys.stderr), fg="yellow", err=True)


def warn_of(findings: Iterable[Finding]) -> None:
    """Print findings as warnings."""
    for finding in findings:
        warn(finding.sentence)


def print_json(document: Any) -> None:
    """Print a result as JSON; findings, records and arrays are converted."""
    click.echo(_as_json(document))


def print_figures(document: Any) -> None:
    """Print every figure of `print_json` as YAML, to five digits."""
    rounded = json.loads(_as_json(document), parse_float=lambda text: float(f"{float(text):.5g}"))
    click.echo(yaml.safe_dump(rounded, sort_keys=False, default_flow_style=None, width=100), nl=False)


def _as_json(document: Any) -> str:
    def plain(value: Any) -> Any:
        if hasattr(value, "as_json"):
            return value.as_json()
        if hasattr(value, "model_dump"):
            return value.model_dump()
        return value.tolist() if hasattr(value, "tolist") else vars(value)

    return json.dumps(document, indent=2, allow_nan=False, default=plain)


def plain_table(title: str, *headings: str, rows: Iterable[Iterable[str]] = ()) -> Any:
    """Make a rich table without rules, so that it can be copied into a message; ">" aligns to the right."""
    from rich.table import Table

    table = Table(
        title=title or None,
        title_justify="left",
        show_header=any(heading.strip(">") for heading in headings),
        pad_edge=False,
        box=None,
        header_style="bold",
        padding=(0, 1, 0, 0),
    )
    for heading in headings:
        table.add_column(heading.removeprefix(">"), justify="right" if heading.startswith(">") else "left")
    for cells in rows:
        table.add_row(*cells)
    return table


def text_table(table: "Table") -> Any:
    """Make a rich table of the rows of a result's table."""
    texts, figures = table.headings[: table.n_texts], table.headings[table.n_texts :]
    rows = (map(escape, row) for row in table.rows)
    return plain_table("", *texts, *(f">{heading}" for heading in figures), rows=rows)


def matrix_lines(T: Any, indent: str) -> list[str]:
    """Write the upper three rows of a pose."""
    return [indent + "  ".join(f"{value: .6f}" for value in row) for row in T[:3]]


def print_table(table: Any) -> None:
    """Print a rich table on stdout, at full width if stdout is not a terminal."""
    from rich.console import Console

    for column in table.columns:
        # In narrow terminals, wrap sentences, not names and figures.
        column.no_wrap = max((len(str(cell)) for cell in column.cells), default=0) <= _MOST_UNBROKEN
    Console(width=None if sys.stdout.isatty() else 160).print(table)


class ProgressBar:
    """A bar of rich, as `core.progress` calls it: (done, total), and `begin` at each step."""

    def __init__(self, bar: Any, title: str) -> None:
        self._bar, self._title = bar, title
        self._task = bar.add_task(title, total=None)

    def __call__(self, done: int, total: int) -> None:
        """Show how many are done."""
        self._bar.update(self._task, completed=done, total=total)

    def begin(self, step: str) -> None:
        """Name the step; the bar bounces until its (done, total) are known."""
        # rich cannot unset a task's total, so replace the task.
        self._bar.remove_task(self._task)
        self._task = self._bar.add_task(f"{self._title}: {step}", total=None)


class ProgressLines:
    """Progress lines for a file or a pipe: every 10 %, at least every 30 s; none for short work."""

    def __init__(self, title: str, now_s: Callable[[], float] = time.monotonic) -> None:
        self._title, self._now_s = title, now_s
        self._last_s, self._tenths = now_s(), 0

    def __call__(self, done: int, total: int) -> None:
        """Print the progress, if a line is due."""
        passed_s, tenths = self._now_s() - self._last_s, 10 * done // max(total, 1)
        is_step = tenths > self._tenths and passed_s >= _SHORTEST_S
        if done < total and (is_step or passed_s >= _LONGEST_S):
            self._last_s, self._tenths = self._now_s(), tenths
            note(f"{self._title}: {done} of {total} ({100 * done // total} %)")


@contextmanager
def progress_bar(title: str, *, has_lines: bool = False) -> Iterator[Progress]:
    """Show a progress bar of this title on stderr.

    Args:
        title: title of the work.
        has_lines: prints lines if stderr is not a terminal; by default, it gets nothing then.
    """
    if not sys.stderr.isatty():
        yield ProgressLines(title) if has_lines else silent
        return
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, TextColumn, TimeElapsedColumn
    from rich.progress import Progress as Bar

    columns = [TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn()]
    with Bar(*columns, console=Console(stderr=True), transient=True) as bar:
        yield ProgressBar(bar, title)


def harmless(text: str) -> str:
    """Escape control characters in foreign text, so that the terminal does not execute them."""
    return "".join(each if each.isprintable() or each in "\n\t" else repr(each)[1:-1] for each in text)


def escape(text: str) -> str:
    """Escape brackets and control characters in names, so that rich and the terminal print them literally."""
    from rich.markup import escape as escape_markup

    return escape_markup(harmless(text))


def print_parts(parts: Iterable[Any]) -> None:
    """Print a result on stdout: lines with rich markup, and tables.

    A terminal gets lines wrapped at words, indented.
    """
    from rich.console import Console
    from rich.text import Text

    is_terminal = sys.stdout.isatty()
    console = Console(highlight=False, soft_wrap=not is_terminal)
    for line in parts:
        if not isinstance(line, str):
            print_table(line)
        elif not is_terminal:
            console.print(line)
        else:
            text = Text.from_markup(line.lstrip(" "))
            indent = " " * min(len(line) - len(line.lstrip(" ")), console.width // 2)
            for k, part in enumerate(text.wrap(console, console.width - len(indent) - _HANG) or [text]):
                console.print(Text(indent + " " * (_HANG if k else 0)) + part)
