"""Deploy the newest results of many robots, one robot after the other, until the first failure.

A roll-out stores no state: robots that hold their newest result are not written again, so the same call
continues after an interrupt.
"""

from collections import Counter
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Literal, TypeAlias

from lce_rig.core.errors import CommandError, LceRigError, UsageError
from lce_rig.core.progress import Progress, silent
from lce_rig.fleet import deployment
from lce_rig.fleet.jobs import folder_name
from lce_rig.fleet.registry import Registry
from lce_rig.fleet.releases import read_targets
from lce_rig.fleet.target import TargetSettings
from lce_rig.rig import load_rig
from lce_rig.session.session import PROFILE

State: TypeAlias = Literal["waiting", "in_place", "left_out", "failed"]
_COLUMNS = ("robot", "folder", "date", "finished", "status", "verdict", "cause")


@dataclass(frozen=True)
class RobotState:
    """One robot in a rollout.

    Attributes:
        robot: the robot's name.
        folder: folder of its newest result in the registry.
        state: "waiting" until it was reached.
        to: the place of its files.
        release: the current release there afterwards; "" if unknown.
        replaces: the release that it replaced; "" if there was none.
        detail: cause and action.
    """

    robot: str
    folder: str = ""
    state: State = "waiting"
    to: str = ""
    release: str = ""
    replaces: str = ""
    detail: str = ""

    def ended(self, state: State, cause: "Exception | str" = "") -> "RobotState":
        """Return the robot's state after a step."""
        detail = f"{cause.what} {cause.hint}".strip() if isinstance(cause, LceRigError) else str(cause)
        return replace(self, state=state, detail=detail)


@dataclass
class Rollout:
    """The outcome of a rollout.

    Attributes:
        target: name of the target.
        stopped_by: the robot that failed and stopped it; "" if none did.
        robots: state of each robot, by name.
    """

    target: str
    stopped_by: str = ""
    robots: dict[str, RobotState] = field(default_factory=dict)

    @property
    def counts(self) -> Counter[str]:
        """The number of robots in each state."""
        return Counter(robot.state for robot in self.robots.values())


def newest_results(registry: Registry, where: str = "") -> dict[str, RobotState]:
    """Choose each robot's newest session; one without a usable result is skipped, with the cause.

    An older result is never used instead, as the sensors may have been moved since.

    Args:
        registry: registry of the results.
        where: condition in SQL on the rows of the table, as of `Registry.read_table`.
    """
    by_robot: dict[str, list[Mapping[str, Any]]] = {}
    for row in registry.read_table(_COLUMNS, where).to_pylist():
        by_robot.setdefault(row["robot"], []).append(row)
    states: dict[str, RobotState] = {}
    for robot, rows in sorted(by_robot.items()):
        last = max(rows, key=lambda row: (row["date"] or "", row["finished"] or "", row["folder"]))
        first, _, name = last["folder"].partition("/")
        newest = [row for row in rows if row["folder"] == last["folder"]]
        why = next((f"no result: {row['cause']}" for row in newest if row["status"] != "ok"), "")
        if first != robot or not name or any(folder_name(part) != part for part in (robot, name)):
            why = "its name or folder is not safe"
        elif not why and any(row["verdict"] == "fail" for row in newest):
            why = "verdict fail"
        state: State = "left_out" if why else "waiting"
        states[robot] = RobotState(robot=robot, folder=last["folder"], state=state, detail=why)
    return states


def roll_out(
    registry: Registry,
    target: str,
    file: Path,
    wanted: Mapping[str, RobotState],
    *,
    progress: Progress = silent,
) -> Rollout:
    """Deploy to one robot after the other, until one fails.

    Robots that hold their result are not written again. Skipped robots stay unchanged.

    Args:
        registry: registry of the results.
        target: name of the target in the file; `{robot}` in its `to` stands for each robot's name.
        file: file that lists targets.
        wanted: results from `newest_results`.
        progress: called with (done, total) robots.

    Raises:
        UsageError: the target is unknown.
        ProfileError: the file with the targets is invalid.
    """
    targets = read_targets(file)
    if target not in targets:
        raise UsageError(f"no target is called {target!r}", f"Known targets: {', '.join(targets)}.")
    rollout = Rollout(target)
    for done, state in enumerate(wanted.values(), 1):
        if state.state != "left_out":
            try:
                try:
                    of_robot = targets[target].for_robot(state.robot)
                except ValueError as error:
                    what = f"it cannot be part of {targets[target].to}"
                    raise UsageError(what, "Rename the robot.") from error
                state = _deploy(registry, replace(state, to=of_robot.to), of_robot)
            except (LceRigError, OSError) as error:
                state = state.ended("failed", error)
        rollout.robots[state.robot] = state
        progress(done, len(wanted))
        if state.state == "failed":
            rollout.stopped_by = state.robot
            break
    return rollout


def _deploy(registry: Registry, state: RobotState, target: TargetSettings) -> RobotState:
    """Deploy to a robot."""
    with TemporaryDirectory(prefix="lce-rig-") as scratch:
        folder = Path(scratch) / "result"
        (registry.place / state.folder).fetch(folder)
        try:
            done = deployment.deploy(folder, load_rig(folder / PROFILE), target)
        except CommandError as error:
            with suppress(LceRigError):
                current = deployment.standing(target).current
                state = state if current is None else replace(state, release=current.name)
            return state.ended("failed", error)
        return replace(state, release=done.release.name, replaces=done.replaces).ended("in_place")
