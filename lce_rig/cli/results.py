"""`lce-rig results`: list the results of a session with figures and verdicts."""

import math
from datetime import datetime
from pathlib import Path
from typing import Any

import click

import lce_rig as lce
from lce_rig.cli import show
from lce_rig.cli.options import json_option, session_argument
from lce_rig.core.calibration import Calibration
from lce_rig.pipeline.result_files import StoredResult, stored_results

# Short, so that the table fits into 80 columns.
_SCENE = {"agrees": "agrees", "contradicts": "[red]differs[/]", "unknown": "?"}


@click.command()
@session_argument
@json_option
def results(session: Path, as_json: bool) -> None:
    """List the results of SESSION (default: session/): the current one, the previous one and named ones.

    `lce-rig calibrate --name NAME` adds a named result, `lce-rig repeat SESSION` compares them.
    """
    opened = lce.Session.open(session)
    stored = stored_results(opened)
    if as_json:
        document = [
            {
                "name": result.name,
                "file": str((result.folder / "result.json").relative_to(opened.path)),
                "written_s": result.written_s,
                "is_outdated": result.is_outdated,
                "problem": result.problem or None,
                "date": None if result.file is None else result.file.provenance.date,
                "imported": None if result.file is None else result.file.provenance.imported,
                "pairs": [] if result.file is None else [_pair(c) for c in result.file.pairs],
            }
            for result in stored
        ]
        show.print_json({"format_version": 1, "rig": opened.rig.name, "results": document})
        return
    for table in _tables(stored):
        show.print_table(table)
    if not stored:
        show.say(f"no results in {session}: run `lce-rig calibrate {session}`")
    dates = {result.file.provenance.date_words: None for result in stored if result.file}
    if any(dates):
        show.note(f"captures of {'; '.join(filter(None, dates))}")
    for result in stored:
        if result.problem:
            show.warn(result.problem)
        elif result.is_outdated:
            show.note(f"{result.name}: the profile or the captures that it used have changed since")


def _tables(stored: list[StoredResult]) -> list[Any]:
    """List results by camera and LiDAR, a table each, and those that cannot be read."""
    tables: dict[str, Any] = {}
    for result in stored:
        written = datetime.fromtimestamp(result.written_s).strftime("%Y-%m-%d %H:%M")
        name = show.escape(result.name)
        if result.file is None:
            tables.setdefault("", show.plain_table("", "result", "")).add_row(name, "[red]unreadable[/]")
            continue
        for c in result.file.pairs:
            sensors = f"{c.camera} and {c.lidar}"
            if sensors not in tables:
                tables[sensors] = show.plain_table(show.escape(sensors), "result", "method", "channels")
                for heading in ("used", "deg", "mm", "px"):
                    tables[sensors].add_column(heading, justify="right")
                for heading in ("verdict", "scene", "written"):
                    tables[sensors].add_column(heading)
            px = c.metrics.reprojection_px
            tables[sensors].add_row(
                name,
                c.method,
                show.escape("+".join(c.channels)),
                f"{len(c.captures_used)}",
                f"{c.sigma_rotation_deg:.3f}",
                f"{1000 * c.sigma_translation_m:.1f}",
                f"{px:.2f}" if math.isfinite(px) else "-",
                f"[{show.COLOURS[c.verdict]}]{c.verdict}[/]",
                "-" if c.scene is None else _SCENE[c.scene.state],
                written,
            )
    return list(tables.values())


def _pair(c: Calibration) -> dict[str, Any]:
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
