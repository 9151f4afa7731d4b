"""`lce-rig captures`, `results` and `repeat`: captures and results of sessions, and their agreement."""

import math
from collections.abc import Iterable, Iterator, Sequence
from datetime import datetime
from itertools import groupby
from pathlib import Path
from typing import Any

import click

import lce_rig as lce
from lce_rig.cli import show
from lce_rig.cli.options import explain_option, json_option, path_option, session_argument
from lce_rig.core.calibration import Calibration
from lce_rig.core.errors import ResultRefusedError, SessionError, UsageError
from lce_rig.core.phrasing import as_line, significant, sizes
from lce_rig.detect.detection import Pair
from lce_rig.judge.repeatability import Repeatability
from lce_rig.pipeline.comparison import compare_results
from lce_rig.pipeline.comparison import repeat as compare
from lce_rig.pipeline.result_files import CURRENT, RESULT, StoredResult, stored_results
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
    rejecting, restoring = (
        _full(name for names in option for name in names.split(",")) for option in (reject, restore)
    )
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
        n_kept, n_rejected = len(opened.captures), len(opened.rejected)
    if as_json:
        show.print_json({"format_version": 1, "rig": opened.rig.name, "captures": records})
    else:
        rows = []
        # Successive captures that differ only in name share a row.
        for _, alike in groupby(records, lambda record: [record[key] for key in record if key != "name"]):
            record, *others = alike
            rows.append(
                (
                    show.name_ranges([each["name"] for each in (record, *others)]),
                    show.escape(", ".join(record["streams"])) or "[red]damaged[/]",
                    show.escape(record["damage"] or record["source"]),
                    show.escape(", ".join(record["used_by"])) or "-",
                    "[red]rejected[/]" if record["state"] == "rejected" else "",
                )
            )
        show.print_table(show.plain_table("", "capture", "data", "source", "used by", "", rows=rows))
        counts = show.counted(n_kept, "capture")
        show.say(counts + (f", {n_rejected} rejected" if n_rejected else ""))
    if outdated := [each.name for each in stored if changed and each.is_outdated]:
        names = ", ".join(outdated)
        show.note(f"made from other captures: result {names}. Run `lce-rig calibrate {session}` again")


def put_aside(session: Path, names: Sequence[str], reason: str) -> None:
    """Reject captures by name; rejected ones stay rejected.

    Raises:
        UsageError: a name is not that of a capture. Then none is rejected.
    """
    with lce.Session.open(session, writable=True) as opened:
        rejecting = _full(names) - {capture.name for capture in opened.rejected}
        _require_there(opened, rejecting, set())
        for name in sorted(rejecting):
            opened.reject(name, reason)


def _full(names: Iterable[str]) -> set[str]:
    """Complete captures' names with their leading zeros, which may be omitted."""
    stripped = map(str.strip, names)
    return {name.zfill(6) if name.isascii() and name.isdigit() else name for name in stripped}


def _require_there(session: Session, rejecting: set[str], restoring: set[str]) -> None:
    """Check every name before any capture is moved.

    Raises:
        UsageError: a name is not that of a capture to be rejected or restored, or is given for both.
    """
    kept = {capture.name for capture in session.captures}
    rejected = {capture.name for capture in session.rejected}
    both = rejecting & restoring
    for names, there, state in ((rejecting, kept, "kept"), (restoring, rejected - kept, "rejected")):
        if missing := sorted(both or names - there):
            raise UsageError(
                f"{session.path} has no {state} capture {missing[0]}",
                f"List them with: lce-rig captures {session.path}",
            )


def _records(session: Session, stored: Sequence[StoredResult]) -> list[dict[str, Any]]:
    # The cameras whose current result used each capture.
    pairs = [c for each in stored if each.name == CURRENT and each.file for c in each.file.pairs]
    states = [(each, "kept") for each in session.captures] + [(each, "rejected") for each in session.rejected]
    records = []
    for capture, state in sorted(states, key=lambda item: int(item[0].name)):
        used_by = [c.camera for c in pairs if capture.name in c.captures_used]
        streams: list[str] = []
        label, damage = "", None
        try:
            source = capture.meta.get("source")
            label = str(source.get("label", "")) if isinstance(source, dict) else ""
            streams = [".".join(key) for key in capture.image_keys]
            streams += [f"{camera}.events" for camera in capture.event_cameras] + capture.lidars
        except SessionError as error:
            damage = error.what
        record = {"name": capture.name, "state": state, "used_by": used_by, "streams": streams}
        records.append({**record, "source": label, "damage": damage})
    return records


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
                "file": str((result.folder / RESULT).relative_to(opened.path)),
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
    if not stored:
        show.say(f"no results in {session}: run `lce-rig calibrate {session}`")
        return
    headings = ("result", "sensors", "method", ">used", ">deg", ">mm", "verdict", "written")
    rows = (row for result in stored for row in _rows(result))
    show.print_table(show.plain_table("", *headings, rows=rows))
    dates = {result.file.provenance.date_words: None for result in stored if result.file}
    if any(dates):
        show.note(f"date of the captures: {'; '.join(filter(None, dates))}")
    for result in stored:
        if result.problem:
            show.warn(result.problem)
        elif result.is_outdated:
            show.note(f"{result.name}: the profile or the captures that it used have changed since")


