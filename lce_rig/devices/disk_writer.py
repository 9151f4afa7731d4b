"""A thread that writes the data of a live collection, so that nothing waits for a slow disk."""

import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Generic, TypeVar

from lce_rig.core.errors import LceRigError, SessionError
from lce_rig.core.findings import Finding
from lce_rig.devices import findings

#: Limit of data waiting for the disk, bytes; above it, new data are dropped.
MOST_WAITING_BYTES = 512 * 2**20

T = TypeVar("T")


class DiskWriter(Generic[T]):
    """Writes items to a session or a recording, in order of arrival.

    Open while its `with` block lasts; items still waiting at its end are written first. After a failure,
    writing stops.

    Attributes:
        path: path of the session or recording.
        n_written: items written.
        n_dropped: items dropped because the disk was too slow.
        n_waiting: items not written yet.
        failure: the error that stopped the writing; None without one.
    """

    def __init__(
        self,
        path: Path,
        write: Callable[[T], object],
        finish: Callable[[], None] = lambda: None,
        most_waiting_bytes: int = MOST_WAITING_BYTES,
    ) -> None:
        """Start the thread.

        Args:
            path: path of the session or recording, for messages.
            write: writes an item; called in the thread.
            finish: called in the thread after the last item.
            most_waiting_bytes: limit of waiting data; items beyond it are dropped.
        """
        self.path = path
        self.n_written = self.n_dropped = self.n_waiting = 0
        self.failure: LceRigError | None = None
        self._write, self._finish, self._most_waiting_bytes = write, finish, most_waiting_bytes
        self._n_waiting_bytes = 0
        self._is_closed = False
        self._lock = threading.Lock()
        self._thread = ThreadPoolExecutor(1, "write to disk")

    def __enter__(self) -> "DiskWriter[T]":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Write the waiting items, and finish; a second call has no effect."""
        with self._lock:
            if not self._is_closed:
                self._is_closed = True
                self._thread.submit(self._try, self._finish)
        self._thread.shutdown()

    def put(self, item: T, n_bytes: int = 0) -> None:
        """Queue an item for writing; never blocks. Above the limit of waiting data it is dropped."""
        with self._lock:
            if self.failure is not None or self._is_closed:
                return
            if self._n_waiting_bytes + n_bytes > self._most_waiting_bytes:
                self.n_dropped += 1
                return
            self._n_waiting_bytes += n_bytes
            self.n_waiting += 1
            self._thread.submit(self._take, item, n_bytes)

    def findings(self) -> list[Finding]:
        """List the gaps in the written data and their causes."""
        path, missing = str(self.path), list[Finding]()
        if self.n_dropped:
            missing.append(findings.RECORDING_INCOMPLETE(n=self.n_dropped, path=path))
        if self.failure is not None:
            missing.append(findings.RECORDING_STOPPED(path=path, cause=self.failure.what))
        return missing

    def _take(self, item: T, n_bytes: int) -> None:
        if self.failure is None and self._try(lambda: self._write(item)):
            self.n_written += 1
        with self._lock:
            self._n_waiting_bytes -= n_bytes
            self.n_waiting -= 1

    def _try(self, act: Callable[[], object]) -> bool:
        try:
            act()
        except LceRigError as error:
            self.failure = self.failure or error
        except Exception as error:  # No error may end the thread.
            cause = getattr(error, "strerror", None) or repr(error)
            what, hint = f"{self.path} cannot be written: {cause}", "Free space there, or use another disk."
            self.failure = self.failure or SessionError(what, hint)
        return self.failure is None
