"""`lce-rig captures`: list the captures of a session, reject or restore them."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import click

import lce_rig as lce
from lce_rig.cli import show
from lce_rig.cli.options import json_option, session_argument
from lce_rig.core.errors import SessionError, UsageError
from lce_rig.pipeline.result_files import CURRENT, StoredResult, stored_results
from lce_rig.session import Session


@click.command()
@session_argument
@click.option("--reject", metavar="NAMES", multiple=True, help="Reject these captures, separated by commas.")
@click.option(
    "--restore", metavar="NAMES", multiple=True, help="Restore these captures, separated by commas."
)
@click.option(
    "--add",
    type=click.Path(path_type=Path),
    metavar="OTHER_SESSION",
    help="Copy the captures of another session of this rig, if no sensor was moved in between.",
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
        show.print_table(_table(records))
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


def _table(records: list[dict[str, Any]]) -> Any:
    table = show.plain_table("", "capture", "data", "source", "used by", "")
    for record in records:
        state = "[red]rejected[/]" if record["state"] == "rejected" else ""
        table.add_row(
            record["name"],
            show.escape(", ".join(record["streams"])) or "[red]damaged[/]",
            show.escape(record["damage"] or record["source"]),
            show.escape(", ".join(record["used_by"])) or "-",
            state,
        )
    return table
