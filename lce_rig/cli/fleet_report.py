"""`lce-rig fleet report`: the robots of a registry as one page."""

from pathlib import Path

import click

from lce_rig.cli import show
from lce_rig.cli.options import registry_option

_MOST_SHOWN = 20


@click.command()
@registry_option
@click.option(
    "--output",
    "-o",
    default=Path("fleet_report.html"),
    show_default=True,
    type=click.Path(path_type=Path, dir_okay=False),
    metavar="FILE",
    help="Write the page to this file.",
)
@click.option(
    "--json",
    "json_file",
    type=click.Path(path_type=Path, dir_okay=False),
    metavar="FILE",
    help="Write findings, states and counts to this file.",
)
def report(registry: str, output: Path, json_file: Path | None) -> None:
    """Report which robots moved, and why results are missing or failed, as one HTML page.

    A robot moved if two successive results of it differ beyond their own independent covariance. The page
    loads nothing. docs/fleets.md explains it.
    """
    from lce_rig.core.phrasing import as_line
    from lce_rig.fleet.registry import Registry
    from lce_rig.fleet.report import FleetReport
    from lce_rig.fleet.storage import Storage
    from lce_rig.session.durable import write_atomically

    made = FleetReport.of(Registry(Storage.at(registry)))
    write_atomically(output, made.page())
    if json_file is not None:
        made.write_json(json_file)
    for finding in made.findings[:_MOST_SHOWN]:
        show.say(show.escape(f"{finding.subject}: {as_line(finding.sentence)}"))
    if len(made.findings) > _MOST_SHOWN:
        show.note(f"{len(made.findings) - _MOST_SHOWN} more in the report")
    states = [*made.history.robots.values()]
    show.note(f"{states.count('moved')} of {show.counted(len(states), 'robot')} moved; written: {output}")
