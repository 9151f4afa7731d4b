"""`lce-rig check`: what was seen in every capture, and where one is refused, why and what to do."""

from collections import Counter
from pathlib import Path
from typing import Any

import click

from lce_rig.cli import show
from lce_rig.core.results import ImageBoard, LidarBoard, Refusal
from lce_rig.detect.detection import Detections, Pair


@click.command()
@click.argument("session", type=click.Path(path_type=Path), default="session")
@click.option("--json", "as_json", is_flag=True, help="Print every figure as JSON.")
@click.option("--debug-images", is_flag=True, help="Write one picture a capture into SESSION/debug/.")
def check(session: Path, as_json: bool, debug_images: bool) -> None:
    """Show what was detected in each capture of SESSION (default: session/), and why not.

    Exits with 6 where no capture can be used.
    """
    from lce_rig import pipeline
    from lce_rig.core.errors import NotEnoughDataError
    from lce_rig.session import Session

    opened = Session.open(session)
    with show.progress_bar("detecting") as progress:
        detections = pipeline.detect(opened, progress=progress)
    if debug_images:
        with show.progress_bar("drawing") as progress:
            folder = pipeline.write_debug_images(opened, detections, progress=progress)
        show.note(f"pictures of every capture: {folder}")
    if as_json:
        show.print_json({"format_version": 1, "rig": opened.rig.name, "pairs": _document(detections)})
    else:
        for pair in detections.pairs:
            show.print_table(_table(detections, pair))
            _summarise(detections, pair)
    if not any(_is_usable(*detections.of(pair, name)) for pair in detections.pairs for name in detections.captures(pair)):
        raise NotEnoughDataError(
            f"{session}: the board was found by both sensors in no capture",
            "See the causes above; --debug-images draws what was seen.",
        )


def _is_usable(image: object, lidar: object) -> bool:
    return isinstance(image, ImageBoard) and isinstance(lidar, list)


def _document(detections: Detections) -> list[dict[str, Any]]:
    return [
        {
            "camera": pair.camera,
            "channel": pair.channel,
            "lidar": pair.lidar,
            "captures": {name: _record(*detections.of(pair, name)) for name in detections.captures(pair)},
        }
        for pair in detections.pairs
    ]


def _record(image: ImageBoard | Refusal, lidar: list[LidarBoard] | Refusal) -> dict[str, Any]:
    record: dict[str, Any] = {"is_usable": _is_usable(image, lidar), "refusals": []}
    for name, found in (("image", image), ("lidar", lidar)):
        if isinstance(found, Refusal):
            record["refusals"].append({"stage": found.stage, "cause": found.cause, "action": found.action})
            record[name] = None
        else:
            best = found[0] if isinstance(found, list) else found
            record[name] = {key: float(value) for key, value in best.quality.items()}
    if isinstance(lidar, list) and record["lidar"] is not None:
        record["lidar"]["n_candidates"] = len(lidar)
    return record


_COLUMNS = (
    ("m", "image", "distance_m", "{:.2f}"),
    ("tilt°", "image", "tilt_deg", "{:.0f}"),
    ("corner px", "image", "corner_rms_px", "{:.2f}"),
    ("sharp", "image", "sharpness", "{:.1f}"),
    ("rings", "lidar", "n_rings", "{:.0f}"),
    ("points", "lidar", "n_points", "{:.0f}"),
    ("thick mm", "lidar", "thickness_m", "{:.1f}"),
    ("width m", "lidar", "width_m", "{:.3f}"),
    ("height m", "lidar", "height_m", "{:.3f}"),
    ("ends mm", "lidar", "edge_rms_m", "{:.1f}"),
)


def _table(detections: Detections, pair: Pair) -> Any:
    from rich.table import Table

    table = Table(title=str(pair), title_justify="left", pad_edge=False, box=None, header_style="bold")
    table.add_column("capture")
    for title, *_ in _COLUMNS:
        table.add_column(title, justify="right")
    table.add_column("")
    for name in detections.captures(pair):
        image, lidar = detections.of(pair, name)
        record = _record(image, lidar)
        cells = [_cell(record[sensor], key, form) for _, sensor, key, form in _COLUMNS]
        refusals = [found for found in (image, lidar) if isinstance(found, Refusal)]
        text = "\n".join(f"[red]{r.stage}: {r.cause}[/]\n[dim]→ {r.action}[/]" for r in refusals)
        if not refusals and isinstance(lidar, list) and len(lidar) > 1:
            text = f"[yellow]{len(lidar)} surfaces of the board's size[/]"
        table.add_row(name, *cells, text or "[green]ok[/]")
    return table


def _cell(figures: dict[str, float] | None, key: str, form: str) -> str:
    if figures is None or key not in figures:
        return "[red]-[/]" if figures is None else ""
    return form.format(figures[key] * (1000 if "mm" in _title(key) else 1))


def _title(key: str) -> str:
    return next(title for title, _, name, _ in _COLUMNS if name == key)


def _summarise(detections: Detections, pair: Pair) -> None:
    seen = [detections.of(pair, name) for name in detections.captures(pair)]
    usable = sum(_is_usable(*both) for both in seen)
    show.note(f"{usable} of {len(seen)} captures show the board to both sensors")
    causes = Counter(found.stage for both in seen for found in both if isinstance(found, Refusal))
    if causes:
        show.note("refused: " + ", ".join(f"{count} by the {stage} stage" for stage, count in sorted(causes.items())))
