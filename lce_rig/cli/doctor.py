"""`lce-rig doctor`: check on one screen whether the computer and the rig's sensors are fit to collect."""

import sys
from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import click

from lce_rig.cli import show
from lce_rig.cli.options import FiniteRange, json_option, rig_option

if TYPE_CHECKING:
    from lce_rig.core.findings import Severity
    from lce_rig.doctor.examine import Check

_MARKS = {"note": "[green]ok[/]", "warning": "[yellow]warn[/]", "error": "[bold red]FAIL[/]"}
_EXIT_ERROR = 5
_INDENT = 5
# The lines before and after the table, and the next prompt.
_N_OTHER_LINES = 3
_FILE_WIDTH = 160


@click.command()
@rig_option
@json_option
@click.option(
    "--duration",
    type=FiniteRange(1, 3600),
    default=5.0,
    show_default=True,
    metavar="S",
    help="Read the sensors for S seconds; longer measures drifts better.",
)
@click.option(
    "-o",
    "--output",
    "folder",
    type=click.Path(path_type=Path),
    default=".",
    metavar="FOLDER",
    help="Measure the disk of this folder, in which sessions will be written  [default: the current one]",
)
def doctor(rig_name: str, as_json: bool, duration: float, folder: Path) -> int:
    """Check this computer and every sensor of a rig, with one line per check and an action per fault.

    ok: no fault. warn: collecting works, with limits. FAIL: collecting does not work, or its data would be
    wrong. An absent device has one line; the others are checked all the same.

    Exits with 5 if a check reports FAIL, else with 0.
    """
    from lce_rig.core.findings import worst
    from lce_rig.devices import sensors
    from lce_rig.doctor.examine import DoctorOptions, examine
    from lce_rig.rig import load_rig

    rig = load_rig(rig_name)
    show.note(f"watching {', '.join(sensors(rig))} ...")
    checks = examine(rig, DoctorOptions(duration, folder))
    severity = worst(found for check in checks for found in check.findings)
    if as_json:
        # Figures that were not measured are null.
        lines = [
            {
                "subject": check.subject,
                "name": check.name,
                "severity": check.severity,
                "findings": [finding.as_json() for finding in check.findings],
            }
            for check in checks
        ]
        show.print_json({"format_version": 2, "rig": rig.name, "severity": severity, "checks": lines})
    else:
        _print_screen(checks)
        n = Counter(check.severity for check in checks)
        if n["error"]:
            show.say(f"{n['error']} FAIL, {n['warning']} warn, {n['note']} ok: follow the lines after ->")
        elif n["warning"]:
            show.say(f"{n['warning']} warn, {n['note']} ok: fit to collect, with the limits above")
        else:
            show.say(f"all {n['note']} ok: fit to collect")
    return _EXIT_ERROR if severity == "error" else 0


def _print_screen(checks: "list[Check]") -> None:
    """Print all lines; if the terminal is too small, those that are ok share one line per group."""
    from rich.console import Console

    console = Console(width=None if sys.stdout.isatty() else _FILE_WIDTH)
    room = console.height - _N_OTHER_LINES
    lines = [_line(check) for check in checks]
    for subject in dict.fromkeys(line.subject for line in lines):
        if not sys.stdout.isatty() or len(console.render_lines(_screen(lines))) <= room:
            break
        fine = [line for line in lines if line.subject == subject and line.severity == "note"]
        if len(fine) > 1:
            # One line for those that are ok, before those that are not.
            at = next(index for index, line in enumerate(lines) if line.subject == subject)
            lines = [line for line in lines if line not in fine]
            names = ", ".join(line.name for line in fine)
            lines.insert(at, fine[0]._replace(name="", text=names, actions=()))
    with console.capture() as capture:
        console.print(_screen(lines))
    # Rich fills wrapped lines up with blanks.
    for line in capture.get().splitlines():
        click.echo(line.rstrip())


class _Line(NamedTuple):
    """A check in words: its findings in one line, and a line for each action."""

    subject: str
    name: str
    severity: "Severity"
    text: str
    actions: tuple[str, ...]


def _line(check: "Check") -> _Line:
    from lce_rig.core.phrasing import as_line

    text = "; ".join(finding.text for finding in check.findings)
    actions = [as_line(action) for finding in check.findings for action in finding.advice.splitlines()]
    return _Line(check.subject, check.name, check.severity, text, tuple(dict.fromkeys(actions)))


def _screen(lines: list[_Line]) -> Any:
    """Lay the lines out in columns, remedies below their line in the full width."""
    from rich.console import Group
    from rich.padding import Padding
    from rich.table import Table

    widths = [4, *(max(len(getattr(line, column)) for line in lines) for column in ("subject", "name"))]
    rows: list[Any] = []
    last = ""
    for line in lines:
        row = Table.grid(padding=(0, 1))
        for width in widths:
            row.add_column(width=width)
        row.add_column(overflow="fold")
        subject = "" if line.subject == last else f"[bold]{show.escape(line.subject)}[/]"
        row.add_row(_MARKS[line.severity], subject, line.name, show.escape(line.text))
        rows.append(row)
        rows += [
            Padding(f"[cyan]-> {show.escape(action)}[/]", (0, 0, 0, _INDENT), expand=False)
            for action in line.actions
        ]
        last = line.subject
    return Group(*rows)
