"""Put the newest results of many robots onto them: a few first, then the rest, stopped by the first doubt.

What was done stands in the registry, robot by robot, so that an interrupt loses nothing: the same call
continues, and all that it did can be rolled back.
"""

import shlex
import subprocess
import threading
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from datetime import datetime, timezone
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from lce_rig.core.errors import (
    CommandError,
    LceRigError,
    NotEnoughDataError,
    ResultRefusedError,
    SessionError,
    TargetError,
    UsageError,
    reading,
)
from lce_rig.fleet.deploy import deployment
from lce_rig.fleet.deploy.place import LostError
from lce_rig.fleet.deploy.targets import find_target
from lce_rig.fleet.jobs import folder_name
from lce_rig.fleet.query import query
from lce_rig.fleet.registry import Registry
from lce_rig.pipeline.detect_session import Progress, silent
from lce_rig.pipeline.result_files import RESULT
from lce_rig.rig import load_rig
from lce_rig.rig.target_settings import TargetSettings
from lce_rig.session.durable import write_atomically
from lce_rig.session.session import PROFILE

FOLDER = ".deployments"
State = Literal[
    "waiting",
    "in_place",
    "left_out",
    "refused",
    "unreachable",
    "not_written",
    "command_failed",
    "contradicted",
    "check_failed",
    "rolled_back",
    "not_rolled_back",
]
# After these, nothing more is deployed: what is wrong here may be wrong everywhere.
_STOPS: frozenset[State] = frozenset({"not_written", "command_failed", "contradicted", "check_failed"})
# Anything else at a canary stops it, too.
_FINE: frozenset[State] = frozenset({"in_place", "left_out"})
# The new files are at the robot, whatever happened afterwards.
_HELD: frozenset[State] = frozenset({"in_place", "command_failed", "contradicted", "check_failed"})
# As `drift` ends.
_CONTRADICTS, _CANNOT_TELL = ResultRefusedError.exit_code, NotEnoughDataError.exit_code
_CHECK_LIMIT_S = 1800.0
_COLUMNS = ("robot", "folder", "date", "finished", "status", "verdict", "cause")


class RobotState(BaseModel):
    """One robot in a roll-out.

    Attributes:
        robot: its name.
        folder: of its result in the registry.
        is_canary: whether it is one of those that come first.
        state: what became of it.
        to: where its files are.
        release: the release that was made current.
        replaces: the release that was current before; "" if there was none.
        time: of the last step, UTC.
        detail: what was wrong, and what to do.
    """

    model_config = ConfigDict(frozen=True, extra="ignore")

    robot: str
    folder: str = ""
    is_canary: bool = False
    state: State = "waiting"
    to: str = ""
    release: str = ""
    replaces: str = ""
    time: str = ""
    detail: str = ""


class Rollout(BaseModel):
    """A roll-out to one target of every robot.

    Attributes:
        target: its name.
        stopped_by: the robot whose state stopped it; "" if nothing did.
        robots: by name.
    """

    model_config = ConfigDict(extra="ignore")

    format_version: Literal[1] = 1
    target: str
    stopped_by: str = ""
    robots: dict[str, RobotState] = Field(default_factory=dict)

    @property
    def counts(self) -> Counter[str]:
        """How many robots are in which state."""
        return Counter(each.state for each in self.robots.values())


def read_rollout(registry: Registry, target: str) -> Rollout:
    """Read what was done for a target; empty if nothing was.

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
        registry: whose.
        where: condition in SQL on the rows of the table, as in `query`.
    """
    rows = query(registry, where, _COLUMNS).to_pylist()
    by_robot: dict[str, list[Mapping[str, Any]]] = {}
    for row in rows:
        by_robot.setdefault(row["robot"], []).append(row)
    return {robot: _newest(robot, by_robot[robot]) for robot in sorted(by_robot)}


def _newest(robot: str, rows: Iterable[Mapping[str, Any]]) -> RobotState:
    own = sorted(rows, key=lambda row: (row["date"] or "", row["finished"] or "", row["folder"]))
    newest = [row for row in own if row["folder"] == own[-1]["folder"]]
    known = RobotState(robot=robot, folder=own[-1]["folder"])
    for row in newest:
        if row["status"] != "ok":
            return known.model_copy(update={"state": "left_out", "detail": f"no result: {row['cause']}"})
        if row["verdict"] == "fail":
            return known.model_copy(update={"state": "left_out", "detail": "verdict fail"})
    return known


