"""Read attached sensors: one thread per sensor, one queue, counts of samples and losses."""

import threading
import time
from abc import ABC, abstractmethod
from collections import Counter, deque
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Generic, TypeVar

from lce_rig.core.data import LiveSample
from lce_rig.core.errors import SourceError
from lce_rig.core.findings import Finding
from lce_rig.io.findings import LIDAR_UTC

# Window of the displayed rate, s: 15 scans at 5 Hz; a longer one shows changes later.
_RATE_WINDOW_S = 3.0
# Capacity of the queue: two seconds of images, six of scans, longer than the delays of a busy computer.
_N_SLOTS = 64
MAX_LOST_SHARE, MAX_OFF_RATE = 0.01, 0.05
"""Share of lost or damaged data above which a device has a problem, and largest relative error of its rate.

A rotor holds its speed within some tenths of a percent, cameras theirs within a few percent.
"""
CAMERA_SILENCE_S = 5.0
"""Longest silence before a camera counts as lost."""
READ_WAIT_S = 0.25
"""Longest wait of a driver for data: a source's thread ends no later."""
REOPEN_EVERY_S = 1.0

T = TypeVar("T")


@dataclass(frozen=True)
class SourceStatus:
    """State of an attached sensor.

    Attributes:
        sensor: the sensor's name in the profile.
        n_samples: samples delivered since opening.
        n_dropped: samples dropped because they were not read in time.
        n_lost: samples or packets that never arrived, by the device's own counters or timestamps.
        rate_hz: samples per second over the last seconds; 0 before the second sample.
        clock: clock of the timestamps, and its relation to others; None before the first sample.
        problems: present problems.
        device: model, serial number and firmware of the attached device, as far as it reports them.
        serial: its serial number; "" if it has not reported one.
        rates_hz: rates measured by a device of several streams, or with a rotor: "scans", "frames", "events".
        n_packets: data packets received; None for a sensor without packets.
        n_lost_by_line: lost pulses of a sync board, by line.
    """

    sensor: str
    n_samples: int = 0
    n_dropped: int = 0
    n_lost: int = 0
    rate_hz: float = 0.0
    clock: Finding | None = None
    problems: tuple[Finding, ...] = ()
    device: str = ""
    serial: str = ""
    rates_hz: Mapping[str, float] = field(default_factory=dict)
    n_packets: int | None = None
    n_lost_by_line: Mapping[str, int] = field(default_factory=dict)

    @property
    def is_utc(self) -> bool:
        """Whether timestamps are the sensor's own time, tied to UTC by pulses and sentences."""
        return self.clock is not None and self.clock.code == LIDAR_UTC.code


class Inbox(Generic[T]):
    """A queue from reader threads to one consumer; it keeps each sender's newest items and drops older ones.

    Attributes:
        n_put, n_dropped: items by sender.
    """

    def __init__(self) -> None:
        self.n_put: Counter[str] = Counter()
        self.n_dropped: Counter[str] = Counter()
        self._n_waiting: Counter[str] = Counter()
        self._items: deque[tuple[str, T]] = deque()
        self._is_closed = False
        self._changed = threading.Condition()

    def put(self, sender: str, items: Iterable[T], n_slots: int = _N_SLOTS) -> None:
        """Queue items; never blocks.

        Args:
            sender: sender of the items.
            items: items in order.
            n_slots: maximum number of waiting items of this sender; beyond, the oldest is dropped.
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

    def close(self) -> None:
        """Close the queue: its items can still be taken, without waiting for more."""
        with self._changed:
            self._is_closed = True
            self._changed.notify_all()

    def take(self, timeout_s: float) -> tuple[str, T] | None:
        """Return the oldest item with its sender; None after the timeout or the queue's end."""
        with self._changed:
            self._changed.wait_for(lambda: self._items or self._is_closed, timeout_s)
            if not self._items:
                return None
            sender, item = self._items.popleft()
            self._n_waiting[sender] -= 1
            return sender, item


