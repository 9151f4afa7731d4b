"""Ctrl-C at random moments of every verb: it ends within 2 s, with exit code 130 and one line."""

import contextlib
import os
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

from wire.rig import ENVIRONMENT

from fuzzing.report import Report

WITHIN_S = 2.0
# Without its devices a rig is not fit to collect.
_DONE = {"doctor": 5, "repeat": 4}
_PATIENCE_S = 30.0
_LONGEST_S = 30.0
_SAID = "interrupted; everything written so far is complete"


@dataclass
class InterruptReport(Report):
    """Outcomes of interrupted programs.

    Attributes:
        n_over: programs that had ended before the moment.
        n_twice: interrupted twice.
        kinds: how many of each verb were interrupted.
        slowest_s: longest time from Ctrl-C to the end, of each verb.
    """

    n_over: int = 0
    n_twice: int = 0
    kinds: Counter[str] = field(default_factory=Counter)
    slowest_s: dict[str, float] = field(default_factory=dict)


def fuzz_interrupts(n: int, seed: int) -> InterruptReport:
    """Interrupt n programs, the verbs in turn, each at a random moment of its run.

    Every other one gets the signal as a terminal sends it, to all its processes; every fourth gets it twice.

    Args:
        n: how many.
        seed: same seed, same moments as shares of the run.
    """
    report, chance, began_s = InterruptReport(), random.Random(seed), time.monotonic()
    with tempfile.TemporaryDirectory() as folder:
        bench = _Bench(Path(folder))
        lengths_s: dict[str, float] = {}
        for k in range(n):
            verb = list(_VERBS)[k % len(_VERBS)]
            if verb not in lengths_s:
                lengths_s[verb] = _measure(bench, verb)
            moment_s = chance.uniform(0, lengths_s[verb])
            _interrupt_once(report, bench, verb, moment_s, to_all=k // len(_VERBS) % 2 == 0, twice=k % 4 == 3)
            if k % 20 == 19:
                print(f"{k + 1} programs, {report.n_wrong} wrong", file=sys.stderr, flush=True)
    report.seconds = round(time.monotonic() - began_s, 1)
    return report


class _Bench:
    """Sessions and recordings that programs work on; each gets fresh ones."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.session, self.second = folder / "simulated", folder / "second"
        self.recording = folder / "recording"
        _run("simulate", "--rig", "rlfs", self.session, "--captures", "6")
        _run("simulate", "--rig", "rlfs", self.second, "--captures", "6", "--seed", "1")
        _run("simulate", "--rig", "rles", "--recording", self.recording, "--duration", "2")
        _run("calibrate", self.session)
        self.result = folder / "result.json"
        shutil.copy(self.session / "calibration" / "result.json", self.result)
        shutil.rmtree(self.session / "calibration")
        for cache in self.session.glob("detections*"):
            shutil.rmtree(cache)

    def fresh(self) -> Path:
        """Copy the session to where the next program may spoil it."""
        copy = self.folder / "session"
        shutil.rmtree(copy, ignore_errors=True)
        shutil.copytree(self.session, copy)
        return copy

    def new(self) -> Path:
        """Return the path of a folder that does not exist yet."""
        shutil.rmtree(self.folder / "new", ignore_errors=True)
        return self.folder / "new"


_VERBS: dict[str, Callable[[_Bench], list[object]]] = {
    "check": lambda bench: ["check", bench.fresh()],
    "calibrate": lambda bench: ["calibrate", bench.fresh()],
    "calibrate paper": lambda bench: ["calibrate", bench.fresh(), "--method", "paper"],
    "intrinsics": lambda bench: ["intrinsics", bench.fresh()],
    "verify": lambda bench: ["verify", bench.fresh(), "--result", bench.result],
    "drift": lambda bench: ["drift", bench.fresh(), "--result", bench.result],
    "repeat": lambda bench: ["repeat", bench.fresh(), bench.second],
    "simulate": lambda bench: ["simulate", "--rig", "rlfs", bench.new(), "--captures", "3"],
    "collect --from": lambda bench: [
        "collect", "--rig", "rles", bench.new(), "--from", bench.recording / "recording.bag"
    ],
    "collect --simulated": lambda bench: [
        "collect", "--rig", "rlfs", bench.new(), "--simulated", "--plain", "--timeout", "20",
        "--preview", "127.0.0.1:0",
    ],
    "reconstruct": lambda bench: ["reconstruct", bench.recording / "recording.bag", "-o", bench.new()],
    "doctor": lambda bench: ["doctor", "--rig", "rlfs"],
}  # fmt: skip
_LIVE = "collect --simulated"
"""Which ends in good order: it says how it went."""


def _command(words: list[object]) -> list[str]:
    return [sys.executable, "-m", "lce_rig", *map(str, words)]


def _run(*words: object) -> None:
    subprocess.run(_command(list(words)), check=True, env=ENVIRONMENT, capture_output=True)


def _measure(bench: _Bench, verb: str) -> float:
    """Run a command to its end, and return the duration after its start."""
    process = _start(_VERBS[verb](bench))
    began_s = time.monotonic()
    try:
        process.communicate(timeout=_LONGEST_S)
    except subprocess.TimeoutExpired:
        os.killpg(process.pid, signal.SIGKILL)
        process.communicate()
    return time.monotonic() - began_s


def _start(words: list[object]) -> "subprocess.Popen[str]":
    """Start a program, and wait until lce-rig's own code has begun: Python's beginning is not ours."""
    process = subprocess.Popen(
        _command(words),
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env=ENVIRONMENT,
        start_new_session=True,
    )
    deadline_s = time.monotonic() + _PATIENCE_S
    with contextlib.suppress(OSError):
        while len(list(Path(f"/proc/{process.pid}/task").iterdir())) < 2 and process.poll() is None:
            assert time.monotonic() < deadline_s, "it does not begin"
            time.sleep(0.002)
    return process


def _interrupt_once(
    report: InterruptReport, bench: _Bench, verb: str, moment_s: float, *, to_all: bool, twice: bool
) -> None:
    process = _start(_VERBS[verb](bench))
    with contextlib.suppress(subprocess.TimeoutExpired):
        process.wait(moment_s)
    if process.poll() is not None:
        report.n_over += 1
        process.communicate()
        return
    pressed_s = time.monotonic()
    _press(process, to_all=to_all)
    if twice:
        with contextlib.suppress(subprocess.TimeoutExpired):
            process.wait(0.3)
        report.n_twice += process.poll() is None
        _press(process, to_all=to_all)
    try:
        process.wait(_PATIENCE_S)
    except subprocess.TimeoutExpired:
        os.killpg(process.pid, signal.SIGKILL)
    took_s = time.monotonic() - pressed_s
    with contextlib.suppress(ProcessLookupError):
        os.killpg(process.pid, signal.SIGKILL)
    _, said = process.communicate()
    report.n += 1
    report.kinds[verb] += 1
    report.slowest_s[verb] = round(max(took_s, report.slowest_s.get(verb, 0.0)), 2)
    what = f"{verb}, interrupted {'twice ' if twice else ''}after {moment_s:.2f} s"
    # It may have finished just before the signal.
    if process.returncode not in (130, _DONE.get(verb, 0)):
        report.wrong.append(f"{what}: it ended with {process.returncode}: {said[-1500:]}")
    elif took_s > WITHIN_S:
        report.wrong.append(f"{what}: it took {took_s:.1f} s to end")
    elif "Traceback" in said or (process.returncode == 130 and verb != _LIVE and not _is_one_line(said)):
        report.wrong.append(f"{what}: it said {said[-1500:]}")


def _press(process: "subprocess.Popen[str]", *, to_all: bool) -> None:
    with contextlib.suppress(ProcessLookupError):
        os.killpg(process.pid, signal.SIGINT) if to_all else process.send_signal(signal.SIGINT)


def _is_one_line(said: str) -> bool:
    """Check that the interrupt was reported exactly once; earlier notes may precede."""
    return said.strip().endswith(_SAID) and said.count(_SAID) == 1
