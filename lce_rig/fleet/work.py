"""The work on one session: detect, calibrate, draw, write, in a process of its own.

A session that hangs, crashes or takes too much memory ends alone, with its cause.
"""

import importlib
import json
import os
import resource
import signal
import subprocess
import sys
import threading
import time
import traceback
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from datetime import datetime, timezone
from pathlib import Path
from tempfile import TemporaryDirectory, TemporaryFile
from typing import IO, Any

import psutil  # type: ignore[import-untyped]

import lce_rig as lce
import lce_rig.fleet.findings as findings
from lce_rig.core.calibration import DEFAULT_METHOD, MADE_BY, Method, Provenance, ResultFile
from lce_rig.core.errors import LceRigError, NotEnoughDataError, ProfileError, SourceError
from lce_rig.core.findings import Finding
from lce_rig.fleet.jobs import Job, folder_name
from lce_rig.fleet.registry import Registry, Row, Status, with_pairs, write_rows
from lce_rig.fleet.storage import Storage
from lce_rig.io.protocol import fingerprint
from lce_rig.pipeline.result_files import OVERLAYS
from lce_rig.rig import Rig, dump_rig, load_rig
from lce_rig.session import Session
from lce_rig.session.durable import replace_file
from lce_rig.session.identity import MARKER
from lce_rig.session.provenance import provenance_of
from lce_rig.session.session import (
    CALIBRATION,
    DEBUG,
    INTRINSICS,
    LOCK,
    PROFILE,
    REJECTED,
    RESULTS,
)

# Files and folders on which no result depends.
_NOT_NEEDED = frozenset({CALIBRATION, RESULTS, INTRINSICS, DEBUG, REJECTED, OVERLAYS, LOCK})
_HASH_DIGITS = 12


@dataclass(frozen=True)
class Settings:
    """Settings of a run, for all its sessions.

    Attributes:
        registry: its path or address.
        method: of the estimates.
        time_limit_s: of a session.
        memory_limit_mb: of its process.
        retry: whether sessions without a result are run again.
    """

    registry: str
    method: Method = DEFAULT_METHOD
    time_limit_s: float = 600.0
    memory_limit_mb: float = 4000.0
    retry: bool = False

    def opened(self) -> Registry:
        """Open the registry."""
        return Registry(Storage.at(self.registry))


def work_order(arguments: Mapping[str, Any], tell: Callable[[Row], None]) -> list[Row]:
    """Run one session in this process, from the JSON values of its job and settings."""
    return work(Job(**arguments["job"]), Settings(**arguments["settings"]), tell)


def work(job: Job, settings: Settings, tell: Callable[[Row], None]) -> list[Row]:
    """Run one session, unless the registry holds its result already.

    Args:
        job: the session.
        settings: of the run.
        tell: called with the row of the session, as far as it is known, before the work begins.

    Returns:
        Its rows, with `is_new`; status "failed" for errors that the user can repair.
    """
    start_s = time.monotonic()
    registry = settings.opened()
    row = first_row(job, settings)
    tell(row)
    with TemporaryDirectory(prefix="lce-rig-") as folder:
        scratch = Path(folder)
        try:
            rig, session, origin = _open(job, scratch)
            ending = origin.session_sha256[:_HASH_DIGITS]
            robot = folder_name(job.robot or origin.robot or job.fallback_robot or "unnamed")
            row = _dated(row | {"robot": robot, "rig": rig.name}, origin, ending)
            held = registry.found(robot, ending)
            rows = [] if held is None else registry.rows(held)
            if rows and all(
                (each.get("program"), each.get("method")) == (row["program"], row["method"])
                and (each.get("status") == "ok" or not settings.retry)
                for each in rows
            ):
                return [{**each, "is_new": False} for each in rows]
            tell(row)
            if session is None:
                session = lce.collect_from(rig, scratch / Storage(job.source).name, scratch / "session")
                row = _dated(row, provenance_of(session), ending)
                tell(row)
            return _calibrate(registry, session, row, settings, start_s)
        except (LceRigError, OSError) as error:
            if isinstance(error, OSError):
                error = SourceError(f"{job.source} cannot be read: {error.strerror or error}")
            kind = next(kind for each, kind in findings.OF_ERRORS.items() if isinstance(error, each))
            cause = error.finding if isinstance(error, NotEnoughDataError) else None
            failed = without_result(row, "failed", cause or kind(what=error.what, hint=error.hint))
            # Name files by where the session lies.
            failed["detail"] = failed["detail"].replace(str(scratch / "session"), job.source)
            return publish(registry, [failed], start_s)


def first_row(job: Job, settings: Settings) -> Row:
    """Describe a session that has not been read yet."""
    robot = folder_name(job.robot or job.fallback_robot or "unnamed")
    return {
        "robot": robot,
        "folder": f"{robot}/unread-{folder_name(job.source)[-40:]}",
        "source": job.source,
        "program": MADE_BY,
        "method": settings.method,
        "status": "ok",
        "collector": job.collector or None,
        "site": job.site or None,
    }


