"""`calibrate`, `verify` and `intrinsics` killed repeatedly: the disk must always hold one complete result.

Every verb is run in two variants beforehand, to its end, which gives the only contents that may ever be
found: those of one variant or the other, files that were made together. Killed runs alternate between them.
"""

import contextlib
import hashlib
import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path

from fuzzing.report import Report
from fuzzing.started import PATIENCE_S, must_end_well, said, start
from lce_rig.core.calibration import read_result
from lce_rig.core.errors import LceRigError
from lce_rig.export import write_exports
from lce_rig.rig import load_rig

_N_CAPTURES = 8
_SIGNALS = (signal.SIGKILL, signal.SIGTERM, signal.SIGINT)
_REPORT = "report.html"
_EVERY = 6
# Ctrl-C ends a command with a message; a late one finds it finished.
_MAX_STOP_S = 2.0

Content = Mapping[str, str]
"""SHA-256 of each file by its name in a folder."""


@dataclass(frozen=True)
class Verb:
    """A command and its outputs.

    Attributes:
        folder: that it replaces, in the session.
        variants: options that give other results.
    """

    folder: str
    variants: tuple[tuple[str, ...], tuple[str, ...]]


VERBS = {
    "calibrate": Verb("calibration", ((), ("--method", "paper"))),
    "verify": Verb("calibration/overlays", ((), ())),
    "intrinsics": Verb("intrinsics", (("--model", "radtan5"), ("--model", "rational"))),
}


@dataclass
class ResultKillReport(Report):
    """State of the results after the kills.

    Attributes:
        n_by_kind: of them, by verb and signal.
        n_about_swap: at the time when new files take the place of old ones.
        n_drafts: kills that left a draft behind.
        n_too_late: of processes that had ended before.
        slowest_stop_s: from Ctrl-C to the end of the process.
    """

    n_by_kind: Counter[str] = field(default_factory=Counter)
    n_about_swap: int = 0
    n_drafts: int = 0
    n_too_late: int = 0
    slowest_stop_s: float = 0.0


@dataclass
class _Known:
    """What runs that were not disturbed left.

    Attributes:
        results: content of calibration/ but overlays and previous, by variant.
        overlays: of each of them.
        intrinsics: content of intrinsics/ but previous, by variant.
        seconds: of each verb.
        swap_s: of each verb, from the first sign of a draft to its end.
    """

    results: list[Content] = field(default_factory=list)
    overlays: list[Content] = field(default_factory=list)
    intrinsics: list[Content] = field(default_factory=list)
    seconds: dict[str, float] = field(default_factory=dict)
    swap_s: dict[str, float] = field(default_factory=dict)

    def variant_of(self, content: Content) -> int | None:
        """Return the run that a result belongs to; one killed later has no report yet."""
        for variant, result in enumerate(self.results):
            if content in (result, {name: file for name, file in result.items() if name != _REPORT}):
                return variant
        return None


