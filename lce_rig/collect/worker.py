"""An object in a process of its own, so that its work does not hold this process's interpreter.

Threads that read sensors ask for the interpreter often and briefly; to search images for a board, or to
calibrate, holds it for long. Arrays go to the object through shared memory, a millisecond for an image and a
scan; a pipe would take ten and need both processes at once. What comes back is small.
"""

import os
import pickle
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from multiprocessing import get_context, resource_tracker
from multiprocessing.connection import Connection
from multiprocessing.process import BaseProcess
from multiprocessing.sharedctypes import RawArray
from types import ModuleType, TracebackType
from typing import Any

from lce_rig.core.errors import LceRigError, SourceError

# One process already has two cores' worth of work: threads of its own would only wait for each other.
_ONE_THREAD = {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"}
_CLOSE_S = 2.0
# What does not fit goes through the pipe.
_SHARED_BYTES = 1 << 25
_Spans = list[tuple[int, int]]
_starting = threading.Lock()


class Worker:
    """An object of a picklable class in a process of its own; open while its `with` block lasts.

    A process that ends, as when memory is short, is started again once for the call that noticed.
    """

    def __init__(self, name: str, make: Callable[..., object], *arguments: object, nice: int = 0) -> None:
        """Prepare.

        Args:
            name: of the process, for messages.
            make: makes the object there; a class or function of a module.
            *arguments: its arguments.
            nice: added to the process's niceness.
        """
        self._name, self._made, self._nice = name, (make, arguments), nice
        self._process: BaseProcess | None = None
        self._is_closed = False
        self._lock = threading.Lock()

    def __enter__(self) -> "Worker":
        """Start the process, and do not wait for it."""
        self._start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """End the process at once; a call that waits raises SourceError."""
        self._is_closed = True
        if self._process is not None:
            self._connection.close()
            self._process.terminate()
            self._process.join(_CLOSE_S)
            self._process = None

    def call(self, method: str, *arguments: object) -> Any:
        """Call a method of the object, and give what it returns.

        Raises:
            LceRigError: as the method does; SourceError where its process ends again and again.
        """
        with self._lock:
            try:
                answer = self._ask(method, arguments)
            except (EOFError, OSError):
                self._start()
                try:
                    answer = self._ask(method, arguments)
                except (EOFError, OSError):
                    raise SourceError(f"the process `{self._name}` ended", "Is memory short?") from None
        if isinstance(answer, BaseException):
            raise answer
        return answer

    def _ask(self, method: str, arguments: tuple[object, ...]) -> object:
        if self._process is None:
            self._start()
        # The content of arrays goes through shared memory where it fits; spans say where each lies.
        buffers: list[pickle.PickleBuffer] = []
        data = pickle.dumps((method, arguments), protocol=5, buffer_callback=buffers.append)
        spans, end = _Spans(), 0
        for buffer in buffers:
            raw = buffer.raw()
            if end + raw.nbytes > len(self._shared):
                data, spans = pickle.dumps((method, arguments), protocol=5), []
                break
            self._shared[end : end + raw.nbytes] = raw
            spans.append((end, end + raw.nbytes))
            end += raw.nbytes
        self._connection.send((data, spans))
        return self._connection.recv()

    def _start(self) -> None:
        if self._is_closed:
            raise SourceError(f"the process `{self._name}` was ended")
        # A forked process would share locks of this one's threads.
        context = get_context("spawn")
        ours, theirs = context.Pipe()
        shared = RawArray("B", _SHARED_BYTES)
        self._shared = memoryview(shared).cast("B")
        arguments = theirs, shared, self._nice, *self._made
        process = context.Process(target=_serve, args=arguments, name=self._name, daemon=True)
        with _plain_surroundings():
            start_without_interrupts(process)
        theirs.close()
        self._connection, self._process = ours, process


def start_without_interrupts(process: BaseProcess) -> None:
    """Start a process that Ctrl-C does not reach: a terminal sends it to both, and ours ends the other."""
    # Starting the tracker would let interrupts through again.
    resource_tracker.ensure_running()
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        process.start()
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


@contextmanager
def _plain_surroundings() -> Iterator[None]:
    """Let a process that starts now compute in one thread, and hide the program from it.

    Libraries read the number of threads when they are loaded. A script without a guard would run once more.
    """
    with _starting:
        before, main = {name: os.environ.get(name) for name in _ONE_THREAD}, sys.modules["__main__"]
        os.environ.update(_ONE_THREAD)
        sys.modules["__main__"] = ModuleType("__main__")
        try:
            yield
        finally:
            sys.modules["__main__"] = main
            for name, value in before.items():
                if value is None:
                    del os.environ[name]
                else:
                    os.environ[name] = value


def _serve(
    connection: Connection,
    array: Any,
    nice: int,
    make: Callable[..., object],
    arguments: tuple[object, ...],
) -> None:
    """Answer calls until the other end is gone."""
    # The parent ends this; a closed terminal must not.
    signal.signal(signal.SIGHUP, signal.SIG_IGN)
    os.nice(nice)
    shared = memoryview(array).cast("B")
    try:
        subject = make(*arguments)
        while True:
            data, spans = connection.recv()
            buffers = [bytearray(shared[start:end]) for start, end in spans]
            method, values = pickle.loads(data, buffers=buffers)
            answer: object
            try:
                answer = getattr(subject, method)(*values)
            except LceRigError as error:
                answer = error
            except Exception as error:  # The caller learns of bugs as well.
                answer = RuntimeError(f"{method}: {error!r}")
            connection.send(answer)
    except (EOFError, OSError, KeyboardInterrupt):
        return
