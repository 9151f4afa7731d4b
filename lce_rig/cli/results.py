"""`lce-rig results`: list the results of a session with figures and verdicts."""

import math
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from lce_rig.cli import show
from lce_rig.cli.options import json_option, session_argument

if TYPE_CHECKING:
    from lce_rig.core.calibration import Calibration
    from lce_rig.pipeline.result_files import StoredResult


@click.command()
@session_argument
@json_option
def results(session: Path, as_json: bool) -> None:
    """List the results of SESSION (default: session/): the current one, the previous one and named ones.

    `lce-rig calibrate --name NAME` adds a named result, `lce-rig repeat SESSION` compares them.
    """
    import lce_rig as lce
    from lce_rig.pipeline.result_files import stored_results

    opened = lce.Session.open(session)
    stored = stored_results(opened)
    if as_json:
        document = [_document(each, opened.path) for each in stored]
        show.print_json({"format_version": 1, "rig": opened.rig.name, "results": document})
        return
    if stored:
        for table in _tables(stored):
            show.print_table(table)
    else:
        show.say(f"no results in {session}: run `lce-rig calibrate`")
    for each in stored:
        if each.problem:
            show.warn(each.problem)
        elif each.is_outdated:
            show.note(f"{each.name}: the profile or the captures that it used have changed since")


def _tables(stored: list["StoredResult"]) -> list[Any]:
    """List results by camera and LiDAR, a table each, and those that cannot be read."""
    tables: dict[str, Any] = {}
    for each in stored:
        written = datetime.fromtimestamp(each.written_s).strftime("%Y-%m-%d %H:%M")
        name = show.escape(each.name)
        for calibration in () if each.file is None else each.file.pairs:
            sensors = f"{calibration.camera} and {calibration.lidar}"
            table = tables.setdefault(sensors, _empty_table(show.escape(sensors)))
            table.add_row(name, *_cells(calibration), written)
        if each.file is None:
            tables.setdefault("", show.plain_table("", "result", "")).add_row(name, "[red]unreadable[/]")
    return list(tables.values())


def _empty_table(title: str) -> Any:
    table = show.plain_table(title, "result", "method", "channels")
    for heading in ("used", "deg", "mm", "px"):
        table.add_column(heading, justify="right")
    table.add_column("verdict")
    table.add_column("scene")
    table.add_column("written")
    return table


# Short, so that the table fits into 80 columns.
_SCENE = {"agrees": "agrees", "contradicts": "[red]differs[/]", "unknown": "?"}


def _cells(c: "Calibration") -> list[str]:
    px = c.metrics.reprojection_px
    return [
        c.method,
        show.escape("+".join(c.channels)),
        f"{len(c.captures_used)}",
        f"{c.sigma_rotation_deg:.3f}",
        f"{1000 * c.sigma_translation_m:.1f}",
        f"{px:.2f}" if math.isfinite(px) else "-",
        f"[{show.COLOURS[c.verdict]}]{c.verdict}[/]",
        "-" if c.scene is None else _SCENE[c.scene.state],
    ]


def _document(stored: "StoredResult", session: Path) -> dict[str, Any]:
    return {
        "name": stored.name,
        "file": str((stored.folder / "result.json").relative_to(session)),
        "written_s": stored.written_s,
        "is_outdated": stored.is_outdated,
        "problem": stored.problem or None,
        "pairs": [] if stored.file is None else [_pair(each) for each in stored.file.pairs],
    }


def _pair(c: "Calibration") -> dict[str, Any]:
    px = c.metrics.reprojection_px
    return {
        "camera": c.camera,
        "lidar": c.lidar,
        "method": c.method,
        "channels": list(c.channels),
        "n_captures_used": len(c.captures_used),
        "sigma_rotation_deg": c.sigma_rotation_deg,
        "sigma_translation_m": c.sigma_translation_m,
        "reprojection_px": px if math.isfinite(px) else None,
        "verdict": c.verdict,
        "scene": None if c.scene is None else c.scene.state,
    }
