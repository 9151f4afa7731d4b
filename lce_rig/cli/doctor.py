"""`lce-rig doctor`: one screen on whether this computer and the rig's sensors are fit to collect."""

import math
import sys
from collections import Counter
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from lce_rig.cli import show
from lce_rig.cli.options import FiniteRange, json_option, rig_option

if TYPE_CHECKING:
    from lce_rig.collect.health import Check

_MARKS = {"green": "[green]ok[/]", "yellow": "[yellow]warn[/]", "red": "[bold red]FAIL[/]"}
_EXIT_RED = 5
_INDENT = 5
# What the program says before and after, and the next prompt.
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
    help="How long to watch the sensors; longer knows drifts better.",
)
@click.option(
    "-o",
    "--output",
    "folder",
    type=click.Path(path_type=Path),
    default=".",
    metavar="FOLDER",
    help="Where sessions are to be written: its disk is measured. Default: here.",
)
def doctor(rig_name: str, as_json: bool, duration: float, folder: Path) -> int:
    """Look at this computer and every sensor of a rig: a line each, with what to do about it.

    ok: as it should be. warn: collecting works, but less well. FAIL: it does not work, or its data would be
    wrong. What is absent is one line; everything else is looked at all the same.

    Exits with 5 where a line says FAIL, else with 0.
    """
    from lce_rig.collect.health import worst
    from lce_rig.collect.health.sensors import sensors
    from lce_rig.pipeline.doctor import DoctorOptions, examine
    from lce_rig.rig import load_rig

    rig = load_rig(rig_name)
    show.note(f"watching {', '.join(sensors(rig))} ...")
    checks = examine(rig, DoctorOptions(duration, folder))
    severity = worst(check.severity for check in checks)
    if as_json:
        show.print_json(_document(rig.name, severity, checks))
    else:
        _print_screen(checks)
        show.say(_summary(checks))
    return _EXIT_RED if severity == "red" else 0


def _document(rig: str, severity: str, checks: "list[Check]") -> dict[str, Any]:
    """Give every line; a figure that could not be measured is null."""
    lines = [
        asdict(check) | {"values": {k: v if math.isfinite(v) else None for k, v in check.values.items()}}
        for check in checks
    ]
    return {"format_version": 1, "rig": rig, "severity": severity, "checks": lines}


def _print_screen(checks: "list[Check]") -> None:
    """Print all lines; where the terminal is too small for them, those that are ok share one a group."""
    from rich.console import Console

    console = Console(width=None if sys.stdout.isatty() else _FILE_WIDTH)
    room = console.height - _N_OTHER_LINES
    for group in dict.fromkeys(check.group for check in checks):
        if not sys.stdout.isatty() or len(console.render_lines(_screen(checks))) <= room:
            break
        checks = _together(checks, group)
    with console.capture() as capture:
        console.print(_screen(checks))
    # Rich fills wrapped lines up with blanks.
    for line in capture.get().splitlines():
        show.say(line.rstrip())


def _together(checks: "list[Check]", group: str) -> "list[Check]":
    """Put a group's lines that are ok into one, before those that are not."""
    fine = [check for check in checks if check.group == group and check.severity == "green"]
    if len(fine) < 2:
        return checks
    names = ", ".join(check.name for check in fine)
    at = next(index for index, check in enumerate(checks) if check.group == group)
    rest = [check for check in checks if check not in fine]
    return [*rest[:at], replace(fine[0], name="", figure=names), *rest[at:]]


def _screen(checks: "list[Check]") -> Any:
    """Lay the lines out in columns, remedies below their line in the full width."""
    from rich.console import Group
    from rich.padding import Padding
    from rich.table import Table

    widths = [4, *(max(len(getattr(check, column)) for check in checks) for column in ("group", "name"))]
    rows: list[Any] = []
    last = ""
    for check in checks:
        row = Table.grid(padding=(0, 1))
        for width in widths:
            row.add_column(width=width)
        row.add_column(overflow="fold")
        group = "" if check.group == last else f"[bold]{show.escape(check.group)}[/]"
        row.add_row(_MARKS[check.severity], group, check.name, show.escape(check.figure))
        rows.append(row)
        rows += [
            Padding(f"[cyan]-> {show.escape(line)}[/]", (0, 0, 0, _INDENT), expand=False)
            for line in check.remedy.splitlines()
        ]
        last = check.group
    return Group(*rows)


def _summary(checks: "list[Check]") -> str:
    n = Counter(check.severity for check in checks)
    if n["red"]:
        return f"{n['red']} FAIL, {n['yellow']} warn, {n['green']} ok: see the lines after ->"
    if n["yellow"]:
        return f"{n['yellow']} warn, {n['green']} ok: fit to collect, with the limits above"
    return f"all {n['green']} ok: fit to collect"
