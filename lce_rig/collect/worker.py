"""Run an object in a separate process, so that its work does not block this process's interpreter.

Threads that read sensors need the interpreter often and briefly; searching images for a board and calibrating
hold it for long.
"""

import os
import signal
import subprocess
import sys
import threading
import traceback
from collections.abc import Callable
from multiprocessing.connection import Connection, Pipe
from typing import Any

from lce_rig.core.errors import LceRigError, SourceError

# Thread settings of numerical libraries, read when they are loaded: this process and the worker already
# occupy two cores, so more threads would only wait.
_ONE_THREAD = {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"}


class Worker:
    """An object of a picklable class in a separate process; open while its `with` block lasts.

    A process that ends, for example for lack of memory, is restarted once for the current call.
    """

    def __init__(self, name: str, make: Callable[..., object], *arguments: object, nice: int = 0) -> None:
        """Prepare.

        Args:
            name: name of the process, for messages.
            make: creates the object in that process; a class or function of a module.
            *arguments: its arguments.
            nice: added to the process's niceness.
        """
        self._name, self._made = name, (nice, make, arguments)
        self._process: subprocess.Popen[bytes] | None = None
        self._is_closed = False
        self._lock = threading.Lock()

    def __enter__(self) -> "Worker":
        """Start the process without waiting for it."""
        self._start()
        return self

    def __exit__(self, *_: object) -> None:
        """End the process at once; a pending call raises SourceError."""
        # A call waiting in another thread clears the process at its end.
        self._is_closed, process = True, self._process
        if process is not None:
            process.kill()
            process.wait()

    def call(self, method: str, *arguments: object) -> Any:
        """Call a method of the object, and return its result.

        Raises:
            LceRigError: the method raised it; SourceError if its process ends twice.
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
                    self._forget()
            else:
                raise SourceError(f"the process `{self._name}` ended", "Is memory short?")
        if isinstance(answer, BaseException):
            raise answer
        return answer

    def _start(self) -> None:
        """Start a single-threaded process that ignores Ctrl-C; this process ends it."""
        if self._is_closed:
            raise SourceError(f"the process `{self._name}` was ended")
        self._connection, theirs = Pipe()
        with theirs:
            # A forked process would share locks of this one's threads.
            self._process = subprocess.Popen(
                [sys.executable, "-m", __name__, str(theirs.fileno())],
                env={**os.environ, **_ONE_THREAD, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))},
                pass_fds=[theirs.fileno()],
                start_new_session=True,
            )
        self._connection.send(self._made)

    def _forget(self) -> None:
        """Clean up after a process that has ended."""
        process, self._process = self._process, None
        self._connection.close()
        if process is not None:
            process.wait()


def _serve(connection: Connection) -> None:
    """Answer calls until the connection is closed."""
    # The parent ends this; a closed terminal must not.
    signal.signal(signal.SIGHUP, signal.SIG_IGN)
    subject: object = None
    try:
        nice, make, arguments = connection.recv()
        os.nice(nice)
        while True:
            method, values = connection.recv()
            answer: object
            try:
                subject = make(*arguments) if subject is None else subject
                answer = getattr(subject, method)(*values)
            except LceRigError as error:
                answer = error
            except Exception:  # The caller learns of bugs as well.
                answer = RuntimeError(f"{method}: {traceback.format_exc()}")
            connection.send(answer)
    except (EOFError, OSError, KeyboardInterrupt):
        return


if __name__ == "__main__":
    _serve(Connection(int(sys.argv[1])))
