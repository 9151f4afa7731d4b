"""Kill `lce-rig collect` repeatedly while it captures: listed captures are complete, none is lost."""

import random
import re
import signal
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

from wire.collecting import Collecting
from wire.reel import make_reel
from wire.rig import WireRig, small_rig

from fuzzing.report import Report
from lce_rig.core.errors import SessionError
from lce_rig.session import Session

_LOOPS_PER_HOLD = 3
_WITHIN_S = 2.0
_WRITING_S = 0.35
_PATIENCE_S = 300.0


@dataclass
class KillReport(Report):
    """State of the session after the kills.

    Attributes:
        n_captures: listed in the end.
        n_said: captures reported as saved before the kill.
        n_writing: kills while a capture was being written, by the drafts that were left behind.
    """

    n_captures: int = 0
    n_said: int = 0
    n_writing: int = 0


def fuzz_kills(n: int, seed: int) -> KillReport:
    """Kill a collection n times, on sensors that send over UDP and a pipe.

    Every other kill comes at a random moment within two seconds, the others about when a capture is written.
    """
    report, chance, began_s = KillReport(), random.Random(seed), time.monotonic()
    with tempfile.TemporaryDirectory() as folder:
        rig = small_rig(is_guided=False)
        reel = make_reel(Path(folder) / "reel", rig, n_placements=4)
        with WireRig(Path(folder), rig, reel, _LOOPS_PER_HOLD) as wire:
            session, safe = Path(folder) / "session", set[str]()
            for k in range(n):
                safe |= _kill_once(wire.profile, session, chance, is_at_capture=k % 2 == 1)
                report.n += 1
                report.n_writing += len(list((session / "captures").glob(".new-*")))
                report.wrong += _check(session, safe)
                report.n_said = len(safe)
                if k % 10 == 9:
                    print(f"{k + 1} kills, {report.n_wrong} wrong", file=sys.stderr, flush=True)
            report.n_captures = len(Session.open(session).captures)
            for capture in Session.open(session).captures:
                try:
                    capture.check()
                except SessionError as error:
                    report.wrong.append(str(error))
    report.seconds = round(time.monotonic() - began_s, 1)
    return report


def _kill_once(profile: Path, session: Path, chance: random.Random, *, is_at_capture: bool) -> set[str]:
    """Collect and kill; return the captures reported as saved."""
    with Collecting(profile, session, "--hold", "0") as collecting:
        if is_at_capture:
            collecting.wait_for("holding: ", _PATIENCE_S)
            time.sleep(chance.uniform(0, _WRITING_S))
        else:
            collecting.wait_for("moving: ", _PATIENCE_S)
            time.sleep(chance.uniform(0, _WITHIN_S))
        collecting.end(signal.SIGKILL)
        return set(re.findall(r"captured (\d{6}) \(", collecting.said))


def _check(session: Path, safe: set[str]) -> list[str]:
    """Read the newest captures, and find missing ones."""
    opened = Session.open(session)
    captures = opened.captures
    wrong = [f"{name} was said to be safe and is gone" for name in safe - {each.name for each in captures}]
    journal = {entry["capture"] for entry in opened.read_journal() if entry["event"] == "captured"}
    wrong += [f"{name} is in the journal only" for name in journal - {each.name for each in captures}]
    for capture in captures[-5:]:
        try:
            capture.check()
        except SessionError as error:
            wrong.append(str(error))
    return wrong
