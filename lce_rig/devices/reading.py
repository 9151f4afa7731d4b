"""Reading attached sensors: a thread each, one queue, counts of samples and losses."""

import threading
import time
from abc import ABC, abstractmethod
from collections import Counter, deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import TracebackType
from typing import Generic, TypeVar

from lce_rig.core.data import LiveSample
from lce_rig.core.errors import SourceError
from lce_rig.core.findings import Finding
from lce_rig.devices.disk_writer import DiskWriter

_TAKE_S = 0.2
_RATE_WINDOW_S = 3.0
# Two seconds of images, six of scans: longer than a busy computer lets them wait.
_N_SLOTS = 64
REOPEN_EVERY_S = 1.0

T = TypeVar("T")
AnySource = TypeVar("AnySource", bound="LiveSource")


@dataclass(frozen=True)
class ClockState:
    """Whose time a sensor's timestamps are.

    Attributes:
        finding: whose time, and how it is tied to others.
        is_utc: whether it is the sensor's own time, tied to UTC by pulses and sentences.
    """

    finding: Finding
    is_utc: bool = False


@dataclass(frozen=True)
class SourceStatus:
    """How an attached sensor does.

    Attributes:
        sensor: its name in the profile.
        n_samples: samples handed on since it was opened.
        n_dropped: samples dropped because they were not taken in time.
        n_lost: samples or packets that never arrived, by the device's own counters or timestamps.
        rate_hz: samples a second over the last seconds; 0 before two have come.
        clock: whose time the timestamps are; None before the first.
        problems: what is wrong now.
        device: what answers: its model, serial number and firmware as far as it tells them.
        serial: its serial number; "" where it tells none, or none yet.
        rates_hz: what a device of several streams, or with a rotor, measures: by "scans", "frames", "events".
        n_packets: data packets received; None of a sensor that sends none.
        n_lost_by_line: of a sync board: pulses lost, by line.
    """

    sensor: str
    n_samples: int = 0
    n_dropped: int = 0
    n_lost: int = 0
    rate_hz: float = 0.0
    clock: ClockState | None = None
    problems: tuple[Finding, ...] = ()
    device: str = ""
    serial: str = ""
    rates_hz: Mapping[str, float] = field(default_factory=dict)
    n_packets: int | None = None
    n_lost_by_line: Mapping[str, int] = field(default_factory=dict)


class Inbox(Generic[T]):
    """A queue from reader threads to one taker; of each sender the newest items wait, older ones are dropped.

    Attributes:
        n_put, n_dropped: items by sender.
    """

    def __init__(self) -> None:
        self.n_put: Counter[str] = Counter()
        self.n_dropped: Counter[str] = Counter()
        self._n_waiting: Counter[str] = Counter()
        self._items: deque[tuple[str, T]] = deque()
        self._is_closed = False
        self._error: SourceError | None = None
        self._changed = threading.Condition()

    def put(self, sender: str, items: Iterable[T], n_slots: int = _N_SLOTS) -> None:
        """Hand items over; never blocks.

        Args:
            sender: they come from.
            items: in order.
            n_slots: so many of this sender may wait.
        """
        with self._changed:
            for item in items:
                if self._n_waiting[sender] >= n_slots:
                    place = next(k for k, (name, _) in enumerate(self._items) if name == sender)
                    del self._items[place]
                    self._n_waiting[sender] -= 1
                    self.n_dropped[sender] += 1
                self._items.append((sender, item))
                self._n_waiting[sender] += 1
                self.n_put[sender] += 1
            self._changed.notify()

    def close(self, error: SourceError | None = None) -> None:
        """End the queue: items in it can still be taken, then `error` is raised if there is one."""
        with self._changed:
            self._is_closed = True
            self._error = self._error or error
            self._changed.notify_all()

    def take(self, timeout_s: float) -> tuple[str, T] | None:
        """Take the oldest item with its sender; None where nothing came in time, or the queue has ended.

        Raises:
            SourceError: the reader failed, and all that it read before has been taken.
        """
        with self._changed:
            self._changed.wait_for(lambda: self._items or self._is_closed, timeout_s)
            if self._items:
                sender, item = self._items.popleft()
                self._n_waiting[sender] -= 1
                return sender, item
            if self._error is not None:
                raise self._error
            return None

    @property
    def is_ended(self) -> bool:
        """Whether the queue was closed and everything taken."""
        with self._changed:
            return self._is_closed and not self._items