def fuzz_result_kills(n: int, seed: int) -> ResultKillReport:
    """Kill the three verbs n times in all, by three signals, at any moment and about the swap.

    Args:
        n: kills.
        seed: of the moments.
    """
    report, chance, began_s = ResultKillReport(), random.Random(seed), time.monotonic()
    with tempfile.TemporaryDirectory() as folder:
        session = Path(folder) / "session"
        must_end_well(
            start(["simulate", "--rig", "rlfs", str(session), "--captures", str(_N_CAPTURES), "--seed", "1"])
        )
        known = _learn(session)
        for k in range(n):
            name = list(VERBS)[k % len(VERBS)]
            number = _SIGNALS[k // len(VERBS) % len(_SIGNALS)]
            variant = k // len(VERBS) // len(_SIGNALS) % 2
            where = f"kill {k} ({name} {variant}, {number.name})"
            _kill_once(session, name, variant, number, chance, known, report)
            report.n += 1
            report.n_by_kind[f"{name} {number.name}"] += 1
            report.n_drafts += bool(_drafts(session))
            report.wrong += [f"{where}: {what}" for what in check(session, known)]
            if k % _EVERY == _EVERY - 1:
                report.wrong += [f"{where}: {what}" for what in _run_undisturbed(session, chance, known)]
                lines = [f"{k + 1} kills, {report.n_wrong} wrong", *report.wrong[-3:]]
                print("\n".join(lines), file=sys.stderr, flush=True)
    report.seconds = round(time.monotonic() - began_s, 1)
    return report


def check(session: Path, known: _Known) -> list[str]:
    """Find incomplete results in a session's folders."""
    wrong = []
    folder = session / "calibration"
    found = _own_content(folder)
    variant = known.variant_of(found)
    if variant is None:
        wrong.append(f"calibration/ is of no run: {_describe(found, known.results)}")
    else:
        shown = content_of(folder / "overlays")
        if shown and shown != known.overlays[variant]:
            wrong.append(f"overlays/ do not belong to the result: {_describe(shown, known.overlays)}")
    earlier = content_of(folder / "previous", without=("overlays",))
    if earlier and known.variant_of(earlier) is None:
        wrong.append(f"calibration/previous/ is of no run: {_describe(earlier, known.results)}")
    lens = content_of(session / "intrinsics", without=("previous",))
    if lens not in known.intrinsics:
        wrong.append(f"intrinsics/ is of no run: {_describe(lens, known.intrinsics)}")
    return wrong + _misread(session, folder)


def content_of(folder: Path, without: tuple[str, ...] = ()) -> Content:
    """Fingerprint every file below a folder; nothing where it is not there."""
    return {
        str(file.relative_to(folder)): hashlib.sha256(file.read_bytes()).hexdigest()
        for file in sorted(folder.rglob("*"))
        if file.is_file() and file.relative_to(folder).parts[0] not in without
    }


def _own_content(folder: Path) -> Content:
    return content_of(folder, without=("overlays", "previous"))


def _misread(session: Path, folder: Path) -> list[str]:
    """Read the result as a program would, and write its exports again: they must equal those on the disk."""
    try:
        saved = read_result(folder / "result.json")
        with tempfile.TemporaryDirectory() as own:
            usable = [c for c in saved.pairs if c.verdict != "fail"]
            write_exports(usable, load_rig(session / "rig.yaml"), Path(own))
            exports = content_of(Path(own))
    except LceRigError as error:
        return [str(error)]
    on_disk = dict(_own_content(folder))
    # No exports; that they belong to the run, `check` has found by their content.
    del on_disk["result.json"]
    on_disk.pop(_REPORT, None)
    return (
        []
        if on_disk == exports
        else [f"exports are not those of result.json: {_describe(on_disk, [exports])}"]
    )


def _describe(found: Content, wanted: list[Content]) -> str:
    """List the files in which a folder differs from the nearest expected one."""
    nearest = min(wanted, key=lambda each: len(set(each.items()) ^ set(found.items())))
    names = sorted({name for name, _ in set(nearest.items()) ^ set(found.items())})
    return ", ".join(f"{name} ({'missing' if name not in found else 'other'})" for name in names[:8])


def _learn(session: Path) -> _Known:
    """Run every verb in every variant to its end, and read its images."""
    import cv2

    known = _Known()
    for variant in (0, 1):
        for name in VERBS:
            must_end_well(start(_words(session, name, variant)))
            began_s = time.monotonic()
            drafted_s = _wait_for_sign(session, process := start(_words(session, name, variant)), PATIENCE_S)
            must_end_well(process)
            known.seconds[name] = time.monotonic() - began_s
            if drafted_s is not None:
                known.swap_s[name] = time.monotonic() - drafted_s
        known.results.append(_own_content(session / "calibration"))
        known.overlays.append(content_of(session / "calibration" / "overlays"))
        known.intrinsics.append(content_of(session / "intrinsics", without=("previous",)))
        for image in (session / "calibration" / "overlays").rglob("*.png"):
            assert cv2.imread(str(image)) is not None, image
        assert len(known.overlays[-1]) >= _N_CAPTURES, known.overlays[-1]
    assert known.results[0] != known.results[1], "both variants give the same result"
    assert known.intrinsics[0] != known.intrinsics[1], "both variants give the same intrinsics"
    return known


def _words(session: Path, name: str, variant: int) -> list[str]:
    return [name, str(session), *VERBS[name].variants[variant]]


def _kill_once(
    session: Path,
    name: str,
    variant: int,
    number: signal.Signals,
    chance: random.Random,
    known: _Known,
    report: ResultKillReport,
) -> None:
    is_about_swap = chance.random() < 0.5
    process = start(_words(session, name, variant))
    if is_about_swap and _wait_for_sign(session, process, PATIENCE_S) is not None:
        time.sleep(chance.uniform(0, 1.2 * known.swap_s.get(name, 0.1)))
        report.n_about_swap += 1
    elif not is_about_swap:
        with contextlib.suppress(subprocess.TimeoutExpired):
            process.wait(chance.uniform(0, 1.1 * known.seconds[name]))
    report.n_too_late += process.poll() is not None
    began_s = time.monotonic()
    process.send_signal(number)
    try:
        process.wait(PATIENCE_S)
    except subprocess.TimeoutExpired:
        report.wrong.append(f"{name} goes on for {PATIENCE_S:g} s after {number.name}")
        process.kill()
        process.wait()
    seconds, text = time.monotonic() - began_s, said(process)
    if number == signal.SIGINT:
        # Python exits with 1 if the signal arrives before any code of lce_rig runs.
        is_ours = process.returncode != 1 or "lce_rig" in text
        if process.returncode not in (0, 130, -signal.SIGINT) and is_ours:
            report.wrong.append(f"{name} ends with {process.returncode} after Ctrl-C: {text[-300:]}")
        report.slowest_stop_s = max(report.slowest_stop_s, round(seconds, 2))
        if seconds > _MAX_STOP_S:
            report.wrong.append(f"{name} goes on for {seconds:.1f} s after Ctrl-C (limit {_MAX_STOP_S:g} s)")
    if "Traceback" in text and number != signal.SIGINT:
        report.wrong.append(f"{name} ends with a traceback: {text[-300:]}")


def _run_undisturbed(session: Path, chance: random.Random, known: _Known) -> Iterator[str]:
    """Run all three commands to their end: they must succeed and remove remains."""
    variant = chance.randrange(2)
    for name in VERBS:
        process = start(_words(session, name, variant))
        if process.wait(PATIENCE_S) != 0:
            yield f"{name} ends with {process.returncode} afterwards: {said(process)[-300:]}"
    if drafts := _drafts(session):
        yield f"drafts are left: {', '.join(drafts)}"
    if _own_content(session / "calibration") != known.results[variant]:
        yield "calibrate has not written its result"
    if content_of(session / "calibration" / "overlays") != known.overlays[variant]:
        yield "verify has not drawn its overlays"


def _drafts(session: Path) -> list[str]:
    """List hidden folders and files beside the session's regular ones."""
    return sorted(
        str(entry.relative_to(session))
        for entry in session.rglob(".*")
        if entry.name != ".lock" and ".new-" not in str(entry.parent)
    )


def _wait_for_sign(session: Path, process: "subprocess.Popen[bytes]", within_s: float) -> float | None:
    """Wait until a new file appears beside the results; return the time, None if the process ends first."""
    look = _watch(session)
    before, deadline_s = look(), time.monotonic() + within_s
    while process.poll() is None and time.monotonic() < deadline_s:
        if look() != before:
            return time.monotonic()
        time.sleep(0.0005)
    return None


def _watch(session: Path) -> Callable[[], set[tuple[str, int]]]:
    folders = [session, session / "calibration", session / "intrinsics"]

    def look() -> set[tuple[str, int]]:
        found: set[tuple[str, int]] = set()
        for folder in folders:
            with contextlib.suppress(OSError), os.scandir(folder) as entries:
                found |= {(f"{folder.name}/{entry.name}", entry.inode()) for entry in entries}
        return found

    return look
