"""`lce-rig deploy` killed repeatedly, into a folder and over ssh: the robot must always have one complete
set.

Two results of a session are deployed in turn. Killed are the program alone, the program with all that it has
started, or what serves it at the other end of the connection. Meanwhile a robot reads the current set as fast
as it can.
"""

import contextlib
import os
import random
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path

import yaml
from wire.sshd import NoServerError, Sshd

from fuzzing.report import Report
from fuzzing.started import PATIENCE_S, must_end_well, said, start
from lce_rig.core.errors import TargetError
from lce_rig.fleet.place import RECORD, USED
from lce_rig.fleet.releases import content_of

_N_CAPTURES = 8
_EVERY = 10
_VARIANTS = ((), ("--name", "other"))
_KEEP = 4
# Robots of each kind at a time.
_N_LANES = 4

Content = Mapping[str, str]


@dataclass
class DeployKillReport(Report):
    """State of the robot's files after the kills.

    Attributes:
        n_by_kind: kills, by place and by what was killed.
        n_about_swap: after the first new file had appeared at the target.
        n_new, n_old: kills after which the new set was current, or still the old one.
        n_left: kills that left something behind, which the next deployment removed.
        n_too_late: of deployments that had ended before.
        n_reads: how often the robot read the current set.
        n_rollbacks: sets restored, each compared byte for byte.
        without_ssh: why nothing was deployed over ssh; "" where it was.
    """

    n_by_kind: Counter[str] = field(default_factory=Counter)
    n_about_swap: int = 0
    n_new: int = 0
    n_old: int = 0
    n_left: int = 0
    n_too_late: int = 0
    n_reads: int = 0
    n_rollbacks: int = 0
    without_ssh: str = ""


@dataclass
class _Robot:
    """A target, what is deployed there, and how its other end is killed.

    Attributes:
        name: of the target, such as "folder0" or "ssh1".
        folder: the target's.
        lose: kills what serves the connection.
        sets: the contents that may be found.
        seconds: that a deployment takes.
        swap_s: of these after the first new file.
    """

    name: str
    folder: Path
    lose: Callable[[], object]
    sets: list[Content] = field(default_factory=list)
    seconds: float = 0.0
    swap_s: float = 0.0

    @property
    def is_far(self) -> bool:
        """Whether it is reached by ssh."""
        return self.name.startswith("ssh")


class _Reader:
    """A robot that reads the current set continuously and stores what it reads."""

    def __init__(self, robot: _Robot) -> None:
        self.wrong: list[str] = []
        self.n_reads = 0
        self._robot = robot
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)

    def __enter__(self) -> "_Reader":
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        self._thread.join()

    def _run(self) -> None:
        while not self._stop.wait(0.002):
            found = _current(self._robot.folder)
            self.n_reads += 1
            if found not in self._robot.sets:
                self.wrong.append(f"the robot read {_named(found)}")


