"""`lce-rig rigs`: list, show, check and derive rig profiles; `lce-rig board`: draw a board to print."""

import re
from pathlib import Path

import click
import numpy as np

from lce_rig.cli import show
from lce_rig.core.board import Board, BoardType
from lce_rig.core.errors import ProfileError, TargetError, UsageError
from lce_rig.core.pattern import DICTIONARIES, dark_rectangles, n_markers_of
from lce_rig.io import recognise
from lce_rig.pipeline.new_profile import BOARD_FORM, parse_board, parse_intrinsics
from lce_rig.pipeline.new_profile import new_profile as draft
from lce_rig.rig import (
    Rig,
    as_yaml,
    derive_text,
    dump_rig,
    edit_text,
    find_profile,
    load_rig,
    read_profile,
    shipped_profiles,
)
from lce_rig.rig.board_settings import KEYS_OF_TYPE, board_block
from lce_rig.rig.loading import board_of, dump_yaml
from lce_rig.session.durable import replace_file


@click.group(invoke_without_command=True)
@click.pass_context
def rigs(ctx: click.Context) -> None:
    """List, show, check and derive rig profiles (default: list)."""
    if ctx.invoked_subcommand is None:
        ctx.invoke(list_profiles)


@rigs.command("list")
def list_profiles() -> None:
    """List the shipped profiles."""
    rows = []
    for rig in map(load_rig, shipped_profiles()):
        board = rig.board.to_board()
        pattern = f"{board.cols}x{board.rows} corners, {1e3 * board.square_m:g} mm"
        rows.append((rig.name, pattern, rig.description))
    show.print_table(show.plain_table("", "rig", "board", "description", rows=rows))
    show.note("for your own rig: lce-rig rigs new NAME --from rlfs, then --rig NAME.yaml")


@rigs.command("show")
@click.argument("rig_name", metavar="RIG")
@click.option("--all", "is_whole", is_flag=True, help="Print settings that have their default, too.")
@click.option("--json", "as_json", is_flag=True, help="Print every setting as JSON.")
def show_profile(rig_name: str, is_whole: bool, as_json: bool) -> None:
    """Print the profile RIG, a name or a file, as YAML without settings at their default."""
    rig = load_rig(rig_name)
    if as_json:
        show.print_json(rig.model_dump(mode="json"))
        return
    click.echo(dump_rig(rig, is_whole=is_whole), nl=False)
    show.warn_of(rig.warnings())


@rigs.command("check")
@click.argument("file", metavar="FILE")
def check_profile(file: str) -> None:
    """Check the profile FILE and list every problem with its line. Exits with 3 if there is one."""
    rig = load_rig(file)
    click.echo(f"{find_profile(file)}: a valid profile of rig {rig.name}")
    show.warn_of(rig.warnings())