def _open(job: Job, scratch: Path) -> tuple[Rig, Session | None, Provenance]:
    """Copy a session or recording to a folder of this computer.

    Returns:
        The profile; the session, None for a recording; its origin, of a recording the robot that the profile
        names and the fingerprint of files and profile.
    """
    source, copy = Storage.at(job.source), scratch / "session"
    rig = None
    if "://" in job.rig:
        Storage(job.rig).fetch(scratch / "profile.yaml")
        rig = load_rig(scratch / "profile.yaml")
    elif job.rig:
        rig = load_rig(job.rig)
    if (source / MARKER).exists():
        source.fetch(copy, without=_NOT_NEEDED)
        if rig is not None:
            replaced = load_rig(copy / PROFILE)
            if replaced.name != rig.name:
                raise ProfileError(
                    f"the manifest's profile is of rig {rig.name!r}, the session's of rig {replaced.name!r}",
                    "Name the profile of the session's rig, or none.",
                )
            replace_file(copy / PROFILE, dump_rig(rig).encode())
        session = Session.open(copy)
        return session.rig, session, provenance_of(session)
    if rig is None:
        raise ProfileError(
            f"{job.source} is not a session, and the manifest names no profile for it",
            "Add `rig:` with a shipped name or a file to its entry.",
        )
    if not source.exists():
        raise SourceError(f"{job.source} does not exist")
    recording, profile = scratch / source.name, scratch / PROFILE
    source.fetch(recording)
    files = sorted(path for path in recording.rglob("*") if path.is_file()) or [recording]
    profile.write_bytes(dump_rig(rig).encode())
    return rig, None, Provenance(rig.robot or "", session_sha256=fingerprint([*files, profile]))


def _dated(row: Row, provenance: Provenance, ending: str) -> Row:
    compact = (provenance.date or "undated").replace("-", "").replace(":", "")
    return row | {
        "date": provenance.date,
        "session_sha256": provenance.session_sha256,
        "folder": f"{row['robot']}/{compact}-{ending}",
    }


def without_result(row: Row, status: Status, cause: Finding) -> Row:
    """Describe a session, or one pair of its sensors, that has no result."""
    return row | {"status": status, "cause": cause.code, "detail": cause.text}


def _calibrate(
    registry: Registry, session: Session, row: Row, settings: Settings, start_s: float
) -> list[Row]:
    detections = lce.detect(session, n_threads=1)
    result = lce.calibrate(session, detections, options=lce.CalibrateOptions(settings.method))
    saved = result.file()
    row = row | {"profile_sha256": saved.inputs_sha256[PROFILE]}
    solved = {(c.camera, c.lidar) for c in result.pairs}
    every = [*detections.pairs, *detections.lidar_pairs(session.rig.lidars)]
    pairs = dict.fromkeys((pair.camera, pair.lidar) for pair in every)
    # Shortages stand in the order of the pairs they belong to.
    lacking = [
        without_result(row | {"camera": camera, "lidar": lidar}, "failed", why)
        for (camera, lidar), why in zip([p for p in pairs if p not in solved], result.shortages, strict=False)
    ]

    def fill(folder: Path) -> None:
        result.write(folder)
        replace_file(folder / PROFILE, dump_rig(session.rig).encode())

    return publish(registry, [row, *lacking], start_s, fill, saved=saved)


def publish(
    registry: Registry,
    rows: list[Row],
    start_s: float,
    fill: Callable[[Path], None] = lambda _folder: None,
    *,
    saved: ResultFile | None = None,
    used: tuple[float, float] | None = None,
) -> list[Row]:
    """Write a result's folder and return its rows.

    Args:
        registry: where.
        rows: of one folder, as `with_pairs` describes them.
        start_s: begin of the work, on the monotonic clock.
        fill: writes the other files into the folder.
        saved: the result of the session; None if it has none.
        used: processor time (s) and memory (MB) of the process that did the work; None for this one.
    """
    with registry.result(rows[0]["folder"]) as draft:
        fill(draft)
        spent_here = resource.getrusage(resource.RUSAGE_SELF)
        cpu_s, memory_mb = used or (spent_here.ru_utime + spent_here.ru_stime, spent_here.ru_maxrss / 1024)
        spent = {
            "duration_s": round(time.monotonic() - start_s, 3),
            "cpu_s": round(cpu_s, 3),
            "peak_memory_mb": round(memory_mb, 1),
            "finished": datetime.now(timezone.utc).strftime("%Y-%m-%dT%H:%M:%S.%fZ"),
        }
        rows = [row | spent for row in rows]
        write_rows(draft, rows)
    if saved is not None:
        rows = with_pairs(rows, saved.pairs, saved.provenance.serials)
    return [row | {"is_new": True} for row in rows]


_POLL_S = 0.1
_DETAIL_BYTES = 2000
_ONE_THREAD = dict.fromkeys(
    ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "OPENCV_FOR_THREADS_NUM"), "1"
)