class FleetDeployment:
    """A roll-out that is under way.

    Args:
        registry: with the results.
        target: name of the target in the file; `{robot}` in it stands for each robot's name.
        file: that lists targets.
        check: command run on this computer after each deployment; `{robot}`, `{result}` and `{to}` are
            filled in. It contradicts the result with exit code 7, and cannot tell with 6, as `drift` does.

    Raises:
        UsageError: the target's name, or the check, cannot be used.
        SessionError: the registry's state of the roll-out is damaged.
    """

    def __init__(self, registry: Registry, target: str, file: Path, check: str = "") -> None:
        self._registry, self._target, self._file = registry, target, file
        try:
            self._check = shlex.split(check)
            _filled(self._check, "", "", "")
        except (ValueError, LookupError, AttributeError) as error:
            raise UsageError(
                f"--check {check!r}: {error}",
                "Close quotes; use {robot}, {result} and {to}; write {{ for a brace.",
            ) from error
        self._lock = threading.Lock()
        self.rollout = read_rollout(registry, target)

    def run(
        self,
        wanted: Mapping[str, RobotState],
        canaries: Sequence[str],
        *,
        jobs: int = 4,
        only_canaries: bool = False,
        progress: Progress = silent,
    ) -> Rollout:
        """Deploy to the canaries one after the other, and, if all went well, to the others.

        A canary stops the roll-out unless its files are in place and nothing contradicts them. Of the others,
        one that cannot be reached, or refuses the result, is recorded and passed over.

        Args:
            wanted: as `newest_results` gives them.
            canaries: robots that come first.
            jobs: robots at once, after the canaries.
            only_canaries: end after them.
            progress: called with (done, total) robots.

        Raises:
            UsageError: a canary has no result, or the file no such target.
            ProfileError: the file with the targets is invalid.
            SessionError: the registry cannot be written.
        """
        unknown = [robot for robot in canaries if robot not in wanted]
        if unknown:
            raise UsageError(f"{unknown[0]} has no result in the registry", f"Robots: {', '.join(wanted)}.")
        for robot in [robot for robot, state in wanted.items() if state.state != "left_out"][:1]:
            self._target_of(robot)  # a mistake in the file is not a robot's refusal
        first = [wanted[robot].model_copy(update={"is_canary": True}) for robot in canaries]
        others = [state for robot, state in wanted.items() if robot not in set(canaries)]
        total, done = len(first) + (0 if only_canaries else len(others)), 0
        self.rollout.stopped_by = ""
        for state in first:
            self._step(state)
            done += 1
            progress(done, total)
            if self.rollout.stopped_by:
                return self.rollout
        if only_canaries:
            return self.rollout
        with ThreadPoolExecutor(jobs) as pool:
            for is_done in pool.map(self._unless_stopped, others):
                done += is_done
                progress(done, total)
        return self.rollout

    def roll_back(self, reason: str = "", *, progress: Progress = silent) -> Rollout:
        """Restore what was there before on each robot that still has a release of this roll-out.

        Raises:
            SessionError: the registry cannot be written.
        """
        held = [state for state in self.rollout.robots.values() if state.state in (*_HELD, "not_rolled_back")]
        for done, state in enumerate(held, 1):
            self._note(self._restore(state, reason))
            progress(done, len(held))
        return self.rollout

    def _unless_stopped(self, state: RobotState) -> bool:
        if self.rollout.stopped_by:
            return False
        self._step(state)
        return True

    def _step(self, state: RobotState) -> None:
        """Deploy to one robot, keep its state, and stop the roll-out if that is a reason to."""
        ended = state if state.state == "left_out" else self._deploy(state)
        is_stopped = ended.state not in _FINE if ended.is_canary else ended.state in _STOPS
        if is_stopped:
            self.rollout.stopped_by = ended.robot
        self._note(ended)

    def _deploy(self, state: RobotState) -> RobotState:
        try:
            target = self._target_of(state.robot)
            state = state.model_copy(update={"to": target.to})
            with self._result(state.folder) as folder:
                done = deployment.deploy(folder, load_rig(folder / PROFILE), target)
                known = {"release": done.release.name, "replaces": done.replaces}
                state = state.model_copy(update=known)
                return self._checked(state, folder)
        except CommandError as error:
            return self._with_current(_ended(state, "command_failed", error))
        except LostError as error:
            return _ended(state, "unreachable", error)
        except TargetError as error:
            return _ended(state, "not_written", error)
        except LceRigError as error:
            return _ended(state, "refused", error)

    def _with_current(self, state: RobotState) -> RobotState:
        """Ask which release is in place after its command failed."""
        try:
            current = deployment.standing(self._target_of(state.robot)).state.current
        except LceRigError:
            return state
        if current is None:
            return state
        return state.model_copy(update={"release": current.name, "replaces": current.replaces})

    def _checked(self, state: RobotState, folder: Path) -> RobotState:
        """Run the check, if there is one."""
        if not self._check:
            return _ended(state, "in_place")
        words = _filled(self._check, state.robot, str(folder / RESULT), state.to)
        try:
            ran = subprocess.run(
                words, capture_output=True, text=True, errors="replace", timeout=_CHECK_LIMIT_S, check=False
            )
        except (OSError, subprocess.TimeoutExpired) as error:
            return _ended(state, "check_failed", error)
        said = (ran.stdout + ran.stderr).strip()[-2000:]
        if ran.returncode == 0:
            return _ended(state, "in_place")
        if ran.returncode == _CANNOT_TELL:
            return _ended(state, "in_place", f"the check cannot tell: {said}")
        kind: State = "contradicted" if ran.returncode == _CONTRADICTS else "check_failed"
        return _ended(state, kind, f"the check ended with exit code {ran.returncode}: {said}")

    def _restore(self, state: RobotState, reason: str) -> RobotState:
        try:
            target = self._target_of(state.robot)
            current = deployment.standing(target).state.current
            if current is None or current.name != state.release:
                now = "nothing" if current is None else current.name
                return _ended(state, "not_rolled_back", f"{now} is in place by now, not {state.release}")
            if not state.replaces:
                return _ended(state, "not_rolled_back", "it is the first release there: nothing came before")
            deployment.rollback(target, state.replaces, reason=reason)
        except CommandError as error:
            return _ended(state, "rolled_back", error)
        except LceRigError as error:
            return _ended(state, "not_rolled_back", error)
        return _ended(state, "rolled_back")

    def _target_of(self, robot: str) -> TargetSettings:
        target = find_target(self._target, self._file, None, None, robot=robot)
        return target.model_copy(update={"robot": target.robot or robot})

    @contextmanager
    def _result(self, folder: str) -> Iterator[Path]:
        place = self._registry.place / folder
        if place.local is not None:
            yield place.local
            return
        with TemporaryDirectory(prefix="lce-rig-") as scratch:
            place.fetch(Path(scratch) / "result")
            yield Path(scratch) / "result"

    def _note(self, state: RobotState) -> None:
        """Keep a robot's state in the registry."""
        with self._lock:
            self.rollout.robots[state.robot] = state
            ordered = dict(sorted(self.rollout.robots.items()))
            self.rollout.robots = ordered
            _write(self._registry, self.rollout)


def _filled(words: Iterable[str], robot: str, result: str, to: str) -> list[str]:
    return [word.format_map({"robot": robot, "result": result, "to": to}) for word in words]


def _write(registry: Registry, rollout: Rollout) -> None:
    place = registry.place / FOLDER / f"{rollout.target}.json"
    text = rollout.model_dump_json(indent=1) + "\n"
    if place.local is None:
        place.fs.pipe_file(place.path, text.encode())
        return
    with reading(place.local, SessionError):
        place.local.parent.mkdir(exist_ok=True)
        write_atomically(place.local, text)


def _ended(state: RobotState, kind: State, cause: "Exception | str" = "") -> RobotState:
    detail = f"{cause.what} {cause.hint}".strip() if isinstance(cause, LceRigError) else str(cause)
    now = f"{datetime.now(timezone.utc):%Y-%m-%dT%H:%M:%SZ}"
    return state.model_copy(update={"state": kind, "detail": detail, "time": now})
