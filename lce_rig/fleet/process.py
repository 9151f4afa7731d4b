"""A process for each session: one that hangs, crashes or eats memory ends alone, and the cause is known.

A server has loaded everything and forks for each session, so that none waits for imports. It ends with
whoever started it, and the session's process with it.
"""

import importlib
import json
import os
import resource
import select
import signal
import subprocess
import sys
import tempfile
import time
import traceback
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from typing import IO, Any

_POLL_S = 0.1
_DETAIL_BYTES = 2000
# Libraries that every session uses; without threads until a session runs.
_PRELOADED = ("cv2", "lce_rig.fleet.work", "lce_rig.judge.validate", "lce_rig.show.overlays.overlay_files")
_ONE_THREAD = dict.fromkeys(
    ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "OPENCV_FOR_THREADS_NUM"), "1"
)


@dataclass(frozen=True)
class Ended:
    """How a session's process ended.

    Attributes:
        rows: what it returned; None if it was ended before.
        known: what it knew of the session until then, as `Row` names it.
        exit_code: of the process; negative for a signal.
        reason: "timed_out", "out_of_memory" or "bug" where that is known; else "".
        detail: the last words of the process.
        cpu_s, peak_memory_mb: what it used.
    """

    rows: list[dict[str, Any]] | None
    known: dict[str, Any]
    exit_code: int
    reason: str = ""
    detail: str = ""
    cpu_s: float = 0.0
    peak_memory_mb: float = 0.0


