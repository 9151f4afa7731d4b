"""One thread that writes everything of a live collection to disk: captures first, then recordings."""

import threading
from collections import deque
from collections.abc import Callable
from contextlib import nullcontext, suppress
from functools import partial
from pathlib import Path
from types import TracebackType
from typing import Any, Generic, TypeVar

from lce_rig.core.errors import LceRigError, SessionError
from lce_rig.core.findings import Finding
from lce_rig.devices import findings

#: What may wait for the disk, captures apart.
MOST_WAITING_BYTES = 512 * 2**20

T = TypeVar("T")


class Sink(Generic[T]):
    """A session, a recording or a file that a `DiskWriter` writes to.

    Attributes:
        path: where.
        n_written: items written.
        n_dropped: items that the disk was too slow for.
        n_waiting: items not written yet.
        failure: why nothing more is written; None while it is.
    """

    def __init__(
        self, writer: "DiskWriter", path: Path, write: Callable[[T], object], finish: Callable[[], None]
    ) -> None:
        self.path, self.write, self.finish = path, write, finish
        self.n_written = self.n_dropped = self.n_waiting = 0
        self.failure: LceRigError | None = None
        self._writer = writer

    def put(self, item: T, n_bytes: int = 0) -> None:
        """Have an item written; never blocks. Where too much waits it is dropped, but for vital sinks."""
        self._writer.put(self, item, n_bytes)

    def findings(self) -> list[Finding]:
        """List the gaps in the written data and their causes."""
        path, missing = str(self.path), list[Finding]()
        if self.n_dropped:
            missing.append(findings.RECORDING_INCOMPLETE(n=self.n_dropped, path=path))
        if self.failure is not None:
            missing.append(findings.RECORDING_STOPPED(path=path, cause=self.failure.what))
        return missing


class DiskWriter:
    """Writes items of several sinks in the order in which they come, those of vital ones before all others.

    Open while its `with` block lasts; what waits when it ends is written first. A sink that fails takes
    nothing more, and the others go on.
    """

    def __init__(self, most_waiting_bytes: int = MOST_WAITING_BYTES) -> None:
        self._most_waiting_bytes = most_waiting_bytes
        self._n_waiting_bytes = 0
        self._sinks: list[Sink[Any]] = []
        self._vital_sinks: list[Sink[Any]] = []
        self._vital: deque[tuple[Sink[Any], Any, int]] = deque()
        self._others: deque[tuple[Sink[Any], Any, int]] = deque()
        self._changed = threading.Condition()
        self._is_closing = False
        self._thread = threading.Thread(target=self._run, name="write to disk", daemon=True)

    def add(
        self,
        path: Path,
        write: Callable[[T], object],
        finish: Callable[[], None] = lambda: None,
        *,
        is_vital: bool = False,
    ) -> Sink[T]:
        """Add a sink.

        Args:
            path: where it writes, for messages.
            write: writes an item; called in the writer's thread.
            finish: called in that thread after the last item.
            is_vital: its items go first and are never dropped, and its failure is an error.
        """
        sink = Sink(self, path, write, finish)
        self._sinks.append(sink)
        if is_vital:
            self._vital_sinks.append(sink)
        return sink

    def __enter__(self) -> "DiskWriter":
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Close, and raise nothing over another error."""
        with nullcontext() if error is None else suppress(LceRigError):
            self.close()

    def close(self) -> None:
        """Write what waits, and finish every sink; does nothing more the second time.

        Raises:
            LceRigError: a vital sink failed.
        """
        with self._changed:
            self._is_closing = True
            self._changed.notify()
        self._thread.join()
        for sink in self._vital_sinks:
            if sink.failure is not None:
                raise sink.failure

    def put(self, sink: Sink[T], item: T, n_bytes: int) -> None:
        """Queue an item; see `Sink.put`."""
        is_vital = sink in self._vital_sinks
        with self._changed:
            if sink.failure is not None or (self._is_closing and not is_vital):
                return
            if is_vital:
                n_bytes = 0
            elif self._n_waiting_bytes + n_bytes > self._most_waiting_bytes:
                sink.n_dropped += 1
                return
            (self._vital if is_vital else self._others).append((sink, item, n_bytes))
            self._n_waiting_bytes += n_bytes
            sink.n_waiting += 1
            self._changed.notify()

    def _run(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._vital or self._others or self._is_closing)
                queue = self._vital or self._others
                if not queue:
                    break
                sink, item, n_bytes = queue.popleft()
                self._n_waiting_bytes -= n_bytes
            if sink.failure is None and self._try(sink, partial(sink.write, item)):
                sink.n_written += 1
            with self._changed:
                sink.n_waiting -= 1
        for sink in self._sinks:
            self._try(sink, sink.finish)

    def _try(self, sink: Sink[Any], act: Callable[[], object]) -> bool:
        try:
            act()
        except LceRigError as error:
            sink.failure = sink.failure or error
        except Exception as error:  # Nothing that goes wrong with one sink may end the thread.
            cause = getattr(error, "strerror", None) or repr(error)
            what, hint = f"{sink.path} cannot be written: {cause}", "Free space there, or use another disk."
            sink.failure = sink.failure or SessionError(what, hint)
        return sink.failure is None
