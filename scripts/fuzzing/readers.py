"""Damaged files for every reader: none may crash, hang, eat the machine or pass for what it is not."""

import hashlib
import json
import os
import pickle
import queue
import shutil
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from fuzzing.reader_cases import (
    ACCEPTED,
    MAX_SECONDS,
    REFUSED,
    WRONG,
    Outcome,
    damaged_files,
    run_case,
    write_files,
)
from fuzzing.reader_table import READERS
from fuzzing.samples import simulated_samples
from fuzzing.seeds_of_recordings import Files

_SCRIPTS = Path(__file__).parents[1]
_START_S = 120.0
_MAX_SHOWN = 1500


@dataclass
class ReaderCounts:
    """What became of one reader's cases.

    Attributes:
        n: cases.
        n_accepted, n_refused, n_wrong: of them.
        slowest_s: and the case that took it.
        peak_mb: most memory that one case took, and the case.
    """

    n: int = 0
    n_accepted: int = 0
    n_refused: int = 0
    n_wrong: int = 0
    slowest_s: tuple[float, int] = (0.0, 0)
    peak_mb: tuple[float, int] = (0.0, 0)

    def add(self, outcome: Outcome) -> None:
        """Count one case."""
        self.n += 1
        self.n_accepted += outcome.verdict == ACCEPTED
        self.n_refused += outcome.verdict == REFUSED
        self.n_wrong += outcome.verdict == WRONG
        self.slowest_s = max(self.slowest_s, (round(outcome.seconds, 2), outcome.case))
        self.peak_mb = max(self.peak_mb, (round(outcome.grown_bytes / 1e6, 1), outcome.case))


@dataclass
class WrongCases:
    """Cases of one reader with the same cause.

    Attributes:
        reader: its name.
        what: the cause.
        n: how many.
        reproduce: the command that runs the first one alone.
        detail: traceback of the first one.
    """

    reader: str
    what: str
    n: int
    reproduce: str
    detail: str


@dataclass
class ReaderReport:
    """What became of damaged files.

    Attributes:
        n: cases.
        n_accepted: read, and sane.
        n_refused: refused in words, with a documented exit code.
        n_wrong: neither.
        wrong: those, by cause.
        readers: counts by reader.
        seeds_sha256: fingerprint of the sound inputs; another one means other cases.
        grown_bytes: always 0: the readers run in processes of their own.
        seconds: how long all of it took.
    """

    n: int = 0
    n_accepted: int = 0
    n_refused: int = 0
    n_wrong: int = 0
    wrong: list[WrongCases] = field(default_factory=list)
    readers: dict[str, Any] = field(default_factory=dict)
    seeds_sha256: str = ""
    grown_bytes: int = 0
    seconds: float = 0.0


def fuzz_readers(
    n: int, seed: int, *, names: Sequence[str] = (), seconds: float = float("inf"), jobs: int = 1
) -> ReaderReport:
    """Damage every reader's input and judge what becomes of each.

    Args:
        n: cases for each reader.
        seed: same seed, same cases.
        names: the readers; all by default.
        seconds: for all of them together, making the sound inputs left aside; each gets an equal part.
        jobs: processes side by side.
    """
    began_s = time.monotonic()
    wanted = list(names) or list(READERS)
    seeds = make_seeds(wanted)
    report = ReaderReport(seeds_sha256=_fingerprint(seeds))
    with _scratch() as folder:
        (folder / "seeds").write_bytes(pickle.dumps(seeds))
        share_s = seconds * jobs / len(wanted)
        workers: queue.SimpleQueue[_Worker] = queue.SimpleQueue()
        for _ in range(jobs):
            workers.put(_Worker(folder))

        def run(name: str) -> tuple[str, ReaderCounts, dict[str, list[Outcome]]]:
            worker = workers.get()
            try:
                return name, *_run_reader(worker, name, n, seed, share_s)
            finally:
                workers.put(worker)

        with ThreadPoolExecutor(jobs) as pool:
            for name, counts, wrong in pool.map(run, wanted):
                _add(report, name, counts, wrong, seed)
                said = f"{name}: {counts.n} cases, {counts.n_refused} refused, {counts.n_wrong} wrong"
                print(said, file=sys.stderr, flush=True)
        for _ in range(jobs):
            workers.get().stop()
    report.seconds = round(time.monotonic() - began_s, 1)
    return report


def run_one_case(name: str, seed: int, case: int, output: Path) -> ReaderReport:
    """Run one case alone, in this process, and keep its files.

    Args:
        name: of the reader.
        seed: of the run.
        case: its number.
        output: new folder for the damaged files.
    """
    seeds = make_seeds([name])
    write_files(output, damaged_files(name, seeds[name], seed, case))
    with _scratch() as folder:
        outcome = run_case(name, seeds[name], seed, case, folder / "case")
    report, counts = ReaderReport(seeds_sha256=_fingerprint(seeds)), ReaderCounts()
    counts.add(outcome)
    _add(report, name, counts, {outcome.what: [outcome]} if outcome.verdict == WRONG else {}, seed)
    print(f"{outcome.verdict}: {outcome.what}\n{outcome.detail}files: {output}", file=sys.stderr)
    return report


def make_seeds(names: Sequence[str]) -> dict[str, list[Files]]:
    """Make the sound inputs of some readers."""
    samples = simulated_samples()
    return {name: READERS[name].make(samples) for name in names}


