"""Put the newest results of many robots onto them, one after the other, until the first failure.

Nothing is kept of a roll-out: robots that hold their newest result are not written again, so the same call
continues after an interrupt, and a rollback restores what such robots held before.
"""

import hashlib
from collections import Counter
from collections.abc import Callable, Mapping
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
from lce_rig.pipeline.result_files import RESULT
from lce_rig.rig import load_rig
from lce_rig.rig.target_settings import TargetSettings
from lce_rig.session.session import PROFILE

State: TypeAlias = Literal["waiting", "in_place", "left_out", "failed", "rolled_back", "not_rolled_back"]
_COLUMNS = ("robot", "folder", "date", "finished", "status", "verdict", "cause")


@dataclass(frozen=True)
class RobotState:
    """One robot in a roll-out.

    Attributes:
        robot: its name.
        folder: of its newest result in the registry.
        state: "waiting" while this result is not in place.
        to: the place of its files.
        release: the release that is current there; "" if there is none or it was not asked.
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
        """Return the robot after a step."""
        detail = f"{cause.what} {cause.hint}".strip() if isinstance(cause, LceRigError) else str(cause)
        return replace(self, state=state, detail=detail)


@dataclass
class Rollout:
    """The outcome of a roll-out, of a question for its state, or of a rollback.

    Attributes:
        target: its name.
        stopped_by: the robot that failed and stopped it; "" if none did.
        robots: by name.
    """

    target: str
    stopped_by: str = ""
    robots: dict[str, RobotState] = field(default_factory=dict)

    @property
    def counts(self) -> Counter[str]:
        """The number of robots in each state."""
        return Counter(robot.state for robot in self.robots.values())


def newest_results(registry: Registry, where: str = "") -> dict[str, RobotState]:
    """Choose each robot's newest session; one without a usable result is left out, with the cause.

    An older result is never taken instead: the sensors may have been moved since.

    Args:
        registry: of the results.
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


class FleetDeployment:
    """One target of every robot.

    Args:
        registry: with the results.
        target: name of the target in the file; `{robot}` in its `to` stands for each robot's name.
        file: that lists targets.
    Raises:
        UsageError: there is no target of this name.
        ProfileError: the file with the targets is invalid.
    """

    def __init__(self, registry: Registry, target: str, file: Path) -> None:
        self._registry, self._name = registry, target
        targets = read_targets(file)
        if target not in targets:
            raise UsageError(f"no target is called {target!r}", f"Known targets: {', '.join(targets)}.")
        self._target = targets[target]

    def run(self, wanted: Mapping[str, RobotState], *, progress: Progress = silent) -> Rollout:
        """Deploy to one robot after the other, and stop at the first that fails.

        Robots that hold their result already are not written again.

        Args:
            wanted: as `newest_results` gives them.
            progress: called with (done, total) robots.
        """
        return self._each(wanted, self._deploy, progress, is_stopped=True)

    def status(self, wanted: Mapping[str, RobotState], *, progress: Progress = silent) -> Rollout:
        """Ask every robot for what it holds; the arguments are those of `run`."""
        return self._each(wanted, self._ask, progress)

    def roll_back(
        self, wanted: Mapping[str, RobotState], reason: str = "", *, progress: Progress = silent
    ) -> Rollout:
        """Restore the earlier release on each robot that holds its newest result, as `run` left it."""

        def restore(state: RobotState, target: TargetSettings) -> RobotState:
            state = self._ask(state, target)
            if state.state != "in_place":
                return state.ended("not_rolled_back", state.detail)
            if not state.replaces:
                return state.ended("not_rolled_back", "it is the first release there")
            try:
                deployment.rollback(target, state.replaces, reason=reason)
            except CommandError as error:
                return state.ended("rolled_back", error)
            return state.ended("rolled_back")

        return self._each(wanted, restore, progress)

    def _each(
        self,
        wanted: Mapping[str, RobotState],
        step: Callable[[RobotState, TargetSettings], RobotState],
        progress: Progress,
        *,
        is_stopped: bool = False,
    ) -> Rollout:
        """Take a step at each robot that is not left out; if asked to, stop at the first failure."""
        rollout = Rollout(self._name)
        for done, state in enumerate(wanted.values(), 1):
            if state.state != "left_out":
                try:
                    target = self._target_of(state.robot)
                    state = step(replace(state, to=target.to), target)
                except (LceRigError, OSError) as error:
                    state = state.ended("failed", error)
            rollout.robots[state.robot] = state
            progress(done, len(wanted))
            if is_stopped and state.state == "failed":
                rollout.stopped_by = state.robot
                break
        return rollout

    def _target_of(self, robot: str) -> TargetSettings:
        try:
            return self._target.for_robot(robot)
        except ValueError as error:
            raise UsageError(f"it cannot be part of {self._target.to}", "Rename the robot.") from error

    def _ask(self, state: RobotState, target: TargetSettings) -> RobotState:
        """Ask a robot whether its current release has its newest result."""
        current = deployment.standing(target).current
        if current is None:
            return state.ended("waiting", "nothing is deployed there")
        state = replace(state, release=current.name, replaces=current.replaces)
        newest = (self._registry.place / state.folder / RESULT).read() or b""
        if current.files.get(RESULT) != hashlib.sha256(newest).hexdigest():
            return state.ended("waiting", f"{current.name} holds another result")
        return state.ended("in_place")

    def _deploy(self, state: RobotState, target: TargetSettings) -> RobotState:
        """Deploy to a robot."""
        with TemporaryDirectory(prefix="lce-rig-") as scratch:
            place, folder = self._registry.place / state.folder, Path(scratch) / "result"
            place.fetch(folder)
            try:
                done = deployment.deploy(folder, load_rig(folder / PROFILE), target)
            except CommandError as error:
                with suppress(LceRigError):
                    state = self._ask(state, target)
                return state.ended("failed", error)
            state = replace(state, release=done.release.name, replaces=done.replaces)
            return state.ended("in_place")
