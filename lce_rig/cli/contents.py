"""`lce-rig captures` and `lce-rig results`: the captures and the results that a session holds."""

import math
from collections.abc import Sequence
from datetime import datetime
from itertools import groupby
from pathlib import Path
from typing import Any

import click

import lce_rig as lce
from lce_rig.cli import show
from lce_rig.cli.options import json_option, path_option, session_argument
from lce_rig.core.calibration import Calibration
from lce_rig.core.errors import SessionError, UsageError
from lce_rig.pipeline.result_files import CURRENT, StoredResult, stored_results
from lce_rig.session import Session


@click.command()
@session_argument
@click.option("--reject", metavar="NAMES", multiple=True, help="Reject these captures, separated by commas.")
@click.option(
    "--restore", metavar="NAMES", multiple=True, help="Restore these captures, separated by commas."
)
@path_option(
    "--add",
    "OTHER_SESSION",
    "Copy the captures of another session of this rig, if no sensor was moved in between.",
)
@click.option("--reason", metavar="TEXT", default="", help="Write this reason into the session's journal.")
@json_option
def captures(
    session: Path,
    reject: tuple[str, ...],
    restore: tuple[str, ...],
    add: Path | None,
    reason: str,
    as_json: bool,
) -> None:
    """List the captures of SESSION (default: session/); reject or restore them by name, or add others.

    A rejected capture moves to SESSION/rejected/ with all its files. No command uses it, and `collect` does
    not take it again from the same recording. Restoring moves it back.
    """
    rejecting, restoring = _names(reject), _names(restore)
    other = None if add is None else lce.Session.open(add)
    is_changed = bool(rejecting or restoring or other)
    with lce.Session.open(session, writable=is_changed) as opened:
        _require_there(opened, rejecting, restoring)
        for name in sorted(rejecting):
            opened.reject(name, reason)
        for name in sorted(restoring):
            opened.restore(name)
        changed = rejecting | restoring | set(opened.add_session(other) if other else ())
        stored = stored_results(opened)
        records = [each for each in _records(opened, stored) if not is_changed or each["name"] in changed]
        outdated = [each.name for each in stored if changed and each.is_outdated]
        n_kept, n_rejected = len(opened.captures), len(opened.rejected)
    if as_json:
        show.print_json({"format_version": 1, "rig": opened.rig.name, "captures": records})
    else:
        show.print_table(_capture_table(records))
        counts = show.counted(n_kept, "capture")
        show.say(counts + (f", {n_rejected} rejected" if n_rejected else ""))
    if outdated:
        names = ", ".join(outdated)
        show.note(f"made from other captures: result {names}. Run `lce-rig calibrate {session}` again")


def put_aside(session: Path, names: Sequence[str], reason: str) -> None:
    """Reject captures by name; those that are rejected already stay so.

    Raises:
        UsageError: a name is not that of a capture. Then none is rejected.
    """
    with lce.Session.open(session, writable=True) as opened:
        names = sorted(set(map(_full, names)) - {capture.name for capture in opened.rejected})
        _require_there(opened, set(names), set())
        for name in names:
            opened.reject(name, reason)


def _names(options: Sequence[str]) -> set[str]:
    """Split the captures' names of all options at commas."""
    return {_full(name.strip()) for option in options for name in option.split(",")}


def _full(name: str) -> str:
    """Return a capture's name with its leading zeros, which may be omitted."""
    return name.zfill(6) if name.isascii() and name.isdigit() else name


def _require_there(session: Session, rejecting: set[str], restoring: set[str]) -> None:
    """Check every name before any capture is moved.

    Raises:
        UsageError: a name is not that of a capture to be rejected or restored, or is given for both.
    """
    kept = {capture.name for capture in session.captures}
    rejected = {capture.name for capture in session.rejected}
    for name, place, state in [
        *((name, kept - rejected, "kept") for name in rejecting),
        *((name, rejected - kept, "rejected") for name in restoring),
    ]:
        if name not in place or (name in rejecting and name in restoring):
            raise UsageError(
                f"{session.path} has no {state} capture {name}",
                f"List them with: lce-rig captures {session.path}",
            )


def _records(session: Session, stored: Sequence[StoredResult]) -> list[dict[str, Any]]:
    # The cameras whose current result used each capture.
    used: dict[str, list[str]] = {}
    for result in stored:
        for calibration in result.file.pairs if result.name == CURRENT and result.file else ():
            for name in calibration.captures_used:
                used.setdefault(name, []).append(calibration.camera)
    states = [(each, "kept") for each in session.captures] + [(each, "rejected") for each in session.rejected]
    records = []
    for capture, state in sorted(states, key=lambda item: int(item[0].name)):
        record = {"name": capture.name, "state": state, "used_by": used.get(capture.name, [])}
        try:
            source = capture.meta.get("source")
            streams = [".".join(key) for key in capture.image_keys]
            streams += [f"{camera}.events" for camera in capture.event_cameras] + capture.lidars
            label = str(source.get("label", "")) if isinstance(source, dict) else ""
            records.append({**record, "streams": streams, "source": label, "damage": None})
        except SessionError as error:
            records.append({**record, "streams": [], "source": "", "damage": error.what})
    return records


def _capture_table(records: list[dict[str, Any]]) -> Any:
    """List captures, those in succession that differ by their name alone in one row."""
    table = show.plain_table("", "capture", "data", "source", "used by", "")
    for _, alike in groupby(records, lambda record: [record[key] for key in record if key != "name"]):
        record, *others = alike
        state = "[red]rejected[/]" if record["state"] == "rejected" else ""
        table.add_row(
            show.name_ranges([each["name"] for each in (record, *others)]),
            show.escape(", ".join(record["streams"])) or "[red]damaged[/]",
            show.escape(record["damage"] or record["source"]),
            show.escape(", ".join(record["used_by"])) or "-",
            state,
        )
    return table


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