@rigs.command("new")
@click.argument("name")
@click.option(
    "--from",
    "origin",
    metavar="RIG|RECORDING",
    help="Profile to derive from, or a bag of the rig, or a folder with images and point clouds "
    "[default: rlfs, unless a sensor is given].",
)
@click.option(
    "--lidar",
    metavar="MODEL",
    help="Model of the LiDAR, such as OS1-64; other: its rings are read from the recording.",
)
@click.option("--camera", "cameras", multiple=True, metavar="NAME", help="Name of a camera; may be repeated.")
@click.option(
    "--intrinsics",
    multiple=True,
    metavar="FILE|NUMBERS",
    help="Intrinsics of each camera, in order: a file (ROS camera_info, ost.txt, Kalibr's camchain, OpenCV's "
    "FileStorage, FAST-LIVO2's camera), or MODEL,WIDTHxHEIGHT,FX,FY,CX,CY,K1,...",
)
@click.option(
    "--board",
    metavar="[TYPE:]COLSxROWS,SQUARE,...,WIDTHxHEIGHT[,RIGHT,UP]",
    help="Inner corners, square and plate in m, and how far the pattern is off the plate's centre; also "
    "charuco:9x7,0.07,0.0525,5X5_50,... (squares, marker, dictionary) and aprilgrid:4x3,0.13,0.3,... (tags, "
    "tagSize, tagSpacing).",
)
@click.option(
    "--set",
    "settings",
    multiple=True,
    metavar="KEY=VALUE",
    help="Set a key, as board.square_m=0.08; may be repeated.",
)
@click.option("-o", "--output", help="File to write, - for stdout [default: NAME.yaml].")
def new_profile(
    name: str,
    origin: str | None,
    lidar: str | None,
    cameras: tuple[str, ...],
    intrinsics: tuple[str, ...],
    board: str | None,
    settings: tuple[str, ...],
    output: str | None,
) -> None:
    """Write a profile NAME for your own sensors, from their bag or from another profile.

    \b
      lce-rig rigs new truck --lidar OS1-64 --camera front --intrinsics camera_info.yaml \\
                             --board 8x6,0.07,0.767x0.626
      lce-rig rigs new truck --from drive.bag --lidar OS1-64 --board 8x6,0.07,0.767x0.626
      lce-rig rigs new mine --from rlfs --set board.square_m=0.08 --set nominal_extrinsics=[]
    """
    stem = name.removesuffix(".yaml").removesuffix(".yml")
    if stem != name:
        raise UsageError(
            f"{name} is a file, not the name of a rig", f"Write: lce-rig rigs new {stem} -o {name}"
        )
    values = []
    for setting in settings:
        key, equals, value = setting.partition("=")
        if not (key and equals and value):
            raise UsageError(f"--set {setting}: KEY=VALUE is expected, such as board.square_m=0.08")
        values.append((key.strip(), value.strip()))
    path = Path(output or f"{name}.yaml")
    target = f"{name if output == '-' else path} (not written)"
    has_sensors = bool(lidar or cameras or intrinsics)
    recording = _find_recording(origin)
    if recording is not None or (origin is None and has_sensors):
        if board is None:
            raise UsageError("the board is missing", f"Measure it, and add --board {BOARD_FORM}")
        lenses = [parse_intrinsics(each) for each in intrinsics]
        text, lines = draft(
            name,
            parse_board(board),
            recording=recording,
            lidar_model=lidar,
            cameras=cameras,
            intrinsics=lenses,
            source=target,
        )
        for line in lines:
            show.note(line)
        text = edit_text(text, values, target)
    else:
        origin = origin or "rlfs"
        parent = load_rig(origin)
        if has_sensors:
            raise UsageError(
                "--lidar, --camera and --intrinsics apply to recordings and numbers, not to a profile",
                "Set keys of the profile: --set lidars.lidar.model=OS1-64",
            )
        values = [*(_board_settings(parent, board) if board is not None else []), *values]
        original = read_profile(find_profile(origin))
        text = derive_text(original, name, values, target, parent.name)
    if output == "-":
        click.echo(text, nl=False)
        return
    try:
        if path.exists():
            raise ProfileError(f"{path}: exists already", "Choose another file with -o, or remove it first.")
        replace_file(path, text.encode())
    except OSError as error:
        raise ProfileError(f"{path}: cannot be written: {error.strerror}") from error
    show.note(f"wrote {path}; compare it with your rig, then: lce-rig rigs check {path}")
    if name in shipped_profiles():
        show.warn(f"--rig {name} is the shipped profile: use --rig {path}")
    show.warn_of(load_rig(path).warnings())


def _find_recording(origin: str | None) -> Path | None:
    """Return the path of a recording; None for a profile's name or file.

    Raises:
        SourceError: the path is none of these, or does not exist.
    """
    if origin is None or (not Path(origin).is_dir() and Path(origin).suffix.lower() in ("", ".yaml", ".yml")):
        return None
    recognise(Path(origin))
    return Path(origin)


def _board_settings(parent: Rig, board: str) -> list[tuple[str, str]]:
    """Return the keys of the parent profile that --board changes."""
    stated = parent.board.model_dump(exclude_none=True, exclude_unset=True)
    plate = {"type": "checkerboard"} | board_block(parse_board(board))
    foreign = [key for key in stated if key not in plate and not key.endswith("sigma_m")]
    return [(f"board.{key}", as_yaml(plate.get(key))) for key in (*plate, *foreign)]


_SIZE = re.compile(r"(\d+)x(\d+)")
_PLATE = re.compile(r"(\d+(?:\.\d*)?|\.\d+)x(\d+(?:\.\d*)?|\.\d+)")
# Space around the plate on the page, for the profile block and mounting instructions below it, mm.
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
        # Pick the family's smallest dictionary with at least n markers, else its largest.
        family = "5X5"
        n_markers = cols * rows // 2
        names = [name for name in DICTIONARIES if name.startswith(f"{family}_")]
        more = {
            "marker_m": round(0.75 * square_m, 6),
            "dictionary": next((name for name in names if n_markers_of(name) >= n_markers), names[-1]),
        }
    elif kind == "aprilgrid":
        more = {"tag_spacing": 0.3}  # as Kalibr's example
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
        _draw_board(drawn, block, output)
    except OSError as error:
        raise TargetError(f"{output}: cannot be written: {error.strerror}") from error
    click.echo(block, nl=False)
    show.note(
        f"wrote {output}: print it at 100 %, mount it, measure it, and paste the block into the profile"
    )


def _draw_board(board: Board, block: str, output: str) -> None:
    """Draw the pattern, the plate's outline and the text on a page of matching size."""
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
