"""`lce-rig view`: the coloured cloud and the cameras of a result in 3D."""

from pathlib import Path

import click

import lce_rig as lce
from lce_rig.cli import show
from lce_rig.cli.options import session_argument
from lce_rig.pipeline.result_files import RESULT, result_folder
from lce_rig.show.overlays.view_3d import CameraIn3D, CaptureIn3D, draw_picture, show_window


@click.command()
@session_argument
@click.option("--name", metavar="NAME", help="View this result of SESSION (see `lce-rig results`).")
@click.option(
    "--capture", metavar="NAME", help="Begin with this capture, such as 000003 [default: the first]."
)
@click.option(
    "-o",
    "--output",
    type=click.Path(path_type=Path, dir_okay=False),
    metavar="PNG",
    help="Write a picture in place of opening a window; needs no display.",
)
def view(session: Path, name: str | None, capture: str | None, output: Path | None) -> None:
    """Show the point cloud of SESSION (default: session/) in the colours of its cameras.

    The cameras' fields of view are drawn, too. Where extrinsics are wrong, edges of things have the colours
    of what is behind them. Drag to turn, scroll to zoom; N and P change to the next and the previous capture.
    Points that no camera sees are grey.

    Exits with 5 where there is no display, or Open3D cannot open a window.
    """
    opened = lce.Session.open(session)
    pairs = lce.read_result(result_folder(opened.path, name) / RESULT).pairs
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
