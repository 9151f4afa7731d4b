"""`lce-rig verify` projects the point clouds into the images, `lce-rig view` shows them in 3D."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import click

import lce_rig as lce
from lce_rig.cli import show
from lce_rig.cli.calibrate import exit_by_verdict, residual_words
from lce_rig.cli.options import explain_option, json_option, path_option, result_option, session_argument
from lce_rig.core.errors import ResultRefusedError, UsageError
from lce_rig.core.findings import worst
from lce_rig.detect.detection import Pair
from lce_rig.judge.findings import causes_of
from lce_rig.judge.session_check import SessionCheck
from lce_rig.pipeline.result_files import RESULT, result_folder, with_profile_of
from lce_rig.pipeline.verification import profile_behind
from lce_rig.show.overlays.view_3d import CameraIn3D, CaptureIn3D, draw_picture, show_window
from lce_rig.show.tables import scene_words


@click.command()
@session_argument
@path_option("--result", "FILE", "Check the result.json of another session of this rig on these captures.")
@result_option("Check")
@path_option("-o", "--output", "FOLDER", "Write the images into this folder.")
@explain_option
@json_option
def verify(
    session: Path,
    result: Path | None,
    name: str | None,
    output: Path | None,
    explain: bool,
    as_json: bool,
) -> None:
    """Project the point clouds of SESSION (default: session/) into the images and print residuals.

    The images, and a page that shows them, replace those in SESSION/calibration/overlays/, with --result FILE
    those in SESSION/overlays/, with --name NAME those beside that result. Exits with 7 if the verdict is fail
    or these captures contradict the extrinsics.
    """
    if result is not None and name is not None:
        raise UsageError("--result and --name exclude each other", "Name a file or a result of the session.")
    opened = lce.Session.open(session)
    saved = None if result is None else lce.read_result(result)
    profile = None if result is None or saved is None else profile_behind(result, saved)
    with show.progress_bar("detecting") as progress:
        verification = lce.verify(opened, saved, name=name, profile=profile, progress=progress)
    show.warn_of(verification.notes)
    with show.progress_bar("drawing") as progress:
        checks = verification.write(output, progress=progress)
    document = {
        "format_version": 2,
        "rig": opened.rig.name,
        "pairs": [c.document() for c in checks],
        "findings": verification.notes,
    }
    if as_json:
        show.print_json(document)
    else:
        for checked in checks:
            show.print_parts(_parts(checked, str(session), is_explained=explain))
        if explain:
            show.print_figures(document)
    for c in verification.unchecked:
        show.warn(f"{session} holds no captures of {Pair.of(c)}: not checked")
    exit_by_verdict(verification.calibrations, are_printed=not as_json)
    contradicted = [checked for checked in checks if worst(checked.findings) == "error"]
    if contradicted:
        causes = [f"{checked.pair}: {doubt.text}" for checked in contradicted for doubt in checked.findings]
        raise ResultRefusedError(
            f"the captures of {session} contradict the extrinsics of "
            + " and that of ".join(str(checked.pair) for checked in contradicted),
            "\n".join(causes) if as_json else "",
        )


def _parts(checked: SessionCheck, session: str, *, is_explained: bool) -> Iterator[Any]:
    """State whether the captures agree with the extrinsics, the mean residuals and the images' folder."""
    c, doubts, pair = checked.calibration, checked.findings, str(checked.pair)
    colour = {"note": "green", "warning": "yellow", "error": "red"}[worst(doubts)]
    opinion = {"note": "agree with", "warning": "fit poorly", "error": "contradict"}[worst(doubts)]
    of_result = show.COLOURS[c.verdict]
    verdict = "" if c.verdict == "pass" else f", [{of_result}]whose verdict is {c.verdict.upper()}[/]"
    yield f"[bold]{pair}[/]: [{colour}]the captures {opinion} the extrinsics[/]{verdict}"
    causes = [] if c.verdict == "pass" else causes_of(c.findings)
    for each, tint in (
        *((doubt, colour) for doubt in doubts),
        *((cause, of_result) for cause in (causes if is_explained else causes[:1])),
    ):
        yield from show.cause_lines(each.text, each.advice_at(session), tint)
    if checked.metrics is not None:
        yield f"  residuals    {residual_words(checked.metrics, c)} (means)"
    if checked.scene.state != "unknown" or is_explained:
        yield f"  scene        {scene_words(checked.scene)}"
    if checked.page is not None:
        yield f"  images       {show.escape(str(checked.page))}"


@click.command()
@session_argument
@result_option("View")
@click.option(
    "--capture", metavar="NAME", help="Begin with this capture, such as 000003 [default: the first]."
)
@path_option(
    "-o", "--output", "PNG", "Write an image instead of opening a window; needs no display.", is_file=True
)
def view(session: Path, name: str | None, capture: str | None, output: Path | None) -> None:
    """Show the point cloud of SESSION (default: session/) in the colours of its cameras.

    With wrong extrinsics, edges of objects have the colours of their background. Points that no camera sees
    are grey. Drag to rotate, scroll to zoom; N and P change to the next and the previous capture.

    Exits with 5 without a display, or if Open3D cannot open a window.
    """
    opened = with_profile_of(lce.Session.open(session), name)
    pairs = lce.read_result(result_folder(opened.path, name) / RESULT).pairs
    pairs = tuple(c for c in pairs if not c.is_of_peers)
    if not pairs:
        raise UsageError("the result has no camera whose colours could be shown", "Look at `lce-rig verify`.")
    # Cameras that share the first one's LiDAR.
    calibrations = [c for c in pairs if c.lidar == pairs[0].lidar]
    cameras = [CameraIn3D(opened.rig.lens_of(c), c.T_cam_lidar) for c in calibrations]
    captures = [each for each in opened.captures if calibrations[0].lidar in each.lidars]
    first = 0 if capture is None else captures.index(opened.capture(capture))
    if output is not None:
        draw_picture(output, CaptureIn3D.of(opened, captures[first], calibrations), cameras)
        show.note(f"written: {output}")
        return
    shown = [CaptureIn3D.of(opened, each, calibrations) for each in captures]
    show_window(shown, cameras, first)
