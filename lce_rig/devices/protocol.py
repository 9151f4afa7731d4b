"""The state of an attached sensor, and the queue between its reader thread and its taker."""

import threading
from collections import deque
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Generic, TypeVar

from lce_rig.core.errors import SourceError
from lce_rig.core.findings import Finding

T = TypeVar("T")


@dataclass(frozen=True)
class ClockState:
    """Whose time a sensor's timestamps are.

    Attributes:
        finding: whose time, and how it is tied to others.
        is_utc: whether it is the sensor's own time, tied to UTC by pulses and sentences.
        ahead_s: by how much the sensor's clock is ahead of this computer's; None where unknown.
    """

    finding: Finding
    is_utc: bool = False
    ahead_s: float | None = None


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
        figures: further counts and measurements by name, for people and logs.
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
    figures: Mapping[str, float] = field(default_factory=dict)
    device: str = ""
    serial: str = ""
    rates_hz: Mapping[str, float] = field(default_factory=dict)
    n_packets: int | None = None
    n_lost_by_line: Mapping[str, int] = field(default_factory=dict)


class Waiting(Generic[T]):
    """A queue from reader threads to one taker, oldest first; it ends when it is closed and empty."""

    def __init__(self) -> None:
        self._items: deque[T] = deque()
        self._is_closed = False
        self._error: SourceError | None = None
        self._changed = threading.Condition()

    def close(self, error: SourceError | None = None) -> None:
        """End the queue: items in it can still be taken, then `error` is raised if there is one."""
        with self._changed:
            self._is_closed = True
            self._error = self._error or error
            self._changed.notify_all()

    def take(self, timeout_s: float) -> T | None:
        """Take the oldest item; None where nothing came in time, or the queue has ended.

        Raises:
            SourceError: the reader failed, and all that it read before has been taken.
        """
        with self._changed:
            self._changed.wait_for(lambda: self._items or self._is_closed, timeout_s)
            if self._items:
                return self._items.popleft()
            if self._error is not None:
                raise self._error
            return None

    @property
    def is_ended(self) -> bool:
        """Whether the queue was closed and everything taken."""
        with self._changed:
            return self._is_closed and not self._items


class Mailbox(Waiting[T]):
    """A bounded queue from one reader thread to one taker; when full, the oldest is dropped and counted."""

    def __init__(self, n_slots: int) -> None:
        super().__init__()
        self.n_dropped = 0
        self.n_put = 0
        self._n_slots = n_slots

    def put(self, item: T) -> None:
        """Hand an item over; never blocks."""
        with self._changed:
            if len(self._items) >= self._n_slots:
                self._items.popleft()
                self.n_dropped += 1
            self._items.append(item)
            self.n_put += 1
            self._changed.notify()

    def items(self, wait_s: float) -> Iterator[T]:
        """Yield items as they come until the queue has ended, looking every `wait_s`.

        Raises:
            SourceError: the reader failed, and all that it read before has been yielded.
        """
        while not self.is_ended:
            item = self.take(wait_s)
            if item is not None:
                yield item
        self.take(0)
