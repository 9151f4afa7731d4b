"""`lce-rig fleet`: calibrate the sessions of many robots, query their results, and deploy them."""

import json
import math
import os
import shlex
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, get_args

import click

from lce_rig.cli import show
from lce_rig.cli.options import FiniteRange, json_option, names_option, path_option, registry_option
from lce_rig.core.calibration import DEFAULT_METHOD, Method
from lce_rig.core.errors import ResultRefusedError, SessionError
from lce_rig.core.interrupts import patience
from lce_rig.core.phrasing import as_line, significant
from lce_rig.session.durable import write_atomically

if TYPE_CHECKING:
    from lce_rig.fleet.rollout import RobotState

# Grace period after Ctrl-C, s: sessions end at once, workers and the table take longer.
_GRACE_S = 20.0
_SHOWN = (
    "robot",
    "date",
    "camera",
    "lidar",
    "status",
    "cause",
    "verdict",
    "n_used",
    "sigma_rotation_deg",
    "sigma_translation_m",
)
_HEADINGS = ("robot", "captured", "camera", "lidar", "result", ">used", ">deg", ">mm", "cause")
_MOST_SHOWN, _MOST_FINDINGS, _MOST_CAUSES = 100, 5, 5


@click.group()
def fleet() -> None:
    """Calibrate the sessions of many robots and keep their results in one registry.

    Requires `pip install 'lce-rig[fleet]'`. docs/fleets.md describes the registry and its table.
    """


@fleet.command()
@click.argument("root", metavar="ROOT")
@registry_option
@click.option(
    "--manifest",
    metavar="FILE",
    help="Read robots and profiles from this file [default: ROOT/fleet.yaml, if there is one].",
)
@click.option(
    "--workers",
    type=click.IntRange(1, 1024),
    metavar="N",
    help="Set the number of worker processes on this computer [default: one per core].",
)
@click.option("--scheduler", metavar="ADDRESS", help="Use the workers of a running Dask scheduler, tcp://...")
@click.option(
    "--time-limit",
    default=600.0,
    show_default=True,
    type=FiniteRange(1, 1e6),
    metavar="S",
    help="End a session after this time.",
)
@click.option(
    "--memory-limit",
    default=4000.0,
    show_default=True,
    type=FiniteRange(400, 1e6),
    metavar="MB",
    help="End a session that needs more memory; also the limit of each worker.",
)
@click.option(
    "--method",
    type=click.Choice(get_args(Method)),
    default=DEFAULT_METHOD,
    show_default=True,
    help="Use this method of `lce-rig calibrate`.",
)
@click.option("--retry", is_flag=True, help="Run sessions without a result again.")
@json_option
def run(
    root: str,
    registry: str,
    manifest: str | None,
    workers: int | None,
    scheduler: str | None,
    time_limit: float,
    memory_limit: float,
    method: Any,
    retry: bool,
    as_json: bool,
) -> None:
    """Calibrate all sessions below ROOT, a path or an address such as s3://bucket/sessions.

    Each session is one task of a Dask cluster: detect, calibrate, verify, write. Results that the registry
    holds already, of the same captures, profile and version, are kept. Run it again after an interrupt to
    continue. A session that fails, takes too long, crashes or needs too much memory is recorded with the
    cause; others continue. ROOT is not written to.
    """
    from lce_rig.fleet.jobs import find_jobs
    from lce_rig.fleet.run import cluster, run_fleet
    from lce_rig.fleet.storage import Storage
    from lce_rig.fleet.work import Settings

    place = Storage.at(registry).require_folder()
    jobs = find_jobs(Storage.at(root), None if manifest is None else Storage.at(manifest))
    limits = (time_limit, memory_limit)
    settings = Settings(place.url, method, *limits, retry)
    n_workers = workers or len(os.sched_getaffinity(0))
    show.note(f"{show.counted(len(jobs), 'session')} in {root}")
    with patience(_GRACE_S), cluster(n_workers, memory_limit, scheduler) as client:
        show.note(f"Dask dashboard: {client.dashboard_link}")
        with show.progress_bar("sessions") as progress:
            done = run_fleet(jobs, settings, client, progress=progress)
    if as_json:
        show.print_json(
            {
                "format_version": 1,
                "n_run": done.n_new,
                "n_held": done.n_held,
                "statuses": dict(sorted(done.statuses.items())),
                "causes": dict(done.causes.most_common()),
                "n_rows": len(done.table),
            }
        )
        return
    statuses = ", ".join(f"{status} {n}" for status, n in done.statuses.most_common())
    show.say(f"{show.counted(done.n_new, 'session')} run, {done.n_held} held already: {statuses}")
    for cause, n in done.causes.most_common(_MOST_CAUSES):
        show.say(f"  {n} x {cause}")
    if (n_more := len(done.causes) - _MOST_CAUSES) > 0:
        show.say(f"  {n_more} more causes: lce-rig fleet table --registry {registry}")
    show.say(f"{place.url}: {show.counted(len(done.table), 'row')} in the table")
    show.note(f"  next         lce-rig fleet report --registry {shlex.quote(registry)}")