class RateMeter:
    """Rate of arrivals over the last seconds; can be read from any thread.

    Args:
        now_s: the clock.
    """

    def __init__(self, now_s: Callable[[], float] = time.monotonic) -> None:
        self._now_s = now_s
        self._came: deque[tuple[float, int]] = deque()
        self._lock = threading.Lock()

    def add(self, n: int) -> None:
        """Count n arrivals now."""
        with self._lock:
            self._came.append((self._now_s(), n))

    @property
    def rate_hz(self) -> float:
        """Samples per second; 0 before the second sample, or after a long silence."""
        now_s = self._now_s()
        with self._lock:
            while self._came and self._came[0][0] < now_s - _RATE_WINDOW_S:
                self._came.popleft()
            if len(self._came) < 2:
                return 0.0
            first_s, last_s = self._came[0][0], self._came[-1][0]
            # If the next sample is overdue, count up to now: a stopped sensor must not look alive.
            typical_s = (last_s - first_s) / (len(self._came) - 1)
            n = sum(n for _, n in self._came) - self._came[0][1]
            return n / max(max(last_s, now_s - typical_s) - first_s, 1e-9)


class LiveSource(ABC):
    """An attached sensor, read by its own thread; see `AttachedSensors`.

    A driver opens, reads, closes and describes its device. This class provides the thread, detects silence,
    measures rates and reopens lost devices.

    Attributes:
        sensor: the sensor's name in the profile.
        lost: error and time.monotonic() of the loss; None while the sensor is not lost.
        opened_s: time.monotonic() of the first opening; None before.
    """

    def __init__(
        self, sensor: str, label: str, silence_s: float, silence_hint: str = "", n_slots: int = _N_SLOTS
    ) -> None:
        """Prepare without opening the device.

        Args:
            sensor: the sensor's name in the profile.
            label: name of the sensor in messages: "camera 'cam'".
            silence_s: longest time without a sample, s; then the sensor counts as lost.
            silence_hint: hint of the error for a lost sensor.
            n_slots: capacity of the queue; when it is full, the oldest sample is dropped.
        """
        self.sensor = sensor
        self.lost: tuple[SourceError, float] | None = None
        self.opened_s: float | None = None
        self._label = label
        self._n_slots, self._silence_s, self._silence_hint = n_slots, silence_s, silence_hint
        self._inbox = Inbox[LiveSample]()
        self._stopping = threading.Event()
        self._settled = threading.Event()
        self._rate = RateMeter()
        self._heard_s = 0.0

    @abstractmethod
    def open(self) -> None:
        """Open the device; on return it can be read. After a failure, `close` is called.

        Raises:
            SourceError: the device is absent, busy or of another model; the hint states what to check.
        """

    @abstractmethod
    def read(self) -> Iterable[LiveSample]:
        """Return the received samples; waits briefly at most.

        Raises:
            SourceError: the device failed permanently.
        """

    @abstractmethod
    def close(self) -> None:
        """Close the device, open or not; never raises."""

    @abstractmethod
    def describe(self) -> SourceStatus:
        """Report the state of the device, open or not; thread-safe. Taken samples are counted here."""

    def explain_silence(self, *, has_sent: bool) -> SourceError:
        """Explain a silence of `silence_s` since the device was opened or last sent."""
        what = "fell silent" if has_sent else "sends nothing"
        return SourceError(f"{self._label} {what}: nothing for {self._silence_s:g} s", self._silence_hint)

    def start(self, inbox: Inbox[LiveSample], reopen_every_s: float | None) -> None:
        """Start a thread that opens the device and reads it into a queue.

        Args:
            inbox: receives the samples.
            reopen_every_s: interval between attempts to reopen a lost device; None for no attempts.
        """
        self._inbox, self.lost, self.opened_s, self._rate = inbox, None, None, RateMeter()
        self._stopping.clear()
        self._settled.clear()
        run = partial(self._run, reopen_every_s)
        self._thread = threading.Thread(target=run, name=f"read {self.sensor}", daemon=True)
        self._thread.start()

    def wait(self, timeout_s: float | None = None) -> bool:
        """Wait until the device is open, or could not be opened; return False on timeout."""
        return self._settled.wait(timeout_s)

    def stop(self) -> None:
        """Ask the thread to close the device."""
        self._stopping.set()

    def join(self, timeout_s: float | None = None) -> bool:
        """Wait until the device is closed; return False on timeout."""
        self._thread.join(timeout_s)
        return not self._thread.is_alive()

    def status(self) -> SourceStatus:
        """Report the state of the sensor; may be called from any thread."""
        counts = self._inbox
        return replace(
            self.describe(),
            n_samples=counts.n_put[self.sensor],
            n_dropped=counts.n_dropped[self.sensor],
            rate_hz=self._rate.rate_hz,
        )

    def note_heard(self) -> None:
        """Record that the device is alive, though no sample is complete yet."""
        self._heard_s = time.monotonic()

    @property
    def is_stopping(self) -> bool:
        """Whether waiting for the device must end."""
        return self._stopping.is_set()

    def _run(self, reopen_every_s: float | None) -> None:
        """Open and read until asked to stop; a lost device is reopened."""
        while not self.is_stopping:
            try:
                self.open()
                self.opened_s = self.opened_s or time.monotonic()
                self._settled.set()
                failure = self._read_on()
            except SourceError as error:
                failure = error
            except Exception as error:  # A bug must not look like the end of the stream.
                failure = SourceError(
                    f"{self._label}: its reader failed: {error!r}", "This is a bug: report it."
                )
                failure.__cause__ = error
            self.close()
            if failure is not None:
                self.lost = failure, time.monotonic() if self.lost is None else self.lost[1]
                self._settled.set()
                self._stopping.wait(reopen_every_s)

    def _read_on(self) -> SourceError | None:
        """Read until asked to stop, or raise an error once the device has been silent too long."""
        heard_s, has_sent = time.monotonic(), False
        while not self.is_stopping:
            came = list(self.read())
            now_s = time.monotonic()
            if came:
                self._inbox.put(self.sensor, came, self._n_slots)
                self._rate.add(len(came))
                heard_s, has_sent = now_s, True
                # Wait for the first sample: a program that starts may still find no camera.
                self.lost = None
            elif now_s - max(heard_s, self._heard_s) > self._silence_s:
                return self.explain_silence(has_sent=has_sent)
        return None