def _fingerprint(seeds: dict[str, list[Files]]) -> str:
    digest = hashlib.sha256()
    for name, each in sorted(seeds.items()):
        for files in each:
            for path, data in sorted(files.items()):
                digest.update(f"{name} {path} {len(data)}".encode() + data)
    return digest.hexdigest()[:16]


@contextmanager
def _scratch() -> Iterator[Path]:
    """Make a folder in memory where there is one: cases are files of a few kB, by the thousand."""
    in_memory = Path("/dev/shm")
    folder = Path(
        tempfile.mkdtemp(prefix="lce-rig-fuzz-", dir=in_memory if os.access(in_memory, os.W_OK) else None)
    )
    try:
        yield folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def _run_reader(
    worker: "_Worker", name: str, n: int, seed: int, seconds: float
) -> tuple[ReaderCounts, dict[str, list[Outcome]]]:
    counts, wrong = ReaderCounts(), dict[str, list[Outcome]]()
    for outcome in worker.run(name, seed, n, seconds):
        counts.add(outcome)
        if outcome.verdict == WRONG:
            wrong.setdefault(outcome.what, []).append(outcome)
    return counts, wrong


def _add(
    report: ReaderReport, name: str, counts: ReaderCounts, wrong: dict[str, list[Outcome]], seed: int
) -> None:
    report.n += counts.n
    report.n_accepted += counts.n_accepted
    report.n_refused += counts.n_refused
    report.n_wrong += counts.n_wrong
    report.readers[name] = vars(counts)
    for what, outcomes in sorted(wrong.items(), key=lambda item: -len(item[1])):
        first = outcomes[0]
        command = f"scripts/fuzz.py readers --only {name} --seed {seed} --case {first.case}"
        report.wrong.append(WrongCases(name, what, len(outcomes), command, first.detail[-_MAX_SHOWN:]))


class _Worker:
    """A process that runs cases; it is replaced where one hangs or ends it."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._log = Path(tempfile.mkstemp(dir=folder, suffix=".log")[1])
        self._process: subprocess.Popen[str] | None = None
        self._answers: queue.SimpleQueue[str] = queue.SimpleQueue()

    def run(self, name: str, seed: int, n: int, seconds: float) -> Iterator[Outcome]:
        """Yield what becomes of n cases, or of as many as the time allows."""
        case, deadline_s = 0, time.monotonic() + seconds
        while case < n and time.monotonic() < deadline_s:
            is_new = self._process is None
            left_s = min(deadline_s - time.monotonic(), 1e9)
            self._send({"name": name, "seed": seed, "first": case, "end": n, "seconds": left_s})
            patience_s = _START_S if is_new else 2 * MAX_SECONDS
            while True:
                answer = self._next(patience_s)
                patience_s = MAX_SECONDS + 1
                if answer == "done\n":
                    return
                if not answer:
                    outcome = Outcome(case, WRONG, self._end(), self._tail())
                else:
                    outcome = Outcome(**json.loads(answer))
                case = outcome.case + 1
                yield outcome
                if not answer:
                    break

    def stop(self) -> None:
        """End the process."""
        if self._process is not None:
            self._end()

    def _send(self, job: dict[str, Any]) -> None:
        if self._process is None:
            path = f"{_SCRIPTS}:{_SCRIPTS.parent}"
            environment = {
                **os.environ,
                "PYTHONPATH": path,
                "OMP_NUM_THREADS": "1",
                "OPENBLAS_NUM_THREADS": "1",
            }
            command = [sys.executable, "-m", "fuzzing.reader_worker", self._folder / "seeds", self._folder]
            # Cases are written below a folder of this worker's own.
            own = Path(tempfile.mkdtemp(dir=self._folder))
            command[-1] = own
            with self._log.open("w") as log:
                self._process = subprocess.Popen(
                    command,
                    stdin=subprocess.PIPE,
                    stdout=subprocess.PIPE,
                    stderr=log,
                    text=True,
                    env=environment,
                )
            self._answers = queue.SimpleQueue()
            threading.Thread(target=_pass_on, args=(self._process, self._answers), daemon=True).start()
        assert self._process.stdin is not None
        self._process.stdin.write(json.dumps(job) + "\n")
        self._process.stdin.flush()

    def _next(self, within_s: float) -> str:
        """Take the next answer; "" where there is none in time, or the process has ended."""
        try:
            return self._answers.get(timeout=within_s)
        except queue.Empty:
            return ""

    def _end(self) -> str:
        """End the process, and say how it was found."""
        process, self._process = self._process, None
        assert process is not None
        try:
            code = process.wait(0.5)
            found = f"the process died of signal {-code}" if code < 0 else f"the process ended with {code}"
        except subprocess.TimeoutExpired:
            found = f"longer than {MAX_SECONDS:g} s: killed"
            process.kill()
            process.wait()
        if process.stdin is not None:
            process.stdin.close()
        return found

    def _tail(self) -> str:
        return self._log.read_text(errors="replace")[-_MAX_SHOWN:]


def _pass_on(process: "subprocess.Popen[str]", answers: "queue.SimpleQueue[str]") -> None:
    assert process.stdout is not None
    with process.stdout:
        for line in process.stdout:
            answers.put(line)
    answers.put("")
