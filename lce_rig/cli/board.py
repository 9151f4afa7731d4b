"""`lce-rig board`: draw a board to print at scale, with the profile block that describes it."""

import re
from pathlib import Path

import click
import numpy as np

from lce_rig.cli import show
from lce_rig.core.board import Board, BoardType
from lce_rig.core.errors import TargetError, UsageError
from lce_rig.core.pattern import DICTIONARIES, dark_rectangles, n_markers_of
from lce_rig.rig.board_settings import KEYS_OF_TYPE, board_block
from lce_rig.rig.loading import board_of, dump_yaml

_SIZE = re.compile(r"(\d+)x(\d+)")
_PLATE = re.compile(r"(\d+(?:\.\d*)?|\.\d+)x(\d+(?:\.\d*)?|\.\d+)")
_MARKER_SHARE, _TAG_SPACING = 0.75, 0.3
# About the plate on the page; below it stand the profile block and how to mount the board.
_MARGIN_MM, _TEXT_MM, _LINE_MM = 15.0, 75.0, 5.0
_MM_PER_INCH = 25.4
_MOUNTING = (
    "Print at 100 %, matt. Glue it flat onto a stiff plate (aluminium composite, 3 to 6 mm) of this size.",
    "Hold or mount it so that nothing else lies in the plate's plane. Measure all squares or tags together,",
    "and the plate, with a steel rule; correct the profile.",
)


@click.command()
@click.option(
    "--type",
    "kind",
    type=click.Choice([kind for kind, keys in KEYS_OF_TYPE.items() if keys]),
    default="checkerboard",
    show_default=True,
    help="Choose the pattern.",
)
@click.option(
    "--squares",
    required=True,
    metavar="COLSxROWS",
    help="Set the number of squares, or of an aprilgrid's tags.",
)
@click.option(
    "--size", "square_m", type=float, required=True, metavar="M", help="Set the side of a square or tag."
)
@click.option(
    "--plate", metavar="WIDTHxHEIGHT", help="Set the plate's size in m [default: a white margin of a square]."
)
@click.option("-o", "--output", default="board.pdf", show_default=True, help="File to write: PDF or SVG.")
def board(
    kind: BoardType,
    squares: str,
    square_m: float,
    plate: str | None,
    output: str,
) -> None:
    """Draw a board to print at scale, with its plate's outline and profile block.

    \b
      lce-rig board --type charuco --squares 9x7 --size 0.07 -o board.pdf
      lce-rig board --type aprilgrid --squares 4x3 --size 0.13
    """
    counts, outline = _SIZE.fullmatch(squares), _PLATE.fullmatch("0x0" if plate is None else plate)
    if counts is None or outline is None or Path(output).suffix not in (".pdf", ".svg"):
        raise UsageError("give --squares as 9x7, --plate as 0.8x0.6, and an output that ends in .pdf or .svg")
    cols, rows = map(int, counts.groups())
    more: dict[str, object] = {}
    if kind == "charuco":
        # Name the smallest dictionary of a family that has so many markers, or its largest.
        family = "5X5"
        n_markers = cols * rows // 2
        names = [name for name in DICTIONARIES if name.startswith(f"{family}_")]
        more = {
            "marker_m": round(_MARKER_SHARE * square_m, 6),
            "dictionary": next((name for name in names if n_markers_of(name) >= n_markers), names[-1]),
        }
    elif kind == "aprilgrid":
        more = {"tag_spacing": _TAG_SPACING}
    less = 1 if kind == "checkerboard" else 0
    values = {"type": kind, KEYS_OF_TYPE[kind][0]: (cols - less, rows - less), "square_m": square_m, **more}
    width_m, height_m = map(float, outline.groups())
    if plate is None:
        drawn = board_of(values | {"width_m": 5.0, "height_m": 5.0}, "the board")
        margin_m = square_m * (2 * drawn.gap_share if kind == "aprilgrid" else 1)
        width_m, height_m = (round(size + 2 * margin_m + 0.005, 2) for size in drawn.pattern_size_m)
    drawn = board_of(values | {"width_m": width_m, "height_m": height_m}, "the board")
    block = dump_yaml({"board": board_block(drawn)})
    try:
        _draw(drawn, block, output)
    except OSError as error:
        raise TargetError(f"{output}: cannot be written: {error.strerror}") from error
    click.echo(block, nl=False)
    show.note(
        f"wrote {output}: print it at 100 %, mount it, measure it, and paste the block into the profile"
    )


def _draw(board: Board, block: str, output: str) -> None:
    """Draw the print, the plate's outline and the words on a page of its own size."""
    from matplotlib.collections import PatchCollection
    from matplotlib.figure import Figure
    from matplotlib.patches import Rectangle

    width_mm, height_mm = 1e3 * board.width_m, 1e3 * board.height_m
    page_mm = np.array([width_mm + 2 * _MARGIN_MM, height_mm + 2 * _MARGIN_MM + _TEXT_MM])
    figure = Figure(figsize=tuple(page_mm / _MM_PER_INCH))
    axes = figure.add_axes((0, 0, 1, 1))
    axes.set_axis_off()
    left, lower = -width_mm / 2 - _MARGIN_MM, -height_mm / 2 - _MARGIN_MM - _TEXT_MM
    axes.set_xlim(left, left + page_mm[0])
    axes.set_ylim(lower, lower + page_mm[1])
    dark = [Rectangle((x, y), w, h) for x, y, w, h in 1e3 * dark_rectangles(board)]
    axes.add_collection(PatchCollection(dark, facecolors="black", linewidths=0))
    corner = -width_mm / 2, -height_mm / 2
    axes.add_patch(Rectangle(corner, width_mm, height_mm, fill=False, linewidth=0.3, edgecolor="0.5"))
    lines = [
        f"{board.type}, {board.summary}, plate {width_mm:g} x {height_mm:g} mm: cut or glue along the outline"
    ]
    for row, line in enumerate([*lines, *_MOUNTING, *block.splitlines()]):
        at_mm = -height_mm / 2 - (row + 2) * _LINE_MM
        axes.text(-width_mm / 2, at_mm, line, family="monospace", fontsize=8, color="0.3")
    figure.savefig(output)
