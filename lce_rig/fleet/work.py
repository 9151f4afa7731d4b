"""Work on one session: detect, calibrate, draw, write, in a separate process.

A session that hangs, crashes or takes too much memory ends alone, with its cause.
"""

import importlib
import json
import os
import resource
import shutil
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
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

import lce_rig as lce
import lce_rig.fleet.findings as findings
from lce_rig.core.calibration import DEFAULT_METHOD, MADE_BY, Method, Provenance, ResultFile
from lce_rig.core.errors import LceRigError, NotEnoughDataError, ProfileError, SourceError
from lce_rig.core.findings import Finding
from lce_rig.fleet.jobs import Job, folder_name
from lce_rig.fleet.registry import Registry, Row, Status, with_pairs, write_rows
from lce_rig.fleet.storage import Storage
from lce_rig.io.recording import fingerprint
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

# Files and folders that do not affect a result.
_NOT_NEEDED = frozenset({CALIBRATION, RESULTS, INTRINSICS, DEBUG, REJECTED, OVERLAYS, LOCK})
_HASH_DIGITS = 12


@dataclass(frozen=True)
class Settings:
    """Settings of a run, common to its sessions.

    Attributes:
        registry: the registry's path or address.
        method: method of the estimates.
        time_limit_s: time limit of a session.
        memory_limit_mb: memory limit of its process.
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
    """Run one session, unless the registry already holds its result.

    Args:
        job: the session.
        settings: settings of the run.
        tell: receives the row of the session, with the columns known so far, before the work begins.

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
            # Replace temporary paths by the session's path.
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
    }


