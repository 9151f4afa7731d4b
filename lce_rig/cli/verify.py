"""`lce-rig verify`: the LiDAR drawn into the pictures, residuals per capture, exit by verdict."""

from pathlib import Path
from typing import Any

import click

from lce_rig.cli import show
from lce_rig.cli.options import event_image_option, json_option, session_argument


@click.command()
@session_argument
@click.option(
    "--result",
    type=click.Path(path_type=Path),
    metavar="FILE",
    help="A result.json of another session of this rig: check it on the captures of this one.",
)
@click.option(
    "-o", "--output", type=click.Path(path_type=Path), metavar="FOLDER", help="Where the pictures go."
)
@json_option
@event_image_option
def verify(session: Path, result: Path | None, output: Path | None, as_json: bool, event_image: Any) -> None:
    """Draw the LiDAR of each capture of SESSION (default: session/) into its picture, print residuals.

    Images and one contact sheet replace those in SESSION/calibration/overlays/, with --result FILE those in
    SESSION/overlays/. Exits with 7 where the verdict is fail or these captures contradict the extrinsic.
    """
    from dataclasses import replace

    from lce_rig import pipeline
    from lce_rig.cli.calibrate import exit_by_verdict
    from lce_rig.core.errors import ResultRefusedError, SessionError
    from lce_rig.detect.detection import Pair
    from lce_rig.export.result import read_result
    from lce_rig.pipeline.result_files import RESULT, result_content
    from lce_rig.session import Session
    from lce_rig.session.session import CALIBRATION

    opened = Session.open(session)
    own = None if result is not None else result_content(opened)
    saved = read_result(result or session / CALIBRATION / RESULT)
    if saved.rig != opened.rig.name or not saved.calibrations:
        what = (
            f"the result is of rig {saved.rig!r}"
            if saved.calibrations
            else "the result holds no pair of sensors"
        )
        raise SessionError(f"{what}; the session {session} is of rig {opened.rig.name!r}")
    calibrations = list(saved.calibrations)
    if result is not None:
        # Names of captures say nothing across sessions: none of these was fitted.
        calibrations = [replace(c, captures_used=(), captures_refused={}) for c in calibrations]
    with show.progress_bar("detecting") as progress:
        detections = pipeline.detect(opened, event_image=event_image, progress=progress)
    with show.progress_bar("drawing") as progress:
        checks = pipeline.verify(
            opened,
            detections,
            calibrations,
            event_image=event_image,
            result=own,
            folder=output,
            progress=progress,
        )
    if as_json:
        show.print_json(
            {"format_version": 1, "rig": opened.rig.name, "pairs": [c.document() for c in checks]}
        )
    else:
        for checked in checks:
            show.print_table(_table(checked))
            show.print_lines(_summary(checked))
    held = {(checked.pair.camera, checked.pair.lidar) for checked in checks}
    for c in calibrations:
        if (c.camera, c.lidar) not in held:
            show.warn(f"{session} holds no captures of {Pair.of(c)}: not checked")
    exit_by_verdict(calibrations)
    contradicted = [checked for checked in checks if checked.doubts]
    if contradicted:
        raise ResultRefusedError(
            f"the captures of {session} contradict the extrinsic of "
            + " and that of ".join(str(checked.pair) for checked in contradicted),
            "\n".join(f"{checked.pair}: {doubt}" for checked in contradicted for doubt in checked.doubts),
        )


def _table(checked: Any) -> Any:
    table = show.plain_table(str(checked.pair))
    for title in ("capture", "planes mm", "rms", "edges mm", "rms", "corners px"):
        table.add_column(title, justify="left" if title == "capture" else "right")
    table.add_column("")
    for r in checked.residuals:
        lengths = (r.plane_mean_m, r.plane_rms_m, r.edge_mean_m, r.edge_rms_m)
        state = "" if r.capture in checked.used else "[dim]not used[/]"
        cells = (*(f"{1000 * value:.1f}" for value in lengths), f"{r.reprojection_px:.2f}", state)
        table.add_row(r.capture, *cells)
    return table


def _summary(checked: Any) -> list[str]:
    lines = []
    if checked.metrics is not None:
        m = checked.metrics
        lines.append(
            f"mean over captures: planes {1000 * m.mpe_m:.1f} mm, edges {1000 * m.mee_m:.1f} mm, "
            f"together {1000 * m.mge_m:.1f} mm; corners {m.reprojection_px:.2f} px"
        )
    lines.append(f"verdict of the calibration: {checked.verdict}")
    lines.append(f"these captures: {'; '.join(checked.doubts) or 'agree'}")
    if checked.contact_sheet is not None:
        lines.append(f"pictures: {show.escape(str(checked.contact_sheet))}")
    return lines
