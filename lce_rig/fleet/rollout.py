"""Put the newest results of many robots onto them, one after the other, until the first failure.

The registry keeps the state of each robot: the same call continues after an interrupt, and all that was
deployed can be rolled back.
"""

import re
import shlex
import subprocess
from collections import Counter
from collections.abc import Mapping
from contextlib import suppress
from datetime import datetime, timezone
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Literal, TypeAlias

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from lce_rig.core.errors import CommandError, LceRigError, NotEnoughDataError, SessionError, UsageError
from lce_rig.core.progress import Progress, silent
from lce_rig.fleet.deploy import deployment
from lce_rig.fleet.deploy.place import run_bounded
from lce_rig.fleet.deploy.targets import read_targets
from lce_rig.fleet.jobs import folder_name
from lce_rig.fleet.registry import Registry
from lce_rig.pipeline.result_files import RESULT
from lce_rig.rig import load_rig
from lce_rig.rig.target_settings import TargetSettings
from lce_rig.session.session import PROFILE

FOLDER = ".deployments"
State: TypeAlias = Literal["waiting", "in_place", "left_out", "failed", "rolled_back", "not_rolled_back"]
_CHECK_LIMIT_S = 1800.0
_MOST_SAID = 2000
_COLUMNS = ("robot", "folder", "date", "finished", "status", "verdict", "cause")


class RobotState(BaseModel):
    """One robot in a roll-out.

    Attributes:
        robot: its name.
        folder: of its result in the registry.
        state: `State`; files of earlier versions hold others.
        to: the place of its files.
        release: the release that was made current.
        replaces: the release that was current before; "" if there was none.
        time: of the last step, UTC.
        detail: cause and action, or the output of a check.
    """

    model_config = ConfigDict(frozen=True, extra="ignore")

    robot: str
    folder: str = ""
    state: str = "waiting"
    to: str = ""
    release: str = ""
    replaces: str = ""
    time: str = ""
    detail: str = ""

    def ended(self, state: State, cause: "Exception | str" = "", **changes: str) -> "RobotState":
        """Return the robot after a step."""
        detail = f"{cause.what} {cause.hint}".strip() if isinstance(cause, LceRigError) else str(cause)
        now = f"{datetime.now(timezone.utc):%Y-%m-%dT%H:%M:%SZ}"
        return self.model_copy(update={"state": state, "detail": detail, "time": now} | changes)


class Rollout(BaseModel):
    """A roll-out to one target of every robot.

    Attributes:
        target: its name.
        stopped_by: the robot that failed and stopped it; "" if none did.
        robots: by name.
    """

    model_config = ConfigDict(extra="ignore")

    format_version: Literal[1] = 1
    target: str
    stopped_by: str = ""
    robots: dict[str, RobotState] = Field(default_factory=dict)

    @property
    def counts(self) -> Counter[str]:
        """The number of robots in each state."""
        return Counter(robot.state for robot in self.robots.values())


def read_rollout(registry: Registry, target: str) -> Rollout:
    """Read the state of a roll-out; empty if nothing was deployed.

    Raises:
        UsageError: no target can have this name.
        SessionError: the file is damaged.
    """
    if target != folder_name(target):
        raise UsageError(
            f"{target!r} cannot name a target", "Use letters, digits, dots, dashes and underscores."
        )
    place = registry.place / FOLDER / f"{target}.json"
    content = place.read()
    if content is None:
        return Rollout(target=target)
    try:
        return Rollout.model_validate_json(content)
    except ValidationError as error:
        raise SessionError(f"{place.url} is damaged", "Restore it from a copy of the registry.") from error


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
    states = {}
    for robot, rows in sorted(by_robot.items()):
        last = max(rows, key=lambda row: (row["date"] or "", row["finished"] or "", row["folder"]))
        first, _, name = last["folder"].partition("/")
        newest = [row for row in rows if row["folder"] == last["folder"]]
        why = next((f"no result: {row['cause']}" for row in newest if row["status"] != "ok"), "")
        if first != robot or not name or any(folder_name(part) != part for part in (robot, name)):
            why = "its name or folder is not safe"
        elif not why and any(row["verdict"] == "fail" for row in newest):
            why = "verdict fail"
        state = "left_out" if why else "waiting"
        states[robot] = RobotState(robot=robot, folder=last["folder"], state=state, detail=why)
    return states


