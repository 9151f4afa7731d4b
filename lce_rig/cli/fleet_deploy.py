"""`lce-rig fleet deploy`: the newest results of many robots onto them, a few first."""

from pathlib import Path
from typing import TYPE_CHECKING

import click

from lce_rig.cli import show
from lce_rig.cli.options import json_option, registry_option

if TYPE_CHECKING:
    from lce_rig.fleet.deployment import RobotState, Rollout


@click.command()
@registry_option
@click.option("--target", required=True, metavar="NAME", help="Name the target; each robot has its own.")
@click.option(
    "--targets",
    default=Path("deploy.yaml"),
    show_default=True,
    type=click.Path(path_type=Path, dir_okay=False),
    metavar="FILE",
    help="Read targets from this file; {robot} in it stands for the robot's name.",
)
@click.option(
    "--canary",
    default="5",
    show_default=True,
    metavar="N|NAMES",
    help="Deploy to so many robots first, or to these (separated by commas), one after the other.",
)
@click.option("--canary-only", is_flag=True, help="End after these; without this option, go on.")
@click.option(
    "--where",
    default="",
    metavar="CONDITION",
    help="Choose robots by a condition in SQL, as `fleet table` does.",
)
@click.option(
    "--check",
    default="",
    metavar="COMMAND",
    help="Run this here after each deployment; {robot}, {result} and {to} are filled in. Exit code 7, as of "
    "`drift`, contradicts the result.",
)
@click.option(
    "--jobs",
    default=4,
    show_default=True,
    type=click.IntRange(1, 64),
    metavar="N",
    help="Deploy to so many robots at once.",
)
@click.option("--dry-run", is_flag=True, help="Print which result would go where; change nothing.")
@click.option("--status", is_flag=True, help="Print the state of every robot; change nothing.")
@click.option("--rollback", is_flag=True, help="Restore the earlier files of every robot deployed to.")
@click.option(
    "--reason", default="", metavar="TEXT", help="With --rollback: say why; it is written down there."
)
@json_option
def deploy(
    registry: str,
    target: str,
    targets: Path,
    canary: str,
    canary_only: bool,
    where: str,
    check: str,
    jobs: int,
    dry_run: bool,
    status: bool,
    rollback: bool,
    reason: str,
    as_json: bool,
) -> None:
    """Put the newest result of each robot in a registry onto the robot.

    The canaries come first, one after the other. The others follow only if the files of every canary were
    written, read back, and contradicted neither by the target's command nor by --check. A file that reads
    back differently, a command that fails or a contradiction stops everything; a robot that is off or refuses
    the result is recorded and passed over. Run it again to go on. Robots whose newest session failed are left
    out. Exits with 7 if it was stopped.
    """
    from lce_rig.core.errors import ResultRefusedError, UsageError
    from lce_rig.fleet.deployment import FleetDeployment, newest_results
    from lce_rig.fleet.registry import Registry
    from lce_rig.fleet.storage import Storage

    if sum((dry_run, status, rollback)) > 1:
        raise UsageError("--dry-run, --status and --rollback exclude each other", "Give one of them.")
    opened = Registry(Storage.at(registry))
    rolling = FleetDeployment(opened, target, targets, check)
    if rollback:
        with show.progress_bar("robots") as progress:
            rolling.roll_back(reason, progress=progress)
    elif not status:
        wanted = newest_results(opened, where)
        canaries = _canaries(canary, wanted)
        if dry_run:
            _print_plan(wanted, canaries)
            return
        with show.progress_bar("robots") as progress:
            rolling.run(wanted, canaries, jobs=jobs, only_canaries=canary_only, progress=progress)
    found = rolling.rollout
    if as_json:
        show.print_json(found.model_dump())
    else:
        _print(found)
    if found.stopped_by and not (status or rollback):
        stopped = found.robots[found.stopped_by]
        raise ResultRefusedError(
            f"stopped at {stopped.robot}: {_line(stopped)}",
            "Mend the cause and run it again, or restore every robot's earlier files with --rollback.",
        )


def _canaries(text: str, wanted: "dict[str, RobotState]") -> list[str]:
    usable = [robot for robot, state in wanted.items() if state.state != "left_out"]
    return usable[: int(text)] if text.isdecimal() else [name.strip() for name in text.split(",")]


def _print_plan(wanted: "dict[str, RobotState]", canaries: list[str]) -> None:
    table = show.plain_table("", "robot", "result", "")
    for robot, state in wanted.items():
        told = "canary" if robot in canaries else state.detail
        table.add_row(*map(show.escape, (robot, state.folder, told)))
    show.print_table(table)


def _print(found: "Rollout") -> None:
    counts = ", ".join(f"{_words(state)} {n}" for state, n in found.counts.most_common())
    show.say(f"{found.target}: {counts or 'nothing deployed yet'}")
    table = show.plain_table("", "robot", "state", "release", "replaces")
    for state in found.robots.values():
        name = f"{state.robot} (canary)" if state.is_canary else state.robot
        cells = (name, _words(state.state), state.release or "-", state.replaces or "-")
        table.add_row(*map(show.escape, cells))
    show.print_table(table)
    for state in found.robots.values():
        if state.detail:
            show.note(f"{state.robot}: {_line(state)}")


def _words(state: str) -> str:
    return state.replace("_", " ")


def _line(state: "RobotState") -> str:
    return " ".join(f"{_words(state.state)}: {state.detail}".split())
