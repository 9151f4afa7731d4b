"""A profile's own network, run in a process that can be stopped: it may hang, or ask for all memory."""

import atexit
import errno
import hashlib
import json
import os
import re
import select
import subprocess
import sys
import time
import weakref
from collections import deque
from collections.abc import Sequence
from contextlib import suppress
from typing import Any

import numpy as np

from lce_rig.detect.events.reconstruct.network_worker import MAX_BYTES, read_arrays, write_arrays
from lce_rig.detect.events.reconstruct.onnx_session import NetworkError, Port
from lce_rig.detect.events.reconstruct.voxels import FloatArray

LOAD_S = 60.0
"""Limit of starting the process, importing onnxruntime and loading a network."""
FIRST_STEP_S = 60.0
STEP_S = 20.0
"""Limit of a step: 400 times what the shipped network takes on a desktop."""
_HINT = "Use a smaller network, or omit the key to use the shipped one."
_MAX_ANSWER_BYTES = 1 << 20
_MAX_IDLE = 2


class ProcessSession:
    """A network in a process of its own; see `NetworkSession`.

    The process is stopped at the limit of time, and taken over by the next network when this one is dropped.
    """

    def __init__(self, content: bytes, n_threads: int) -> None:
        """Load.

        Args:
            content: of the file.
            n_threads: of onnxruntime.

        Raises:
            ImportError: onnxruntime is not installed.
            NetworkError: it is not an ONNX file, cannot be run, or takes too long.
        """
        self._worker = _borrow()
        self._return = weakref.finalize(self, _give_back, self._worker)
        answer = self._worker.load(content, n_threads)
        self.inputs = [Port(name, tuple(shape)) for name, shape in answer["inputs"]]
        self.outputs = [Port(name, tuple(shape)) for name, shape in answer["outputs"]]
        self._limit_s = FIRST_STEP_S

    def run(self, feeds: Sequence[FloatArray], expected: Sequence[tuple[int, ...]]) -> list[FloatArray]:
        """Compute the outputs."""
        found = self._worker.step(feeds, expected, self._limit_s)
        self._limit_s = STEP_S
        return found


class _Worker:
    """The other process, and the memory it shares with this one."""

    def __init__(self) -> None:
        self._memory_fd = os.memfd_create("lce-rig network")
        self._loaded: tuple[str, dict[str, Any]] | None = None
        # Modules are found as here; the folder in which the user happens to be is no place for them.
        environment = {**os.environ, "PYTHONPATH": os.pathsep.join(filter(os.path.isabs, sys.path))}
        self._process = subprocess.Popen(
            [sys.executable, "-m", "lce_rig.detect.events.reconstruct.network_worker", str(self._memory_fd)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            bufsize=0,
            cwd="/",
            env=environment,
            pass_fds=(self._memory_fd,),
            start_new_session=True,  # A terminal's Ctrl-C is for this process, which ends the other.
        )

    @property
    def is_alive(self) -> bool:
        return self._process.poll() is None

    def load(self, content: bytes, n_threads: int) -> dict[str, Any]:
        digest = f"{hashlib.sha256(content).hexdigest()} {n_threads}"
        if self._loaded is None or self._loaded[0] != digest:
            self._loaded = None
            request = {"do": "load", "n_threads": n_threads, "n_bytes": len(content)}
            self._loaded = digest, self._ask(request, content, LOAD_S)
        return self._loaded[1]

    def step(
        self, feeds: Sequence[FloatArray], expected: Sequence[tuple[int, ...]], limit_s: float
    ) -> list[FloatArray]:
        shapes = [feed.shape for feed in feeds]
        write_arrays(self._memory_fd, feeds, 0)
        self._ask({"do": "step", "inputs": shapes, "outputs": expected}, b"", limit_s)
        found = [np.empty(shape, np.float32) for shape in expected]
        read_arrays(self._memory_fd, found, sum(feed.nbytes for feed in feeds))
        return found

    def stop(self) -> None:
        self._process.kill()
        self._process.wait()
        for pipe in (self._process.stdin, self._process.stdout):
            if pipe is not None:
                pipe.close()
        if self._memory_fd >= 0:
            os.close(self._memory_fd)
        self._memory_fd = -1

    def _ask(self, request: dict[str, Any], content: bytes, limit_s: float) -> dict[str, Any]:
        is_answered = False
        try:
            answer = self._exchange(json.dumps(request).encode() + b"\n" + content, limit_s)
            is_answered = True
        finally:
            if not is_answered:  # An interrupted request would answer the next one.
                self.stop()
        if "missing" in answer:
            raise ImportError(f"{answer['missing']} is not installed")
        if "error" in answer:
            raise _explained(answer["error"])
        return answer

    def _exchange(self, said: bytes, limit_s: float) -> dict[str, Any]:
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        until_s, heard = time.monotonic() + limit_s, b""
        rest, poll, source = memoryview(said), select.poll(), self._process.stdout.fileno()
        poll.register(source, select.POLLIN)
        try:
            while rest:
                rest = rest[self._process.stdin.write(rest) :]
            while not heard.endswith(b"\n"):
                left_s = until_s - time.monotonic()
                if left_s <= 0 or not poll.poll(1000 * left_s):
                    raise NetworkError(f"it takes longer than {limit_s:g} s and was stopped", _HINT)
                piece = os.read(source, 65536)
                heard += piece
                if not piece or len(heard) > _MAX_ANSWER_BYTES:
                    raise BrokenPipeError
        except BrokenPipeError:
            code = self._process.wait(limit_s)
            raise NetworkError(f"its process ended with {code}", _HINT) from None
        answer: dict[str, Any] = json.loads(heard)
        return answer


_idle: deque[_Worker] = deque()


def _borrow() -> _Worker:
    """Take a process that is free, or start one: a network is loaded for every capture."""
    with suppress(IndexError):
        while True:
            worker = _idle.pop()
            if worker.is_alive:
                return worker
            worker.stop()
    return _Worker()


def _give_back(worker: _Worker) -> None:
    if worker.is_alive and len(_idle) < _MAX_IDLE:
        _idle.append(worker)
    else:
        worker.stop()


@atexit.register
def _stop_idle() -> None:
    while _idle:
        _idle.pop().stop()


def _explained(text: str) -> NetworkError:
    """Translate onnxruntime's errors about memory and files."""
    if re.search("bad_?alloc|out of memory|failed to allocate|bad allocation", text, re.IGNORECASE):
        return NetworkError(f"it needs more than {MAX_BYTES / 1e9:.1f} GB of memory", _HINT)
    if re.search(f"external data|SystemError : {errno.EMFILE}$", text, re.IGNORECASE):
        hint = "Save it as one file: onnx.save(model, path, save_as_external_data=False)."
        return NetworkError("its weights lie in other files, which are not read", hint)
    return NetworkError(text)