class FleetDeployment:
    """A roll-out that is under way.

    Args:
        registry: with the results.
        target: name of the target in the file; `{robot}` in its `to` stands for each robot's name.
        file: that lists targets.
        check: program and arguments run on this computer after each deployment, without a shell; `{robot}`,
            `{result}` and `{to}` are filled in. Its exit code 7 contradicts the result, 6 cannot tell, as of
            `drift`.

    Raises:
        UsageError: the target's name, or the check, cannot be used.
        ProfileError: the file with the targets is invalid.
        SessionError: the registry's state of the roll-out is damaged.
    """

    def __init__(self, registry: Registry, target: str, file: Path, check: str = "") -> None:
        self._registry = registry
        try:
            self._check = shlex.split(check)
        except ValueError as error:
            raise UsageError(f"--check {check!r}: {error}", "Close the quotes.") from error
        self.rollout = read_rollout(registry, target)
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

        Raises:
            SessionError: the registry cannot be written.
        """
        self.rollout.stopped_by = ""
        for done, state in enumerate(wanted.values(), 1):
            ended = state if state.state == "left_out" else self._deploy(state)
            if ended.state == "failed":
                self.rollout.stopped_by = ended.robot
            self._keep(ended)
            progress(done, len(wanted))
            if self.rollout.stopped_by:
                break
        return self.rollout

    def roll_back(self, reason: str = "", *, progress: Progress = silent) -> Rollout:
        """Restore the earlier release on each robot that still has the release of this roll-out.

        Raises:
            SessionError: the registry cannot be written.
        """
        held = [
            state for state in self.rollout.robots.values() if state.release and state.state != "rolled_back"
        ]
        for done, state in enumerate(held, 1):
            self._keep(self._restore(state, reason))
            progress(done, len(held))
        return self.rollout

    def _deploy(self, state: RobotState) -> RobotState:
        try:
            target = self._target_of(state.robot)
            state = state.model_copy(update={"to": target.to})
            with TemporaryDirectory(prefix="lce-rig-") as scratch:
                place, folder = self._registry.place / state.folder, Path(scratch) / "result"
                place.fetch(folder)
                done = deployment.deploy(folder, load_rig(folder / PROFILE), target)
                releases = {"release": done.release.name, "replaces": done.replaces}
                return self._checked(state.model_copy(update=releases), folder)
        except CommandError as error:
            current = None
            with suppress(LceRigError):
                current = deployment.standing(target).current
            releases = {} if current is None else {"release": current.name, "replaces": current.replaces}
            return state.ended("failed", error, **releases)
        except (LceRigError, OSError) as error:
            return state.ended("failed", error)

    def _checked(self, state: RobotState, folder: Path) -> RobotState:
        """Run the check, if there is one."""
        if not self._check:
            return state.ended("in_place")
        values = {"{robot}": state.robot, "{result}": str(folder / RESULT), "{to}": state.to}
        words = [re.sub(r"\{(robot|result|to)\}", lambda name: values[name[0]], word) for word in self._check]
        try:
            ran = run_bounded(words, _CHECK_LIMIT_S)
        except (OSError, subprocess.TimeoutExpired) as error:
            return state.ended("failed", f"the check cannot run: {error}")
        output = (ran.out + ran.err).strip()[-_MOST_SAID:]
        if ran.code == 0:
            return state.ended("in_place")
        if ran.code == NotEnoughDataError.exit_code:
            return state.ended("in_place", f"the check cannot tell: {output}")
        return state.ended("failed", f"the check ended with exit code {ran.code}: {output}")

    def _restore(self, state: RobotState, reason: str) -> RobotState:
        try:
            target = self._target_of(state.robot)
            current = deployment.standing(target).current
            if current is None or current.name != state.release:
                now = "nothing" if current is None else current.name
                return state.ended("not_rolled_back", f"{now} is in place by now, not {state.release}")
            if not state.replaces:
                return state.ended("not_rolled_back", "it is the first release there")
            deployment.rollback(target, state.replaces, reason=reason)
        except CommandError as error:
            return state.ended("rolled_back", error)
        except LceRigError as error:
            return state.ended("not_rolled_back", error)
        return state.ended("rolled_back")

    def _target_of(self, robot: str) -> TargetSettings:
        try:
            return self._target.for_robot(robot)
        except ValueError as error:
            raise UsageError(
                f"robot {robot!r} cannot be part of {self._target.to}", "Rename the robot."
            ) from error

    def _keep(self, state: RobotState) -> None:
        """Keep a robot's state in the registry."""
        self.rollout.robots = dict(sorted({**self.rollout.robots, state.robot: state}.items()))
        place = self._registry.place / FOLDER / f"{self.rollout.target}.json"
        place.write(self.rollout.model_dump_json(indent=1).encode() + b"\n")
