"""`lce-rig verify`: the LiDAR drawn into the pictures, residuals per capture, exit by verdict."""

from pathlib import Path
from typing import Any

import click

from lce_rig.cli import show


@click.command()
@click.argument("session", type=click.Path(path_type=Path), default="session")
@click.option(
    "--result",
    type=click.Path(path_type=Path),
    metavar="FILE",
    help="A result.json of another session of this rig: check it on the captures of this one.",
)
@click.option(
    "-o", "--output", type=click.Path(path_type=Path), metavar="FOLDER", help="Where the pictures go."
)
@click.option("--json", "as_json", is_flag=True, help="Print the residuals as JSON.")
def verify(session: Path, result: Path | None, output: Path | None, as_json: bool) -> None:
    """Draw the LiDAR of each capture of SESSION (default: session/) into its pictures and print residuals.

    Pictures and one contact sheet go to SESSION/calibration/overlays/. Exits with 7 where the verdict is fail.
    """
    from lce_rig import pipeline
    from lce_rig.cli.calibrate import exit_by_verdict
    from lce_rig.export.result import read_result
    from lce_rig.session import Session

    opened = Session.open(session)
    saved = read_result(result or session / pipeline.CALIBRATION / "result.json")
    with show.progress_bar("detecting") as progress:
        detections = pipeline.detect(opened, progress=progress)
    with show.progress_bar("drawing") as progress:
        checks = pipeline.verify(opened, detections, saved.calibrations, folder=output, progress=progress)
    if as_json:
        show.print_json(
            {"format_version": 1, "rig": opened.rig.name, "pairs": [c.document() for c in checks]}
        )
    else:
        for checked in checks:
            show.print_table(_table(checked))
            show.note(f"pictures: {checked.contact_sheet}")
    exit_by_verdict(saved.calibrations)