class AttachedSensors:
    """The attached sensors of a rig, read in parallel into one queue; open while its `with` block lasts.

    They are opened at the same time. A sensor that fails is closed and reopened repeatedly; meanwhile the
    others continue.

    Attributes:
        sources: sources by sensor name.
    """

    def __init__(self, sources: Sequence[LiveSource], reopen_every_s: float | None = REOPEN_EVERY_S) -> None:
        """Take the sources without opening them."""
        self.sources = {source.sensor: source for source in sources}
        self._inbox = Inbox[LiveSample]()
        self._reopen_every_s = reopen_every_s

    def start(self) -> None:
        """Begin to open every sensor."""
        for source in self.sources.values():
            source.start(self._inbox, self._reopen_every_s)

    def stop(self, timeout_s: float | None = None) -> list[str]:
        """Close every sensor; return those that do not close in time."""
        until_s = None if timeout_s is None else time.monotonic() + timeout_s
        for source in self.sources.values():
            source.stop()
        return [
            name
            for name, source in self.sources.items()
            if not source.join(None if until_s is None else max(0.0, until_s - time.monotonic()))
        ]

    def __enter__(self) -> "AttachedSensors":
        """Open every sensor.

        Raises:
            SourceError: a sensor cannot be opened; the hint lists any further ones.
        """
        self.start()
        try:
            for source in self.sources.values():
                source.wait()
            closed = [source for source in self.sources.values() if source.opened_s is None]
            failures = [source.lost[0] for source in closed if source.lost is not None]
            if failures:
                hints = [failures[0].hint, *(f"Also: {other.what}" for other in failures[1:])]
                hints.append("`lce-rig doctor --rig RIG` checks every device.")
                raise SourceError(failures[0].what, "\n  ".join(hint for hint in hints if hint))
        except BaseException:  # Ctrl-C while waiting, too.
            self.stop()
            raise
        self._inbox.n_dropped.clear()  # Samples dropped while other sensors were being opened do not count.
        return self

    def __exit__(self, *_: object) -> None:
        """Close every sensor."""
        self.stop()
        self._inbox.close()

    def take(self, timeout_s: float) -> tuple[str, LiveSample] | None:
        """Return the next sample with its sensor; None on timeout."""
        return self._inbox.take(timeout_s)

    def lost(self) -> dict[str, tuple[SourceError, float]]:
        """Return the currently lost sensors: the reason, and since when by time.monotonic()."""
        lost = {name: source.lost for name, source in self.sources.items()}
        return {name: why for name, why in lost.items() if why is not None}

    def statuses(self) -> dict[str, SourceStatus]:
        """Return the state of every sensor."""
        return {name: source.status() for name, source in self.sources.items()}