def _open(job: Job, scratch: Path) -> tuple[Rig, Session | None, Provenance]:
    """Copy a session or recording to a local folder.

    Returns:
        The profile; the session, None for a recording; and its origin: for a recording, the profile's robot
        and the fingerprint of files and profile.
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
    """Describe a session, or one pair of its sensors, without a result."""
    return row | {"status": status, "cause": cause.code, "detail": cause.text}


def _calibrate(
    registry: Registry, session: Session, row: Row, settings: Settings, start_s: float
) -> list[Row]:
    detections = lce.detect_boards(session, n_threads=1)
    result = lce.calibrate_session(session, detections, options=lce.CalibrateOptions(settings.method))
    saved = result.file()
    row = row | {"profile_sha256": saved.inputs_sha256[PROFILE]}
    solved = {(c.camera, c.lidar) for c in result.pairs}
    every = [*detections.pairs, *detections.peers(session.rig.lidars)]
    pairs = dict.fromkeys((pair.camera, pair.lidar) for pair in every)
    # Report shortages in the order of their pairs.
    lacking = [
        without_result(row | {"camera": camera, "lidar": lidar}, "failed", why)
        for (camera, lidar), why in zip([p for p in pairs if p not in solved], result.shortages, strict=False)
    ]

    def fill(folder: Path) -> None:
        result.write()
        shutil.copytree(session.path / CALIBRATION, folder, dirs_exist_ok=True)
        replace_file(folder / PROFILE, dump_rig(session.rig).encode())

    return publish(registry, [row, *lacking], start_s, fill, saved=saved)


def publish(
    registry: Registry,
    rows: list[Row],
    start_s: float,
    fill: Callable[[Path], None] = lambda _folder: None,
    *,
    saved: ResultFile | None = None,
) -> list[Row]:
    """Write a result's folder and return its rows.

    Args:
        registry: the destination.
        rows: rows of one folder, as `with_pairs` describes them.
        start_s: start of the work, on the monotonic clock.
        fill: writes the other files into the folder.
        saved: the result of the session; None if it has none.
    """
    with registry.result(rows[0]["folder"]) as draft:
        fill(draft)
        spent = {
            "duration_s": round(time.monotonic() - start_s, 3),
            "finished": datetime.now(timezone.utc).strftime("%Y-%m-%dT%H:%M:%S.%fZ"),
        }
        rows = [row | spent for row in rows]
        write_rows(draft, rows)
    if saved is not None:
        rows = with_pairs(rows, saved.pairs, saved.provenance.serials)
    return [row | {"is_new": True} for row in rows]


_DETAIL_BYTES = 2000
_ONE_THREAD = dict.fromkeys(
    ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "OPENCV_FOR_THREADS_NUM"), "1"
)
# Signs of exhausted memory on stderr: OpenCV and C++ raise errors of their own; Rust (pydantic) and the C
# library print a line and end the process.
_WITHOUT_MEMORY = (
    "MemoryError",
    "Insufficient memory",
    "bad_alloc",
    "memory allocation of",
    "out of memory",
    "cannot allocate memory",
    "Cannot allocate memory",
)


class Ended(NamedTuple):
    """How a session's process ended.

    Attributes:
        rows: its return value; None if it ended early.
        known: the last row that it sent early.
        status: "ok" if it returned rows.
        cause: the failure; None if it returned rows.
    """

    rows: list[Row] | None
    known: Row
    status: Status = "ok"
    cause: Finding | None = None


def run_apart(call: str, arguments: Mapping[str, Any], time_limit_s: float, memory_limit_mb: float) -> Ended:
    """Run a function in a separate process and wait for its end.

    Args:
        call: "module:function"; called with the arguments, and a function that sends a row early.
        arguments: JSON values.
        time_limit_s: time limit, after which the process is killed.
        memory_limit_mb: memory limit of data, beyond which its allocations fail.
    """
    order = {"call": call, "arguments": dict(arguments), "memory_limit_mb": memory_limit_mb}
    try:
        done = subprocess.run(
            [sys.executable, "-c", "from lce_rig.fleet.work import main; main()"],
            input=json.dumps(order).encode(),
            capture_output=True,
            timeout=time_limit_s,
            env=os.environ | _ONE_THREAD,
            start_new_session=True,
            check=False,
        )
    except subprocess.TimeoutExpired as error:
        return Ended(
            None, _sent(error.stdout or b"")[0], "timed_out", findings.TIMED_OUT(limit_s=time_limit_s)
        )
    known, rows = _sent(done.stdout)
    if rows is not None:
        return Ended(rows, known)
    words = done.stderr[-_DETAIL_BYTES:].decode(errors="replace").strip()
    detail = words.rpartition("\n")[2]
    if any(sign in words for sign in _WITHOUT_MEMORY):
        return Ended(None, known, "out_of_memory", findings.OUT_OF_MEMORY(limit_mb=memory_limit_mb))
    if done.returncode < 0:
        return Ended(None, known, "crashed", findings.SIGNAL(signal=-done.returncode, what=detail))
    return Ended(None, known, "crashed", findings.BUG(what=detail))


def _sent(output: bytes) -> tuple[Row, list[Row] | None]:
    """Read the last row that a process sent early, and its rows; None if it ended before."""
    sent: dict[str, Any] = {}
    for line in output.splitlines():
        with suppress(ValueError):  # a line that a kill cut short
            sent |= json.loads(line)
    return sent.get("known", {}), sent.get("rows")


def main() -> None:
    """Run the function named on stdin in this process, which ends with it or with its parent."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    order, parent = json.load(sys.stdin), os.getppid()

    def end_with_parent() -> None:
        while os.getppid() == parent:
            time.sleep(0.5)
        os._exit(1)

    threading.Thread(target=end_with_parent, daemon=True).start()
    # Give messages a separate descriptor: libraries print to stdout.
    messages = os.fdopen(os.dup(1), "w", buffering=1)
    os.dup2(2, 1)
    module, _, name = order["call"].partition(":")
    function = getattr(importlib.import_module(module), name)
    limit, hard = int(order["memory_limit_mb"] * 1e6), resource.getrlimit(resource.RLIMIT_DATA)[1]
    resource.setrlimit(resource.RLIMIT_DATA, (limit if hard < 0 else min(limit, hard), hard))
    try:
        rows = function(order["arguments"], lambda row: print(json.dumps({"known": row}), file=messages))
        print(json.dumps({"rows": rows}), file=messages, flush=True)
        os._exit(0)
    except BaseException:
        traceback.print_exc()
        sys.stderr.flush()
        os._exit(1)