def _pair(c: Calibration) -> dict[str, Any]:
    """List the figures that distinguish results."""
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


def _rows(result: StoredResult) -> Iterator[tuple[str, ...]]:
    """List the sensors of a result, or state that it cannot be read."""
    name = show.escape(result.name)
    if result.file is None:
        yield name, "[red]unreadable[/]"
        return
    for c in result.file.pairs:
        yield (
            name,
            show.escape(str(Pair.of(c))),
            c.method,
            f"{len(c.captures_used)}",
            f"{c.sigma_rotation_deg:.3f}",
            f"{1000 * c.sigma_translation_m:.1f}",
            f"[{show.COLOURS[c.verdict]}]{c.verdict}[/]",
            datetime.fromtimestamp(result.written_s).strftime("%Y-%m-%d %H:%M"),
        )


@click.command()
@click.argument("sessions", nargs=-1, type=click.Path(path_type=Path), metavar="SESSION...")
@click.option(
    "--name",
    "names",
    metavar="NAME",
    multiple=True,
    help="Compare this named result (see `lce-rig results`); repeatable with one session.",
)
@explain_option
@json_option
def repeat(sessions: tuple[Path, ...], names: tuple[str, ...], explain: bool, as_json: bool) -> None:
    """Compare the calibrations of two or more independent SESSIONs of one rig, or the results of one SESSION.

    The best test of extrinsics: collect again with new placements of the board. Errors that all sessions
    share stay hidden: intrinsics, the board's size, constant range errors.

    With one session, compare the results of `lce-rig calibrate SESSION --name NAME` with the current one.

    Exits with 7 if the calibrations disagree, or if one of them failed.
    """
    if len(sessions) == 1:
        compared = compare_results(sessions[0], names)
    elif len(names) > 1:
        raise UsageError("several results and several sessions given", "Give one session, or one result.")
    else:
        compared = compare(sessions, name=next(iter(names), None))
    show.warn_of(finding for finding in compared.findings if finding.severity != "error")
    document = {
        "format_version": 2,
        "rig": compared.rig,
        "findings": compared.findings,
        "pairs": [
            {name.replace("reported_", "claimed_"): v for name, v in vars(c).items() if name != "names"}
            | {"sessions": c.names, "agrees": c.agrees, "finding": c.finding}
            for c in compared.comparisons
        ],
    }
    if as_json:
        show.print_json(document)
    else:
        for comparison in compared.comparisons:
            show.print_parts(_agreement(comparison, str(sessions[0])))
    if explain and not as_json:
        show.print_figures(document)
    refused = [comparison for comparison in compared.comparisons if not comparison.agrees]
    if compared.failed:
        opinion = "disagree, and" if refused else "agree, but"
        causes = "; ".join(finding.text for finding in compared.failed)
        raise ResultRefusedError(f"the extrinsics {opinion} {causes}", compared.failed[0].advice)
    if refused:
        names_of = ", ".join(f"{c.camera} and {c.lidar}" for c in refused)
        raise ResultRefusedError(f"the sessions disagree on the extrinsics of {names_of}")


def _agreement(c: Repeatability, session: str) -> Iterator[str]:
    """State whether the sessions agree, the mean extrinsics, and the actual and the reported spread."""
    shared = "" if c.are_independent else ", at least: the results share captures"
    colour = "green" if c.agrees else "red"
    yield f"[{colour}]{show.escape(c.finding.text)}[/]"
    if advice := c.finding.advice_at(session):
        yield f"  -> {show.escape(as_line(advice))}"
    yield "  mean T_cam_lidar (p_cam = R p_lidar + t)"
    yield from show.matrix_lines(c.T_cam_lidar, "    ")
    spread = sizes(c.spread_rotation_deg, c.spread_translation_m)
    yield f"  spread       {spread} (1 sigma of one session)"
    yield f"  reported     {sizes(c.reported_rotation_deg, c.reported_translation_m)}"
    chance = significant(max(c.p, 1e-300))  # "below ...", as no chance is 0
    yield f"  chance       {chance}{shared} (chi2 {c.chi2:.1f}, {c.dof} degrees of freedom)"
