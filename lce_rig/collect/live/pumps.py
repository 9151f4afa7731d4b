"""The attached sensors of a rig, read side by side; what is lost is opened again until it is back."""

import threading
import time
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import replace
from types import TracebackType

from lce_rig.core.data import LiveSample
from lce_rig.core.errors import SourceError
from lce_rig.sources.live.base import LiveSource, Mailbox, SourceStatus

REOPEN_EVERY_S = 1.0
# Events come in batches of 10 ms: several seconds of everything.
_N_SLOTS = 4096


class Pumps:
    """Forwards the samples of every sensor into one queue; open while its `with` block lasts.

    A sensor that fails is closed and opened anew, again and again; meanwhile the others go on.

    Attributes:
        sources: by the sensor's name.
    """

    def __init__(self, sources: Sequence[LiveSource], reopen_every_s: float = REOPEN_EVERY_S) -> None:
        """Take the sources; none is opened yet."""
        self.sources = {source.sensor: source for source in sources}
        self._reopen_every_s = reopen_every_s
        self._queue: Mailbox[tuple[str, LiveSample]] = Mailbox(_N_SLOTS)
        self._lost: dict[str, tuple[SourceError, float]] = {}
        self._n_reopened = 0
        self._n_before: dict[str, tuple[int, int]] = {}
        self._lock = threading.Lock()
        self._stop = threading.Event()
        self._threads: list[threading.Thread] = []

    def __enter__(self) -> "Pumps":
        """Open every sensor.

        Raises:
            SourceError: of the first that cannot be opened; its hint names the others.
        """
        with ExitStack() as stack:
            failures: list[SourceError] = []
            for source in self.sources.values():
                try:
                    stack.enter_context(source)
                except SourceError as error:
                    failures.append(error)
            if failures:
                raise _join(failures)
            stack.pop_all()
        for source in self.sources.values():
            thread = threading.Thread(target=self._run, args=(source,), name=f"pump {source.sensor}")
            thread.daemon = True
            thread.start()
            self._threads.append(thread)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Close every sensor."""
        self._stop.set()
        for source in self.sources.values():
            source.__exit__(None, None, None)
        for thread in self._threads:
            thread.join()
        self._queue.close()

    def take(self, timeout_s: float) -> tuple[str, LiveSample] | None:
        """Take the next sample, with the sensor it comes from; None where none came in time."""
        return self._queue.take(timeout_s)

    @property
    def n_dropped(self) -> int:
        """Samples that nobody took in time."""
        return self._queue.n_dropped

    @property
    def n_reopened(self) -> int:
        """How often a lost sensor has come back."""
        with self._lock:
            return self._n_reopened

    def lost(self) -> dict[str, tuple[SourceError, float]]:
        """Name the sensors that are lost now: why, and since when by time.monotonic()."""
        with self._lock:
            return dict(self._lost)

    def statuses(self) -> dict[str, SourceStatus]:
        """Ask every sensor how it does; what it lost before it was opened again counts."""
        statuses = {name: source.status() for name, source in self.sources.items()}
        for name, (n_lost, n_dropped) in tuple(self._n_before.items()):
            status = statuses[name]
            statuses[name] = replace(
                status, n_lost=status.n_lost + n_lost, n_dropped=status.n_dropped + n_dropped
            )
        return statuses

    def _run(self, source: LiveSource) -> None:
        while not self._stop.is_set():
            try:
                for sample in source.samples():
                    self._queue.put((source.sensor, sample))
                    self._note_back(source.sensor)
                if self._stop.is_set():
                    return
                error = SourceError(f"{source.sensor} ended", "Start it again.")
            except SourceError as failure:
                error = failure
            with self._lock:
                since_s = self._lost[source.sensor][1] if source.sensor in self._lost else time.monotonic()
                self._lost[source.sensor] = error, since_s
            if not self._reopen(source):
                return

    def _note_back(self, sensor: str) -> None:
        """Call a sensor back when it sends: a program that can be started may still find no camera."""
        if sensor in self._lost:
            with self._lock:
                del self._lost[sensor]
                self._n_reopened += 1

    def _reopen(self, source: LiveSource) -> bool:
        """Open a source again; False where collection ends before that."""
        source.__exit__(None, None, None)
        before, status = self._n_before.get(source.sensor, (0, 0)), source.status()
        while not self._stop.wait(self._reopen_every_s):
            try:
                source.__enter__()
            except SourceError as error:
                with self._lock:
                    self._lost[source.sensor] = error, self._lost[source.sensor][1]
                continue
            self._n_before[source.sensor] = before[0] + status.n_lost, before[1] + status.n_dropped
            if self._stop.is_set():
                source.__exit__(None, None, None)
                return False
            return True
        return False


def _join(failures: Sequence[SourceError]) -> SourceError:
    """Make one error of several: the first, with the others in its hint."""
    first, *others = failures
    hint = "\n  ".join(text for text in (first.hint, *(f"Also: {other.what}" for other in others)) if text)
    return SourceError(first.what, f"{hint}\n  `lce-rig doctor` looks at every device.".strip())
