"""`lce-rig drift`: compare deployed extrinsics with the edges of a scene, exit by what they say."""

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from lce_rig.cli import show
from lce_rig.cli.options import json_option

if TYPE_CHECKING:
    from lce_rig.pipeline.drift import PairDrift


@click.command()
@click.argument("recording", type=click.Path(path_type=Path), default="session")
@click.option(
    "--result",
    type=click.Path(path_type=Path),
    metavar="FILE",
    help="Check this result.json [default: that of the session].",
)
@click.option(
    "--rig",
    "rig_name",
    metavar="NAME|FILE",
    help="Set the rig profile of a folder of images and point clouds; a session has its own.",
)
@click.option(
    "-o", "--output", type=click.Path(path_type=Path), metavar="FOLDER", help="Write images into this folder."
)
@click.option("--ignore-board", is_flag=True, help="Leave out edges at the board, where an image shows one.")
@json_option
def drift(
    recording: Path,
    result: Path | None,
    rig_name: str | None,
    output: Path | None,
    ignore_board: bool,
    as_json: bool,
) -> None:
    """Check on RECORDING (default: session/), without a board, whether extrinsics still hold.

    RECORDING is a session or, with --rig, a folder of images and point clouds. Depth edges of the scans are
    compared with edges of the images. Exits with 0 if no axis has changed, with 7 if one has, and with 6 if
    the scene cannot tell.
    """
    from lce_rig.core.errors import NotEnoughDataError, ResultRefusedError
    from lce_rig.export.result import read_result
    from lce_rig.pipeline.drift import drift as watch_drift
    from lce_rig.rig import load_rig
    from lce_rig.words import as_line, describe, recommend

    saved = None if result is None else read_result(result)
    rig = None if rig_name is None else load_rig(rig_name)
    with show.progress_bar("reading") as progress:
        report = watch_drift(recording, saved, rig=rig, ignore_board=ignore_board, progress=progress)
    files = [] if output is None else report.write(output)
    if as_json:
        pairs = [pair.document() for pair in report.pairs]
        show.print_json({"format_version": 1, "rig": report.rig.name, "pairs": pairs})
    else:
        for pair in report.pairs:
            show.print_table(_table(pair))
            show.print_lines(_summary(pair))
        for file in files:
            show.say(f"image: {file}")
    for state, error in (("changed", ResultRefusedError), ("unknown", NotEnoughDataError)):
        concerned = [pair for pair in report.pairs if pair.drift.state == state]
        if concerned:
            first = concerned[0].drift.findings[0]
            names = " and ".join(f"{pair.calibration.camera}, {pair.calibration.lidar}" for pair in concerned)
            raise error(f"{names}: {describe(first)}", as_line(recommend(first)))


_STATES = {"unchanged": "no change seen", "changed": "[red]changed[/]", "unknown": "[yellow]cannot tell[/]"}


def _table(pair: "PairDrift") -> Any:
    from lce_rig.words.extrinsics import motion_words

    table = show.plain_table(f"{pair.calibration.camera}, {pair.calibration.lidar}", "axis of the camera", "")
    for title in ("best fit at", "+-", "would have seen"):
        table.add_column(title, justify="right")
    for axis in pair.drift.axes:
        scale, unit, digits = (1.0, "deg", 2) if axis.is_rotation else (1000.0, "mm", 0)
        figures = [
            f"{scale * value:{sign}.{digits}f} {unit}"
            for value, sign in ((axis.change, "+"), (axis.sigma, ""), (axis.smallest, ""))
        ]
        if not pair.drift.curves:
            figures = ["-", "-", "-"]
        table.add_row(motion_words(axis.axis), _STATES[axis.state], *figures)
    return table


def _summary(pair: "PairDrift") -> list[str]:
    from lce_rig.words import as_line, describe

    seen = f"{show.counted(pair.drift.n_captures, 'capture')}, {pair.drift.n_edges} edges"
    told = [f for f in pair.drift.findings if f.code != "scene.axis_unchanged"]
    return [seen, *(show.escape(as_line(describe(finding))) for finding in told)]
