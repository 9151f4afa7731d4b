"""`lce-rig export`: write a result for other programs, and into a robot's own URDF."""

from datetime import datetime
from pathlib import Path

import click

import lce_rig as lce
from lce_rig.cli import show
from lce_rig.cli.options import names_option, path_option, result_option, session_argument
from lce_rig.core.errors import UsageError
from lce_rig.core.findings import Finding
from lce_rig.export import EXPORTS, USUAL, load_exporter, require_usable
from lce_rig.export.urdf import read_robot, write_into_urdf
from lce_rig.pipeline.result_files import RESULT, result_folder, with_profile_of


def _list_formats(context: click.Context, _param: click.Parameter, is_asked: bool) -> None:
    """Print the formats with their files and end."""
    if is_asked and not context.resilient_parsing:
        for name in EXPORTS:
            files = (load_exporter(name).__doc__ or "").partition("\n")[0].removeprefix("Write ")
            show.say(f"{name + (' *' if name in USUAL else ''):<16} {files}")
        show.note("* unless others are named with --formats or as `exports` in the profile")
        context.exit()


@click.command()
@session_argument
@result_option("Export")
@names_option(
    "--formats",
    "Write only these formats, separated by commas [default: the profile's `exports`, else those marked "
    "in --list].",
    "LIST",
)
@click.option(
    "--list",
    is_flag=True,
    is_eager=True,
    expose_value=False,
    callback=_list_formats,
    help="List the formats and their files, and exit.",
)
@path_option(
    "--tree",
    "FILE",
    "Fit the files into the robot's tree of frames: its URDF, or a recording with /tf_static (ROS 1, "
    "ROS 2, mcap).",
)
@path_option(
    "--into",
    "URDF",
    "Set the sensors' joints in this URDF of the robot instead of writing files; its earlier text "
    "stays beside it.",
)
@path_option(
    "-o",
    "--output",
    "FOLDER",
    "Write the files into this folder; those of an earlier export there are removed.",
)
@click.option("--force", is_flag=True, help="Export a failed result, too.")
def export(
    session: Path,
    name: str | None,
    formats: list[str] | None,
    tree: Path | None,
    into: Path | None,
    output: Path | None,
    force: bool,
) -> None:
    """Write the result of SESSION (default: session/) for other programs.

    `calibrate` has written the usual formats already. With --tree or --into, the sensor nearest to the root
    of the robot's tree keeps its pose; the poses of the others change, and missing ones are added.
    """
    if str(session) in EXPORTS and not session.exists():
        raise UsageError(
            f"{session} is a format, not a session", f"Write: lce-rig export --formats {session} -o FOLDER"
        )
    if (into is None) == (output is None):
        raise UsageError(
            "neither --output nor --into is given"
            if into is None
            else "--output and --into exclude each other",
            "Give --output FOLDER for files, or --into URDF for the robot's own.",
        )
    if into is not None and (formats or tree) is not None:
        raise UsageError("--formats and --tree apply to --output only", "Omit them, or omit --into.")
    opened = with_profile_of(lce.Session.open(session), name)
    pairs = lce.read_result(result_folder(opened.path, name) / RESULT).pairs
    if output is not None:
        robot = None if tree is None else read_robot(tree)
        output.mkdir(parents=True, exist_ok=True)
        findings: list[Finding] = []
        earlier = {path.name for path in output.iterdir()}
        files = lce.write_exports(
            pairs,
            opened.rig,
            output,
            formats=formats,
            is_forced=force,
            session=opened,
            robot=robot,
            findings=findings,
        )
        for file in files:
            show.say(f"{file} (replaced)" if file.name in earlier else str(file))
        for finding in findings:
            advice = finding.advice_at(str(session))
            (show.note if finding.severity == "note" else show.warn)(f"{finding.text}: {advice}".rstrip(": "))
        return

    assert into is not None
    require_usable(pairs, is_forced=force)
    backup, changes = write_into_urdf(into, pairs, opened.rig, datetime.now())
    for change in changes:
        done = "added"
        if change.moved is not None:
            angle_deg, distance_m = change.moved
            done = f"moved by {angle_deg:.2f} deg, {1000 * distance_m:.1f} mm"
        show.say(f"{change.joint.parent} to {change.joint.child}: {done}")
    show.say(f"{into}: nothing to change" if backup is None else f"earlier text: {backup}")
