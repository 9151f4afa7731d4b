"""An object in a process of its own, so that its work does not hold this process's interpreter.

Threads that read sensors ask for the interpreter often and briefly; to search images for a board, or to
calibrate, holds it for long.
"""

import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from multiprocessing import get_context, resource_tracker
from multiprocessing.connection import Connection
from multiprocessing.process import BaseProcess
from types import ModuleType, TracebackType
from typing import Any

from lce_rig.core.errors import LceRigError, SourceError

# One process already has two cores' worth of work: threads of its own would only wait for each other.
_ONE_THREAD = {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"}
_CLOSE_S = 2.0
_starting = threading.Lock()


class Worker:
    """An object of a picklable class in a process of its own; open while its `with` block lasts.

    A process that ends, as when memory is short, is started again once for the call that noticed.
    """

    def __init__(self, name: str, make: Callable[..., object], *arguments: object, nice: int = 0) -> None:
        """Prepare.

        Args:
            name: of the process, for messages.
            make: makes the object there, before its first call; a class or function of a module.
            *arguments: its arguments.
            nice: added to the process's niceness.
        """
        self._name, self._made = name, (nice, make, arguments)
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
        # A call that waits in another thread forgets the process when it ends.
        self._is_closed, process = True, self._process
        if process is not None:
            process.terminate()
            process.join(_CLOSE_S)

    def call(self, method: str, *arguments: object) -> Any:
        """Call a method of the object, and give what it returns.

        Raises:
            LceRigError: as the method does; SourceError where its process ends again and again.
        """
        with self._lock:
            for _ in range(2):
                try:
                    if self._process is None:
                        self._start()
                    self._connection.send((method, arguments))
                    answer = self._connection.recv()
                    break
                except (EOFError, OSError):
                    self._process = None
            else:
                raise SourceError(f"the process `{self._name}` ended", "Is memory short?")
        if isinstance(answer, BaseException):
            raise answer
        return answer

    def _start(self) -> None:
        """Start a process that computes in one thread and that Ctrl-C does not reach: this one ends it."""
        if self._is_closed:
            raise SourceError(f"the process `{self._name}` was ended")
        # A forked process would share locks of this one's threads.
        context = get_context("spawn")
        self._connection, theirs = context.Pipe()
        process = context.Process(target=_serve, args=(theirs, *self._made), name=self._name, daemon=True)
        with _plain_surroundings():
            process.start()
        theirs.close()
        self._process = process


@contextmanager
def _plain_surroundings() -> Iterator[None]:
    """Let a process that starts now compute in one thread, and hide interrupts and the program from it.

    Libraries read the number of threads when they are loaded. A script without a guard would run once more.
    """
    with _starting:
        # Starting the tracker later would let interrupts through again.
        resource_tracker.ensure_running()
        masked = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
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
            signal.pthread_sigmask(signal.SIG_SETMASK, masked)


def _serve(
    connection: Connection, nice: int, make: Callable[..., object], arguments: tuple[object, ...]
) -> None:
    """Answer calls until the other end is gone."""
    # The parent ends this; a closed terminal must not.
    signal.signal(signal.SIGHUP, signal.SIG_IGN)
    os.nice(nice)
    subject: object = None
    try:
        while True:
            method, values = connection.recv()
            answer: object
            try:
                subject = make(*arguments) if subject is None else subject
                answer = getattr(subject, method)(*values)
            except LceRigError as error:
                answer = error
            except Exception as error:  # The caller learns of bugs as well.
                answer = RuntimeError(f"{method}: {error!r}")
            connection.send(answer)
    except (EOFError, OSError, KeyboardInterrupt):
        return
