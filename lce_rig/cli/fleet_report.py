"""`lce-rig fleet report`: what a registry says of its robots, as one page and as tables."""

from pathlib import Path

import click

from lce_rig.cli import show
from lce_rig.cli.options import registry_option


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
    "--csv",
    "csv_folder",
    type=click.Path(path_type=Path, file_okay=False),
    metavar="DIR",
    help="Write each table as CSV into this folder.",
)
@click.option(
    "--json",
    "json_file",
    type=click.Path(path_type=Path, dir_okay=False),
    metavar="FILE",
    help="Write findings and tables to this file; the table of all sessions is in --csv only.",
)
def report(registry: str, output: Path, csv_folder: Path | None, json_file: Path | None) -> None:
    """Report which robots moved, which sensors are odd, and what fails most, as one HTML page.

    Compares the sessions of each robot in time, its mounting with the CAD model and with its siblings,
    LiDARs, cameras and people with each other. The page loads nothing. docs/fleets.md explains it.
    """
    from lce_rig.fleet.registry import Registry
    from lce_rig.fleet.report import findings, page, write_csv, write_json
    from lce_rig.fleet.storage import Storage
    from lce_rig.fleet.tables import tables_of
    from lce_rig.session.durable import write_atomically
    from lce_rig.words import as_line, sentence

    place = Storage.at(registry)
    read = Registry(place).read_table
    made = tables_of(read)
    write_atomically(output, page(made, read, place.name))
    if csv_folder is not None:
        write_csv(made, csv_folder)
    if json_file is not None:
        write_json(made, json_file)
    named = findings(made)
    for finding in named[:_MOST_SHOWN]:
        show.say(show.escape(f"{finding.subject}: {as_line(sentence(finding))}"))
    if len(named) > _MOST_SHOWN:
        show.note(f"{len(named) - _MOST_SHOWN} more in the report")
    show.note(f"{show.counted(len(made.history.robots), 'robot')} compared; written: {output}")


_MOST_SHOWN = 20
