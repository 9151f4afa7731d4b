"""`lce-rig doctor`: check whether the computer and the rig's sensors are fit to collect."""

import sys
from collections import Counter
from pathlib import Path

import click
from rich.console import Console
from rich.padding import Padding
from rich.table import Table

from lce_rig.cli import show
from lce_rig.cli.options import FiniteRange, explain_option, json_option, rig_option
from lce_rig.core.findings import worst
from lce_rig.core.phrasing import as_line
from lce_rig.devices import sensors
from lce_rig.doctor.checks import Check, DoctorOptions, examine
from lce_rig.rig import load_rig

_MARKS = {"note": "[green]ok[/]", "warning": "[yellow]warn[/]", "error": "[bold red]FAIL[/]"}
_EXIT_ERROR = 5
_INDENT = 5
_FILE_WIDTH = 160


@click.command()
@rig_option
@explain_option
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
def doctor(rig_name: str, explain: bool, as_json: bool, duration: float, folder: Path) -> int:
    """Check this computer and every sensor of a rig, and print faults with an action each.

    ok: no fault; --explain prints these checks, too. warn: collecting works, with limits. FAIL: collecting
    does not work, or its data would be wrong. An absent device has one line; the others are checked all the
    same.

    Exits with 5 if a check reports FAIL, else with 0.
    """
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
                "findings": check.findings,
            }
            for check in checks
        ]
        show.print_json({"format_version": 2, "rig": rig.name, "severity": severity, "checks": lines})
    else:
        n = Counter(check.severity for check in checks)
        if n["error"]:
            show.say(f"not fit to collect: {n['error']} FAIL, {n['warning']} warn, {n['note']} ok")
        elif n["warning"]:
            show.say(f"fit to collect, with limits: {n['warning']} warn, {n['note']} ok")
        else:
            show.say(f"fit to collect: all {n['note']} ok")
        _print_checks(
            checks if explain else [each for each in _worst_first(checks) if each.severity != "note"]
        )
    return _EXIT_ERROR if severity == "error" else 0


def _worst_first(checks: list[Check]) -> list[Check]:
    return sorted(checks, key=lambda check: check.severity != "error")


def _print_checks(checks: list[Check]) -> None:
    """Print a line per check, and its actions below it in the full width."""
    if not checks:
        return
    widths = [4, *(max(len(getattr(check, column)) for check in checks) for column in ("subject", "name"))]
    console = Console(width=None if sys.stdout.isatty() else _FILE_WIDTH)
    last = ""
    with console.capture() as capture:
        for check in checks:
            row = Table.grid(padding=(0, 1))
            for width in widths:
                row.add_column(width=width)
            row.add_column(overflow="fold")
            subject = "" if check.subject == last else f"[bold]{show.escape(check.subject)}[/]"
            text = "; ".join(finding.text for finding in check.findings)
            row.add_row(_MARKS[check.severity], subject, check.name, show.escape(text))
            console.print(row)
            advice = [line for finding in check.findings for line in finding.advice.splitlines()]
            for action in dict.fromkeys(map(as_line, advice)):
                console.print(Padding(f"[cyan]-> {show.escape(action)}[/]", (0, 0, 0, _INDENT), expand=False))
            last = check.subject
    # Rich fills wrapped lines up with blanks.
    for line in capture.get().splitlines():
        click.echo(line.rstrip())