class RateMeter:
    """How many a second came over the last seconds; may be asked from any thread.

    Args:
        now_s: the clock.
    """

    def __init__(self, now_s: Callable[[], float] = time.monotonic) -> None:
        self._now_s = now_s
        self._came: deque[tuple[float, int]] = deque()
        self._lock = threading.Lock()

    def add(self, n: int) -> None:
        """Count n that have just come."""
        with self._lock:
            self._came.append((self._now_s(), n))

    @property
    def rate_hz(self) -> float:
        """How many a second; 0 before two have come, or where none has come for long."""
        now_s = self._now_s()
        with self._lock:
            while self._came and self._came[0][0] < now_s - _RATE_WINDOW_S:
                self._came.popleft()
            if len(self._came) < 2:
                return 0.0
            first_s, last_s = self._came[0][0], self._came[-1][0]
            # Up to now where the next is overdue: what has just stopped must not look alive.
            typical_s = (last_s - first_s) / (len(self._came) - 1)
            n = sum(n for _, n in self._came) - self._came[0][1]
            return n / max(max(last_s, now_s - typical_s) - first_s, 1e-9)


class LiveSource(ABC):
    """An attached sensor, read by a thread of its own while its `with` block lasts.

    A driver opens, reads, closes and describes its device; the thread, silence, rates, the queue and opening
    again what was lost are here, the same for all.

    Attributes:
        sensor: its name in the profile.
    """

    def __init__(
        self, sensor: str, who: str, silence_s: float, what_to_check: str = "", n_slots: int = _N_SLOTS
    ) -> None:
        """Prepare; nothing is opened yet.

        Args:
            sensor: its name in the profile.
            who: the same for messages: "camera 'cam'".
            silence_s: so long without a sample is an error.
            what_to_check: the hint of that error.
            n_slots: samples that may wait to be taken; when more do, the oldest is dropped.
        """
        self.sensor = sensor
        self._who = who
        self._n_slots, self._silence_s, self._what_to_check = n_slots, silence_s, what_to_check
        self._inbox, self._is_shared, self._reopen_every_s = Inbox[LiveSample](), False, 0.0
        self._stopping = threading.Event()
        self._rate = RateMeter()
        self._heard_s = 0.0
        self._lost: tuple[SourceError, float] | None = None
        self._thread: threading.Thread | None = None

    @abstractmethod
    def open(self) -> None:
        """Open the device; it sends, or will be heard, when this returns.

        Raises:
            SourceError: it is absent, busy or of another model; the hint says what to check.
        """

    @abstractmethod
    def read(self) -> Iterable[LiveSample]:
        """Return the samples that came; waits a moment at most.

        Raises:
            SourceError: the device failed for good.
        """

    @abstractmethod
    def close(self) -> None:
        """Close the device, open or not; never raises."""

    @abstractmethod
    def describe(self) -> SourceStatus:
        """Report the state of the device, open or not; any thread may ask. Taken samples are counted here."""

    def record_packets(self, folder: Path, disk: DiskWriter) -> bool:
        """Have what the device sends recorded as it comes, from opening on; False where it sends no packets.

        Raises:
            SourceError: the file exists already, or cannot be made.
        """
        return False

    def explain_silence(self, *, has_sent: bool) -> SourceError:
        """Explain a silence of `silence_s` since the device was opened or last sent."""
        what = "fell silent" if has_sent else "sends nothing"
        return SourceError(f"{self._who} {what}: nothing for {self._silence_s:g} s", self._what_to_check)

    def feed(self, inbox: Inbox[LiveSample], reopen_every_s: float) -> None:
        """Feed a shared queue, and reopen the device whenever it is lost; call before opening."""
        self._inbox, self._is_shared, self._reopen_every_s = inbox, True, reopen_every_s

    def __enter__(self: AnySource) -> AnySource:
        """Open the device and start reading; what an own queue held and counted before is forgotten.

        Raises:
            SourceError: as `open` does.
        """
        self._stopping.clear()
        if not self._is_shared:
            self._inbox = Inbox()
        self._rate = RateMeter()
        self._open()
        thread = threading.Thread(target=self._run, name=f"read {self.sensor}", daemon=True)
        thread.start()
        self._thread = thread  # Closing, which another thread may do meanwhile, waits for one that has begun.
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Stop reading and close the device; never raises."""
        self._stopping.set()
        if self._thread is not None:
            self._thread.join()
        self.close()
        if not self._is_shared:
            self._inbox.close()

    def take(self, timeout_s: float) -> LiveSample | None:
        """Take the oldest sample; None where none came in time, or the source was closed.

        Raises:
            SourceError: why reading ended, unless it was stopped.
        """
        came = self._inbox.take(timeout_s)
        return None if came is None else came[1]

    def samples(self) -> Iterator[LiveSample]:
        """Yield samples as they come, until the source is closed.

        Raises:
            SourceError: why reading ended, unless it was stopped.
        """
        while not self._inbox.is_ended:
            sample = self.take(_TAKE_S)
            if sample is not None:
                yield sample
        self.take(0)

    def status(self) -> SourceStatus:
        """Report the state of the sensor; may be called from any thread."""
        counts = self._inbox
        return replace(
            self.describe(),
            n_samples=counts.n_put[self.sensor],
            n_dropped=counts.n_dropped[self.sensor],
            rate_hz=self._rate.rate_hz,
        )

    @property
    def lost(self) -> tuple[SourceError, float] | None:
        """Why the sensor is lost now, and since when by time.monotonic(); None while it is not."""
        return self._lost

    def note_heard(self) -> None:
        """Call the device alive, though no sample is complete yet."""
        self._heard_s = time.monotonic()

    @property
    def is_stopping(self) -> bool:
        """Whether to give up what waits for the device."""
        return self._stopping.is_set()

    def _open(self) -> None:
        try:
            self.open()
        except BaseException:  # Ctrl-C while waiting, too.
            self.close()
            raise

    def _run(self) -> None:
        """Read until asked to stop; a lost device is reopened if the queue is shared."""
        while True:
            try:
                failure = self._read_on()
            except SourceError as error:
                failure = error
            except Exception as error:  # A bug must not look like the end of the stream.
                failure = SourceError(
                    f"{self._who}: its reader failed: {error!r}", "This is a bug: report it."
                )
                failure.__cause__ = error
            if not self._is_shared:
                self._inbox.close(failure)
            if failure is None or not self._is_shared:
                return
            self._lost = failure, self._lost[1] if self._lost is not None else time.monotonic()
            self.close()
            while True:
                if self._stopping.wait(self._reopen_every_s):
                    return
                try:
                    self._open()
                    break
                except SourceError as error:
                    self._lost = error, self._lost[1]

    def _read_on(self) -> SourceError | None:
        """Read until asked to stop, or until the device is silent for too long: then explain that."""
        heard_s, has_sent = time.monotonic(), False
        while not self._stopping.is_set():
            came = list(self.read())
            now_s = time.monotonic()
            if came:
                self._inbox.put(self.sensor, came, self._n_slots)
                self._rate.add(len(came))
                heard_s, has_sent = now_s, True
                # Back only now: a program that can be started may still find no camera.
                self._lost = None
            elif now_s - max(heard_s, self._heard_s) > self._silence_s:
                return self.explain_silence(has_sent=has_sent)
        return None


class AttachedSensors:
    """The attached sensors of a rig, read side by side into one queue; open while its `with` block lasts.

    A sensor that fails is closed and opened again and again; meanwhile the others go on.

    Attributes:
        sources: by the sensor's name.
    """

    def __init__(self, sources: Sequence[LiveSource], reopen_every_s: float = REOPEN_EVERY_S) -> None:
        """Take the sources; none is opened yet."""
        self.sources = {source.sensor: source for source in sources}
        self._inbox = Inbox[LiveSample]()
        for source in sources:
            source.feed(self._inbox, reopen_every_s)

    def __enter__(self) -> "AttachedSensors":
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
                hints = [failures[0].hint, *(f"Also: {other.what}" for other in failures[1:])]
                hints.append("`lce-rig doctor --rig RIG` looks at every device.")
                raise SourceError(failures[0].what, "\n  ".join(hint for hint in hints if hint))
            self._stack = stack.pop_all()
        self._inbox.n_dropped.clear()  # What came too soon, while others were being opened, is no loss.
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Close every sensor."""
        self._stack.close()
        self._inbox.close()

    def take(self, timeout_s: float) -> tuple[str, LiveSample] | None:
        """Take the next sample, with the sensor it comes from; None where none came in time."""
        return self._inbox.take(timeout_s)

    def lost(self) -> dict[str, tuple[SourceError, float]]:
        """Name the sensors that are lost now: why, and since when by time.monotonic()."""
        lost = {name: source.lost for name, source in self.sources.items()}
        return {name: why for name, why in lost.items() if why is not None}

    def statuses(self) -> dict[str, SourceStatus]:
        """Ask every sensor how it does."""
        return {name: source.status() for name, source in self.sources.items()}