class SessionServer:
    """A warm server for the sessions of one thread, one after the other."""

    def __init__(self) -> None:
        self._errors: IO[bytes] = tempfile.TemporaryFile()  # noqa: SIM115
        self._process = subprocess.Popen(
            [sys.executable, "-c", "from lce_rig.fleet.process import serve; serve()"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=self._errors,
            env=os.environ | _ONE_THREAD,
            start_new_session=True,
            bufsize=0,
        )
        self._unread = b""

    @property
    def is_alive(self) -> bool:
        """Whether it takes further sessions."""
        return self._process.poll() is None

    def close(self) -> None:
        """End the server, and the session that it runs; a second call does nothing."""
        if self._errors.closed:
            return
        assert self._process.stdin is not None and self._process.stdout is not None
        with suppress(OSError):
            self._process.stdin.close()
        self._process.stdout.close()
        self._process.wait()
        self._errors.close()

    def run(
        self, call: str, arguments: Mapping[str, Any], time_limit_s: float, memory_limit_mb: float
    ) -> Ended:
        """Run one session in a process of its own and wait for its end.

        Args:
            call: "module:function"; it gets the arguments, and a function `tell` for what it knows early.
            arguments: JSON values.
            time_limit_s: after which the process is ended.
            memory_limit_mb: resident memory beyond which it is.
        """
        assert self._process.stdin is not None
        self._errors.seek(0)
        self._errors.truncate()
        order = {"call": call, "arguments": dict(arguments), "memory_limit_mb": memory_limit_mb}
        with suppress(BrokenPipeError):
            self._process.stdin.write(json.dumps(order).encode() + b"\n")
        known: dict[str, Any] = {}
        rows: list[dict[str, Any]] | None = None
        reason, pid, deadline_s = "", None, 0.0
        while True:
            try:
                line = self._line(_POLL_S)
            except BrokenPipeError:  # the server itself was ended, by the kernel for its memory perhaps
                return Ended(None, known, self._process.wait(), reason, self._last_words())
            if line is None:
                if pid is None or reason:
                    continue
                if time.monotonic() > deadline_s:
                    reason = "timed_out"
                elif _resident_mb(pid) > memory_limit_mb:
                    reason = "out_of_memory"
                if reason:
                    with suppress(ProcessLookupError):
                        os.kill(pid, signal.SIGKILL)
                continue
            if "pid" in line:
                pid, deadline_s = line["pid"], time.monotonic() + time_limit_s
            known |= line.get("known", {})
            rows = line.get("rows", rows)
            reason = reason or line.get("reason", "")
            if "exit_code" in line:
                return Ended(
                    rows, known, line["exit_code"], reason, self._last_words(), line["cpu_s"], line["peak_mb"]
                )

    def _line(self, timeout_s: float) -> dict[str, Any] | None:
        """Read a message; None if there is none yet.

        Raises:
            BrokenPipeError: the server has ended.
        """
        assert self._process.stdout is not None
        if b"\n" not in self._unread and select.select([self._process.stdout], [], [], timeout_s)[0]:
            data = os.read(self._process.stdout.fileno(), 1 << 20)
            if not data:
                raise BrokenPipeError
            self._unread += data
        if b"\n" not in self._unread:
            return None
        first, _, self._unread = self._unread.partition(b"\n")
        message: dict[str, Any] = json.loads(first)
        return message

    def _last_words(self) -> str:
        size = self._errors.seek(0, os.SEEK_END)
        self._errors.seek(max(0, size - _DETAIL_BYTES))
        lines = self._errors.read().decode(errors="replace").strip().splitlines()
        return lines[-1] if lines else ""


def _resident_mb(pid: int) -> float:
    try:
        with open(f"/proc/{pid}/statm", "rb") as file:  # noqa: PTH123
            return int(file.read().split()[1]) * resource.getpagesize() / 1e6
    except (OSError, IndexError):
        return 0.0


def serve() -> None:
    """Take orders from stdin, one a line, and fork a process for each; end when stdin is closed."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    # Messages get a descriptor of their own: what a library prints must not come between.
    messages = os.dup(1)
    os.dup2(2, 1)
    for name in _PRELOADED:
        importlib.import_module(name)
    while order := _order():
        if not _serve_one(order, messages):
            return


def _order() -> dict[str, Any] | None:
    line = b""
    while not line.endswith(b"\n"):
        data = os.read(0, 1 << 16)  # one order at a time: the other side waits for its end
        if not data:
            return None
        line += data
    order: dict[str, Any] = json.loads(line)
    return order


def _serve_one(order: Mapping[str, Any], messages: int) -> bool:
    """Run one session; return whether somebody still waits for more."""
    alive, held = os.pipe()
    pid = os.fork()
    if pid == 0:
        os.close(alive)
        try:
            _run(order, messages)
        finally:
            os._exit(0 if sys.exc_info()[0] is None else 1)
    os.close(held)
    _send(messages, {"pid": pid})
    # The pipe closes with the session's process, stdin with whoever gave the order.
    ready, _, _ = select.select([alive, 0], [], [])
    is_wanted = alive in ready
    if not is_wanted:
        os.kill(pid, signal.SIGKILL)
    _, status, used = os.wait4(pid, 0)
    os.close(alive)
    if is_wanted:
        cpu_s = used.ru_utime + used.ru_stime
        code = os.waitstatus_to_exitcode(status)
        _send(messages, {"exit_code": code, "cpu_s": cpu_s, "peak_mb": used.ru_maxrss / 1024})
    return is_wanted


def _run(order: Mapping[str, Any], messages: int) -> None:
    """Run a session in this process, which ends after it."""
    _limit_memory(order["memory_limit_mb"])
    module, _, name = order["call"].partition(":")
    function = getattr(importlib.import_module(module), name)
    try:
        rows = function(order["arguments"], lambda known: _send(messages, {"known": known}))
        _send(messages, {"rows": rows})
    except BaseException as error:
        if _is_of_memory(error):
            _send(messages, {"reason": "out_of_memory"})
        else:
            traceback.print_exc()
            sys.stderr.flush()
            _send(messages, {"reason": "bug"})


def _limit_memory(limit_mb: float) -> None:
    """Let one large allocation fail, which fills memory faster than anyone looks."""
    with open("/proc/self/statm", "rb") as file:  # noqa: PTH123
        held = int(file.read().split()[0]) * resource.getpagesize()
    limit = held + int(limit_mb * 1e6)
    hard = resource.getrlimit(resource.RLIMIT_AS)[1]
    resource.setrlimit(
        resource.RLIMIT_AS, (limit if hard == resource.RLIM_INFINITY else min(limit, hard), hard)
    )


def _is_of_memory(error: BaseException | None) -> bool:
    import cv2

    while error is not None:
        if isinstance(error, MemoryError) or (
            isinstance(error, cv2.error) and error.code == cv2.Error.StsNoMem
        ):
            return True
        error = error.__cause__ or error.__context__
    return False


def _send(messages: int, message: Mapping[str, Any]) -> None:
    data = json.dumps(message).encode() + b"\n"
    while data:
        data = data[os.write(messages, data) :]
