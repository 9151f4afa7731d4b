"""A process for each session: one that hangs, crashes or takes too much memory ends alone, with its cause."""

import importlib
import json
import os
import resource
import signal
import subprocess
import sys
import tempfile
import threading
import time
import traceback
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from typing import IO, Any

import psutil  # type: ignore[import-untyped]

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


def run_apart(call: str, arguments: Mapping[str, Any], time_limit_s: float, memory_limit_mb: float) -> Ended:
    """Run a function in a process of its own and wait for its end.

    Args:
        call: "module:function"; it gets the arguments, and a function `tell` that sends a row early.
        arguments: JSON values.
        time_limit_s: after which the process is ended.
        memory_limit_mb: resident memory beyond which it is.
    """
    order = {"call": call, "arguments": dict(arguments), "memory_limit_mb": memory_limit_mb}
    with tempfile.TemporaryFile() as messages, tempfile.TemporaryFile() as errors:
        process = subprocess.Popen(
            [sys.executable, "-c", "from lce_rig.fleet.process import main; main()"],
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
        message = {"reason": "out_of_memory" if _is_of_memory(error) else "bug"}
        traceback.print_exc()
    print(json.dumps(message), file=messages, flush=True)
    sys.stderr.flush()
    os._exit(0 if "rows" in message else 1)


def _is_of_memory(error: BaseException | None) -> bool:
    while error is not None:
        # OpenCV has an error of its own, C++ one that Python does not know.
        if isinstance(error, MemoryError) or "Insufficient memory" in str(error) or "bad_alloc" in str(error):
            return True
        error = error.__cause__ or error.__context__
    return False