@fleet.command()
@registry_option
@click.option(
    "--where",
    default="",
    metavar="CONDITION",
    help="Choose rows by a condition in SQL, such as \"verdict = 'fail' and date > '2026-01-01'\".",
)
@names_option("--columns", "Choose columns [default: all with --json, else the most important].")
@json_option
@click.option("--rebuild", is_flag=True, help="Rebuild the table from all results' folders first.")
def table(registry: str, where: str, columns: list[str] | None, as_json: bool, rebuild: bool) -> None:
    """Print rows of the registry's table."""
    from lce_rig.fleet.registry import Registry
    from lce_rig.fleet.storage import Storage

    opened: Registry = Registry(Storage.at(registry).require_folder())
    if rebuild:
        if not opened.place.exists():
            raise SessionError(
                f"{opened.place.url} does not exist",
                "`lce-rig fleet run ROOT --registry FOLDER` writes a registry.",
            )
        opened.consolidate(rebuild=True)
    chosen = opened.read_table(columns or (None if as_json else _SHOWN), where)
    every = (row for batch in chosen.to_batches(max_chunksize=10_000) for row in batch.to_pylist())
    if as_json:
        sys.stdout.write('{"format_version": 1, "rows": [')
        end = "\n"
        for row in every:
            sys.stdout.write(end + json.dumps(row, allow_nan=False))
            end = ",\n"
        sys.stdout.write("\n]}\n")
    else:
        shown = chosen.slice(0, _MOST_SHOWN).to_pylist()
        rows = [map(_cell, row.values()) if columns else _summary(row) for row in shown]
        headings = map(show.escape, chosen.column_names) if columns else _HEADINGS
        show.print_table(show.plain_table("", *headings, rows=rows))
        is_whole = len(chosen) == len(rows)
        count = show.counted(len(chosen), "row")
        show.note(count if is_whole else f"{len(rows)} of {count}; --json prints all")


def _summary(row: Mapping[str, Any]) -> tuple[str, ...]:
    """Summarise a row for the terminal, in the columns `_HEADINGS`."""
    sigmas = (
        "-" if row[name] is None else f"{scale * row[name]:.{digits}f}"
        for name, scale, digits in (("sigma_rotation_deg", 1.0, 3), ("sigma_translation_m", 1000.0, 1))
    )
    captured, result = (row["date"] or "-")[:10], row["verdict"] or _words(row["status"])
    names = (row["robot"], captured, row["camera"], row["lidar"], result, row["n_used"])
    return *map(_cell, names), *sigmas, _cell(row["cause"])


def _cell(value: Any) -> str:
    if value is None:
        return "-"
    if isinstance(value, list):
        return show.escape(" ".join(map(str, value)))
    if isinstance(value, float):
        return significant(value, 4) if math.isfinite(value) else "-"
    return show.escape(str(value))


