"""`lce-rig doctor`: check whether the computer and the rig's sensors are fit to collect."""

from collections import Counter
from pathlib import Path

import click

from lce_rig.cli import show
from lce_rig.cli.options import FiniteRange, explain_option, json_option, path_option, rig_option
from lce_rig.core.findings import worst
from lce_rig.core.phrasing import as_line
from lce_rig.devices import sensors
from lce_rig.doctor.checks import Check, examine
from lce_rig.rig import load_rig

_MARKS = {"note": "[green]ok[/]  ", "warning": "[yellow]warn[/]", "error": "[bold red]FAIL[/]"}
_EXIT_ERROR = 5


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
@path_option(
    "-o",
    "--output",
    "folder",
    "FOLDER",
    "Measure the disk of this folder, in which sessions will be written  [default: the current one]",
    default=".",
)
def doctor(rig_name: str, explain: bool, as_json: bool, duration: float, folder: Path) -> int:
    """Check this computer and every sensor of a rig, and print faults with an action each.

    warn: collecting works, with limits. FAIL: collecting does not work, or its data would be wrong.

    Exits with 5 if a check reports FAIL, else with 0.
    """
    rig = load_rig(rig_name)
    show.note(f"watching {', '.join(sensors(rig))} ...")
    checks = examine(rig, duration, folder)
    severity = worst(found for check in checks for found in check.findings)
    if as_json:
        # Unmeasured figures are null.
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
        worst_first = sorted(checks, key=lambda check: check.severity != "error")
        shown = checks if explain else [check for check in worst_first if check.severity != "note"]
        show.print_parts(_lines(shown))
    return _EXIT_ERROR if severity == "error" else 0


def _lines(checks: list[Check]) -> list[str]:
    """List a line per check, with its actions below."""
    subject_width = max((len(check.subject) for check in checks), default=0)
    name_width = max((len(check.name) for check in checks), default=0)
    lines, last = [], ""
    for check in checks:
        subject = f"{'' if check.subject == last else check.subject:<{subject_width}}"
        text = "; ".join(finding.text for finding in check.findings)
        cells = f"[bold]{show.escape(subject)}[/] {check.name:<{name_width}} {show.escape(text)}"
        lines.append(f"{_MARKS[check.severity]} {cells}")
        advice = [line for finding in check.findings for line in finding.advice.splitlines()]
        lines += [f"     [cyan]-> {show.escape(action)}[/]" for action in dict.fromkeys(map(as_line, advice))]
        last = check.subject
    return lines
