"""Hostile inputs to the program: each must be refused in time, with little memory and a message."""

import os
import random
import re
import resource
import shutil
import signal
import sys
import tempfile
import threading
import time
from dataclasses import dataclass, field
from pathlib import Path

from fuzzing.hostile import HOSTILE, add_result
from fuzzing.report import Report
from fuzzing.started import said, start

MOST_S, MOST_MB = 5.0, 500.0
# Above the permitted limit, so that the excess is measured; the computer must survive.
_STOP_S, _STOP_BYTES = 60.0, 3_500_000_000
_BUG = 70
# Time between two readings of a process's memory.
_POLL_S = 0.01


@dataclass
class InputReport(Report):
    """Outcome of the inputs.

    Attributes:
        longest_s, largest_mb: of all.
        outcomes: by input: seconds, MB and exit code, with the first line of the error.
    """

    longest_s: float = 0.0
    largest_mb: float = 0.0
    outcomes: dict[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class Outcome:
    """Outcome of one command.

    Attributes:
        code: its exit code; negative by a signal.
        seconds: until it ended, or was ended.
        peak_mb: largest resident memory.
        text: what it wrote.
    """

    code: int
    seconds: float
    peak_mb: float
    text: str

    @property
    def faults(self) -> list[str]:
        """What is wrong with it."""
        wrong = [f"took {self.seconds:.1f} s"] if self.seconds > MOST_S else []
        wrong += [f"took {self.peak_mb:.0f} MB"] if self.peak_mb > MOST_MB else []
        wrong += [f"ended by signal {-self.code}"] if self.code < 0 else []
        wrong += ["exit 70"] if self.code == _BUG or "Traceback" in self.text else []
        return wrong + ([] if self.text.isprintable() or _is_plain(self.text) else ["control characters"])


def _is_plain(text: str) -> bool:
    return all(each.isprintable() or each in "\n\t" for each in text)


def run_limited(words: list[str]) -> Outcome:
    """Run a command line, and end it before it harms the computer."""
    began_s = time.monotonic()
    process = start(words, in_own_session=True)
    resource.prlimit(process.pid, resource.RLIMIT_DATA, (_STOP_BYTES, _STOP_BYTES))
    timer = threading.Timer(_STOP_S, os.killpg, (process.pid, signal.SIGKILL))
    timer.start()
    peak_mb = 0.0
    while process.poll() is None:
        peak_mb = max(peak_mb, _peak_mb(process.pid))
        time.sleep(_POLL_S)
    timer.cancel()
    return Outcome(process.returncode, time.monotonic() - began_s, peak_mb, said(process))


def _peak_mb(pid: int) -> float:
    """Read the largest resident memory of a running process; its resource usage has its parent's as well."""
    try:
        status = Path(f"/proc/{pid}/status").read_text(encoding="utf-8")
    except OSError:
        return 0.0  # it has just ended
    found = re.search(r"VmHWM:\s+(\d+) kB", status)
    return int(found[1]) / 1024 if found else 0.0


def fuzz_inputs(n: int, seed: int) -> InputReport:
    """Run the program on n inputs, each in a separate process; at most all, in random order."""
    report, began_s = InputReport(), time.monotonic()
    names = list(HOSTILE)
    random.Random(seed).shuffle(names)
    with tempfile.TemporaryDirectory() as folder:
        whole = Path(folder) / "whole"
        made = run_limited(["simulate", "--rig", "rlfs", "--captures", "3", str(whole)])
        assert made.code == 0, made.text
        add_result(whole)
        for name in names[:n]:
            place = Path(folder) / name
            place.mkdir()
            outcome = run_limited(HOSTILE[name](place, whole))
            shutil.rmtree(place)
            report.n += 1
            report.longest_s = max(report.longest_s, round(outcome.seconds, 1))
            report.largest_mb = max(report.largest_mb, round(outcome.peak_mb))
            lines = [line for line in outcome.text.splitlines() if line.startswith(("error", "warning"))]
            figures = f"{outcome.seconds:.1f} s, {outcome.peak_mb:.0f} MB, exit {outcome.code}"
            report.outcomes[name] = f"{figures}: {' '.join(lines)[:300]}"
            report.wrong += [f"{name}: {fault}" for fault in outcome.faults]
            print(f"{name}: {report.outcomes[name]}", file=sys.stderr, flush=True)
    report.seconds = round(time.monotonic() - began_s, 1)
    return report