@fleet.command()
@registry_option
@path_option(
    "-o",
    "--output",
    "FILE",
    "Write the page to this file.",
    default=Path("fleet_report.html"),
    show_default=True,
    is_file=True,
)
@path_option("--json", "json_file", "FILE", "Write findings, states and counts to this file.", is_file=True)
def report(registry: str, output: Path, json_file: Path | None) -> None:
    """Report which robots moved, and why results are missing or failed, as one HTML page.

    A robot moved if two successive results of it differ beyond their own independent covariance. The page
    loads nothing. docs/fleets.md explains it.
    """
    from lce_rig.fleet.registry import Registry
    from lce_rig.fleet.report import FleetReport
    from lce_rig.fleet.storage import Storage

    made = FleetReport.of(Registry(Storage.at(registry).require_folder()))
    write_atomically(output, made.page())
    if json_file is not None:
        made.write_json(json_file)
    for finding in made.findings[:_MOST_FINDINGS]:
        show.say(show.escape(f"{finding.subject}: {as_line(finding.sentence)}"))
    if len(made.findings) > _MOST_FINDINGS:
        show.note(f"{len(made.findings) - _MOST_FINDINGS} more in the report")
    states = [*made.history.robots.values()]
    unknown = states.count("cannot_tell")
    moved = f"{states.count('moved')} of {show.counted(len(states), 'robot')} moved"
    show.note(f"{moved}{f', {unknown} cannot be judged yet' if unknown else ''}; written: {output}")


@fleet.command()
@registry_option
@click.option("--target", required=True, metavar="NAME", help="Name the target; each robot has its own.")
@path_option(
    "--targets",
    "FILE",
    "Read targets from this file; {robot} in `to` stands for the robot's name.",
    default=Path("deploy.yaml"),
    show_default=True,
    is_file=True,
)
@click.option(
    "--where",
    default="",
    metavar="CONDITION",
    help="Choose robots by a condition in SQL, as `fleet table` does.",
)
@click.option("--dry-run", is_flag=True, help="Print which result would go where; change nothing.")
@json_option
def deploy(
    registry: str,
    target: str,
    targets: Path,
    where: str,
    dry_run: bool,
    as_json: bool,
) -> None:
    """Deploy the newest result of each robot in a registry to the robot, one after the other.

    Stops at the first robot that fails: not reached, not written, result refused, or command failed. Run it
    again to continue; robots that hold their result are not written again. To skip a
    robot, use --where. Robots whose newest session failed are skipped. Exits with 7 if it was stopped.
    """
    from lce_rig.fleet.registry import Registry
    from lce_rig.fleet.rollout import newest_results, roll_out
    from lce_rig.fleet.storage import Storage

    opened = Registry(Storage.at(registry).require_folder())
    newest = newest_results(opened, where)
    if dry_run:
        rows = [map(show.escape, (robot, state.folder, state.detail)) for robot, state in newest.items()]
        show.print_table(show.plain_table("", "robot", "result", "", rows=rows))
        return
    with show.progress_bar("robots") as progress:
        rollout = roll_out(opened, target, targets, newest, progress=progress)
    if as_json:
        show.print_json({"format_version": 2, **vars(rollout)})
    else:
        counts = ", ".join(f"{_words(state)} {n}" for state, n in rollout.counts.most_common())
        show.say(f"{rollout.target}: {counts or 'no robots'}")
        for state in rollout.robots.values():
            if state.detail:
                show.note(f"{state.robot}: {_line(state)}")
    if rollout.stopped_by:
        stopped = rollout.robots[rollout.stopped_by]
        raise ResultRefusedError(
            f"stopped at {stopped.robot}: {_line(stopped)}",
            "Remove the cause and run it again. To restore a robot's earlier files: "
            f"`lce-rig deploy --target {target} --targets {targets} --robot {stopped.robot} --rollback`",
        )


def _words(state: str) -> str:
    return state.replace("_", " ")


def _line(state: "RobotState") -> str:
    return " ".join(f"{_words(state.state)}: {state.detail}".split())
