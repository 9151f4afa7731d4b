"""`lce-rig fleet deploy`: the newest results of many robots onto them."""

from pathlib import Path
from typing import TYPE_CHECKING

import click

from lce_rig.cli import show
from lce_rig.cli.options import json_option, registry_option

if TYPE_CHECKING:
    from lce_rig.fleet.rollout import RobotState


@click.command()
@registry_option
@click.option("--target", required=True, metavar="NAME", help="Name the target; each robot has its own.")
@click.option(
    "--targets",
    default=Path("deploy.yaml"),
    show_default=True,
    type=click.Path(path_type=Path, dir_okay=False),
    metavar="FILE",
    help="Read targets from this file; {robot} in `to` stands for the robot's name.",
)
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
    help="Run this here after each deployment, without a shell; {robot}, {result} and {to} are filled in. "
    "Exit code 7, as of `drift`, contradicts the result; 6 cannot tell and passes.",
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
    where: str,
    check: str,
    dry_run: bool,
    status: bool,
    rollback: bool,
    reason: str,
    as_json: bool,
) -> None:
    """Put the newest result of each robot in a registry onto the robot, one after the other.

    Stops at the first robot that fails: not reached, not written, result refused, command failed, or --check
    contradicts. Run it again to continue; robots that hold their result are not written again. To pass over a
    robot, use --where. Robots whose newest session failed are left out. Exits with 7 if it was stopped.
    """
    from lce_rig.core.errors import ResultRefusedError, UsageError
    from lce_rig.fleet.registry import Registry
    from lce_rig.fleet.rollout import FleetDeployment, newest_results, read_rollout
    from lce_rig.fleet.storage import Storage

    if sum((dry_run, status, rollback)) > 1:
        raise UsageError("--dry-run, --status and --rollback exclude each other", "Give one of them.")
    opened = Registry(Storage.at(registry))
    if status:
        rollout = read_rollout(opened, target)
    elif dry_run:
        table = show.plain_table("", "robot", "result", "")
        for robot, state in newest_results(opened, where).items():
            table.add_row(*map(show.escape, (robot, state.folder, state.detail)))
        show.print_table(table)
        return
    else:
        under_way = FleetDeployment(opened, target, targets, check)
        with show.progress_bar("robots") as progress:
            if rollback:
                rollout = under_way.roll_back(reason, progress=progress)
            else:
                rollout = under_way.run(newest_results(opened, where), progress=progress)
    if as_json:
        show.print_json(rollout.model_dump())
    else:
        counts = ", ".join(f"{_words(state)} {n}" for state, n in rollout.counts.most_common())
        show.say(f"{rollout.target}: {counts or 'nothing deployed yet'}")
        table = show.plain_table("", "robot", "state", "release", "replaces")
        for state in rollout.robots.values():
            cells = (state.robot, _words(state.state), state.release or "-", state.replaces or "-")
            table.add_row(*map(show.escape, cells))
        show.print_table(table)
        for state in rollout.robots.values():
            if state.detail:
                show.note(f"{state.robot}: {_line(state)}")
    if rollout.stopped_by and not (status or rollback):
        stopped = rollout.robots[rollout.stopped_by]
        raise ResultRefusedError(
            f"stopped at {stopped.robot}: {_line(stopped)}",
            "Remove the cause and run it again, or restore every robot's earlier files with --rollback.",
        )


def _words(state: str) -> str:
    return state.replace("_", " ")


def _line(state: "RobotState") -> str:
    return " ".join(f"{_words(state.state)}: {state.detail}".split())