def fuzz_deploy_kills(n: int, seed: int) -> DeployKillReport:
    """Kill deployments n times per kind of target, at random moments and around the swap.

    Args:
        n: kills into a folder, and as many over ssh.
        seed: of the moments.
    """
    report, began_s = DeployKillReport(), time.monotonic()
    with tempfile.TemporaryDirectory() as name, contextlib.ExitStack() as stack:
        folder = Path(name)
        session = folder / "session"
        must_end_well(
            start(["simulate", "--rig", "rlfs", str(session), "--captures", str(_N_CAPTURES), "--seed", "1"])
        )
        for variant in ((), ("--method", "paper", "--name", "other")):
            must_end_well(start(["calibrate", str(session), *variant]))
        robots, targets = [], {}
        for k in range(_N_LANES):
            robots.append(_Robot(f"folder{k}", folder / f"robot{k}", lambda: None))
            targets[f"folder{k}"] = {"to": str(robots[-1].folder), "keep": _KEEP, "run": "true"}
        try:
            for k in range(_N_LANES):
                server = stack.enter_context(Sshd(folder / f"ssh{k}"))
                robots.append(_Robot(f"ssh{k}", folder / f"far{k}", server.lose_connections))
                to = f"{server.to}:{robots[-1].folder}"
                targets[f"ssh{k}"] = {"to": to, "keep": _KEEP, "run": "true", "ssh": server.options}
        except NoServerError as error:
            report.without_ssh = str(error)
        (folder / "deploy.yaml").write_text(yaml.safe_dump({"targets": targets}))
        threads = [
            threading.Thread(
                target=_fuzz_robot,
                args=(session, robot, -(-n // _N_LANES), random.Random(f"{seed} {robot.name}"), report),
            )
            for robot in robots
        ]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
    report.seconds = round(time.monotonic() - began_s, 1)
    return report


def _fuzz_robot(
    session: Path, robot: _Robot, n: int, chance: random.Random, report: DeployKillReport
) -> None:
    _learn(session, robot)
    with _Reader(robot) as reader:
        for k in range(n):
            kind = ("program", "all", "other end")[k % 3] if robot.is_far else ("program", "all")[k % 2]
            _kill_once(session, robot, k, kind, chance, report)
            if k % _EVERY == _EVERY - 1:
                report.wrong += [f"{robot.name} {k}: {what}" for what in _undisturbed(session, robot, report)]
                told = [f"{robot.name}: {k + 1} kills, {report.n_wrong} wrong", *report.wrong[-3:]]
                print("\n".join(told), file=sys.stderr, flush=True)
    report.n_reads += reader.n_reads
    report.wrong += reader.wrong


def _learn(session: Path, robot: _Robot) -> None:
    """Deploy each result once, and return the only contents allowed from then on."""
    for k in range(len(_VARIANTS)):
        began_s = time.monotonic()
        process = _deploy(session, robot, k)
        drafted_s = _wait_for_draft(robot, process)
        must_end_well(process)
        robot.seconds = time.monotonic() - began_s
        robot.swap_s = 0.0 if drafted_s is None else time.monotonic() - drafted_s
        robot.sets.append(_current(robot.folder))
    assert robot.sets[0] != robot.sets[1], "both results are the same"


def _kill_once(
    session: Path, robot: _Robot, k: int, kind: str, chance: random.Random, report: DeployKillReport
) -> None:
    """Deploy the result that is not current, and kill."""
    before = robot.sets.index(_current(robot.folder))
    process = _deploy(session, robot, 1 - before)
    is_about_swap = chance.random() < 0.6
    if is_about_swap and _wait_for_draft(robot, process) is not None:
        time.sleep(chance.uniform(0, 0.7 * robot.swap_s))
        report.n_about_swap += 1
    elif not is_about_swap:
        with contextlib.suppress(subprocess.TimeoutExpired):
            process.wait(chance.uniform(0, 0.9 * robot.seconds))
    report.n_too_late += process.poll() is not None
    if kind == "other end":
        robot.lose()
        process.wait(PATIENCE_S)  # It must notice, and end in words.
        text = said(process)
        if process.returncode not in (0, 8, 9) or "Traceback" in text:
            report.wrong.append(f"{robot.name} {k}: ends with {process.returncode}: {text[-300:]}")
    elif kind == "all":
        with contextlib.suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
        process.wait(PATIENCE_S)
    else:
        process.kill()
        process.wait(PATIENCE_S)
    found = _current(robot.folder)
    report.n += 1
    report.n_by_kind[f"{'ssh' if robot.is_far else 'folder'}, {kind}"] += 1
    report.n_left += bool(_left(robot.folder))
    if found not in robot.sets:
        report.wrong.append(f"{robot.name} {k} ({kind}): current is {_named(found)}")
    elif found == robot.sets[before]:
        report.n_old += 1
    else:
        report.n_new += 1


def _undisturbed(session: Path, robot: _Robot, report: DeployKillReport) -> Iterator[str]:
    """Complete a deployment, which removes remains of killed ones; then roll back, byte for byte."""
    before = robot.sets.index(_settled(robot))
    process = _deploy(session, robot, 1 - before)
    if process.wait(PATIENCE_S) != 0:
        yield f"deploy ends with {process.returncode} afterwards: {said(process)[-300:]}"
    if _current(robot.folder) != robot.sets[1 - before]:
        yield "the deployment is not in place"
    if left := _left(robot.folder):
        yield f"left behind: {', '.join(left)}"
    process = start(["deploy", str(session), "--target", robot.name, "--rollback"])
    if process.wait(PATIENCE_S) != 0:
        yield f"rollback ends with {process.returncode}: {said(process)[-300:]}"
    report.n_rollbacks += 1
    if _current(robot.folder) != robot.sets[before]:
        yield "rollback did not restore the earlier set"


def _settled(robot: _Robot) -> Content:
    """Read the current set once a last step that outlives its program is done."""
    time.sleep(1.0)
    return _current(robot.folder)


def _current(folder: Path) -> Content:
    """Read the current set as a robot does: the folder is looked up once."""
    try:
        return content_of((folder / "current").resolve(strict=True))
    except (OSError, TargetError) as error:
        return {"unreadable": str(error)}


def _named(found: Content) -> str:
    return ", ".join(f"{name} {digest[:8]}" for name, digest in found.items()) or "nothing"


def _left(folder: Path) -> list[str]:
    """List remains of a completed deployment: releases that were never current."""
    current = (folder / "current").resolve().name
    releases = [path.parent for path in folder.glob(f"releases/*/{RECORD}")]
    return [path.name for path in releases if path.name != current and not (path / USED).exists()]


def _deploy(session: Path, robot: _Robot, variant: int) -> "subprocess.Popen[bytes]":
    words = ["deploy", str(session), "--target", robot.name, *_VARIANTS[variant]]
    return start(words, in_own_session=True)


def _wait_for_draft(robot: _Robot, process: "subprocess.Popen[bytes]") -> float | None:
    """Wait until new files appear at the target; return the time, None if the process ends first."""
    deadline_s = time.monotonic() + PATIENCE_S
    while process.poll() is None and time.monotonic() < deadline_s:
        if _left(robot.folder):
            return time.monotonic()
        time.sleep(0.001)
    return None