@dataclass(frozen=True)
class Ended:
    """The end of a session's process.

    Attributes:
        rows: its return value; None if it ended before.
        known: the last row that it sent before it ended.
        exit_code: of the process; negative for a signal.
        reason: "timed_out", "out_of_memory" or "bug" if that is known; else "".
        detail: the last line that it printed.
        cpu_s, peak_memory_mb: used by it.
    """

    rows: list[dict[str, Any]] | None
    known: dict[str, Any]
    exit_code: int
    reason: str
    detail: str
    cpu_s: float
    peak_memory_mb: float

    def cause(self, time_limit_s: float, memory_limit_mb: float) -> tuple[Status, Finding]:
        """Say why there are no rows, as a status and a finding."""
        if self.reason == "timed_out":
            return "timed_out", findings.TIMED_OUT(limit_s=time_limit_s)
        if self.reason == "out_of_memory" or "std::bad_alloc" in self.detail:  # C++ without memory
            return "out_of_memory", findings.OUT_OF_MEMORY(limit_mb=memory_limit_mb)
        if self.reason == "bug":
            return "crashed", findings.BUG(what=self.detail)
        if self.exit_code < 0:
            return "crashed", findings.SIGNAL(signal=-self.exit_code, what=self.detail)
        return "crashed", findings.EXITED(code=self.exit_code, what=self.detail)


def run_apart(call: str, arguments: Mapping[str, Any], time_limit_s: float, memory_limit_mb: float) -> Ended:
    """Run a function in a process of its own and wait for its end.

    Args:
        call: "module:function"; it gets the arguments, and a function `tell` that sends a row early.
        arguments: JSON values.
        time_limit_s: after which the process is ended.
        memory_limit_mb: resident memory beyond which it is.
    """
    order = {"call": call, "arguments": dict(arguments), "memory_limit_mb": memory_limit_mb}
    with TemporaryFile() as messages, TemporaryFile() as errors:
        process = subprocess.Popen(
            [sys.executable, "-c", "from lce_rig.fleet.work import main; main()"],
            stdin=subprocess.PIPE,
            stdout=messages,
            stderr=errors,
            env=os.environ | _ONE_THREAD,
            start_new_session=True,
        )
        assert process.stdin is not None
        reason, deadline_s = "", time.monotonic() + time_limit_s
        try:
            with suppress(BrokenPipeError):
                process.stdin.write(json.dumps(order).encode() + b"\n")
                process.stdin.flush()
            while True:
                pid, status, used = os.wait4(process.pid, os.WNOHANG)
                if pid:
                    break
                with suppress(psutil.Error):
                    if time.monotonic() > deadline_s:
                        reason = "timed_out"
                    elif psutil.Process(process.pid).memory_info().rss > memory_limit_mb * 1e6:
                        reason = "out_of_memory"
                if reason:
                    os.killpg(process.pid, signal.SIGKILL)
                time.sleep(_POLL_S)
            process.returncode = os.waitstatus_to_exitcode(status)
        finally:
            with suppress(BrokenPipeError):
                process.stdin.close()  # ends the process, if this one is interrupted
        known: dict[str, Any] = {}
        for line in _content(messages).splitlines():
            with suppress(ValueError):  # a line that a kill cut short
                known |= json.loads(line)
        words = _content(errors)[-_DETAIL_BYTES:].decode(errors="replace").strip().splitlines()
        return Ended(
            known.get("rows"),
            known.get("known", {}),
            process.returncode,
            reason or known.get("reason", ""),
            words[-1] if words else "",
            used.ru_utime + used.ru_stime,
            used.ru_maxrss / 1024,
        )


def _content(file: IO[bytes]) -> bytes:
    file.seek(0)
    return file.read()


def main() -> None:
    """Run the function that stdin names in this process, which ends with it or when stdin is closed."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    order = json.loads(sys.stdin.buffer.readline())
    threading.Thread(target=lambda: (sys.stdin.buffer.read(), os._exit(1)), daemon=True).start()
    # Messages get a descriptor of their own: libraries print to stdout.
    messages = os.fdopen(os.dup(1), "w", buffering=1)
    os.dup2(2, 1)
    module, _, name = order["call"].partition(":")
    function = getattr(importlib.import_module(module), name)
    # One large allocation fails, which would fill the memory faster than the other process looks.
    limit = psutil.Process().memory_info().vms + int(order["memory_limit_mb"] * 1e6)
    hard = resource.getrlimit(resource.RLIMIT_AS)[1]
    resource.setrlimit(
        resource.RLIMIT_AS, (limit if hard == resource.RLIM_INFINITY else min(limit, hard), hard)
    )
    try:
        rows = function(order["arguments"], lambda row: print(json.dumps({"known": row}), file=messages))
        message: dict[str, Any] = {"rows": rows}
    except BaseException as error:
        causes = [error]
        while (cause := causes[-1].__cause__ or causes[-1].__context__) is not None:
            causes.append(cause)
        # OpenCV has an error of its own, C++ one that Python does not know.
        is_of_memory = any(
            isinstance(cause, MemoryError) or "Insufficient memory" in str(cause) or "bad_alloc" in str(cause)
            for cause in causes
        )
        message = {"reason": "out_of_memory" if is_of_memory else "bug"}
        traceback.print_exc()
    print(json.dumps(message), file=messages, flush=True)
    sys.stderr.flush()
    os._exit(0 if "rows" in message else 1)
