"""Samples in, the newest frame out: paired in a thread of its own, so that slow detection stops nothing."""

import threading
from collections.abc import Callable, Iterator
from types import TracebackType

from lce_rig.collect.event_pictures import with_event_pictures
from lce_rig.collect.live.pumps import Pumps
from lce_rig.collect.live.rig_clock import RigClock
from lce_rig.collect.pairing import Frame, PairingCounts, pair_by_time
from lce_rig.collect.tally import Tally
from lce_rig.core.errors import LceRigError, SourceError
from lce_rig.rig import Rig
from lce_rig.sources.base import Sample
from lce_rig.sources.live.base import Mailbox
from lce_rig.sources.rig_time import event_channel

_WAIT_S = 0.1


class FrameFeed:
    """Reads the pumps, places samples on the rig's clock and pairs them; open while its `with` block lasts.

    Attributes:
        counts: how pairing goes.
        n_skipped: frames that nobody took before the next one came.
    """

    def __init__(
        self, rig: Rig, pumps: Pumps, clock: RigClock, record: Callable[[Sample], None] | None = None
    ) -> None:
        """Prepare.

        Args:
            rig: the profile.
            pumps: open.
            clock: ties the stamps.
            record: takes every sample too, as it came but for its time; must not block.
        """
        self.counts = PairingCounts()
        self._rig = rig
        self._pumps = pumps
        self._clock = clock
        self._record = record
        self._frames: Mailbox[Frame] = Mailbox(1)
        self._stop = threading.Event()
        self._failure: BaseException | None = None
        self._thread = threading.Thread(target=self._run, name="pair samples", daemon=True)

    def __enter__(self) -> "FrameFeed":
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._stop.set()
        self._thread.join()

    @property
    def n_skipped(self) -> int:
        """Frames that nobody took before the next one came."""
        return self._frames.n_dropped

    def take(self, timeout_s: float) -> Frame | None:
        """Take the newest frame; None where none came in time.

        Raises:
            LceRigError: the feed cannot go on, such as a profile's network that cannot be used.
        """
        frame = self._frames.take(timeout_s)
        if frame is None and self._failure is not None:
            raise self._failure
        return frame

    def _run(self) -> None:
        try:
            for frame in pair_by_time(self._with_pictures(), self._rig, self.counts):
                self._frames.put(frame)
        except BaseException as error:  # Whoever takes frames is told, of bugs too.
            self._failure = error
            self._frames.close(error if isinstance(error, SourceError) else None)
            if not isinstance(error, LceRigError):
                raise

    def _with_pictures(self) -> Iterator[Sample]:
        """Add pictures made of events for cameras that have nothing else to watch the board by."""
        cameras = {
            name
            for name, camera in self._rig.cameras.items()
            if event_channel(self._rig, name) and all(c.kind == "events" for c in camera.channels.values())
        }
        if not cameras:
            return self._samples()
        return with_event_pictures(self._samples(), self._rig, cameras, Tally())

    def _samples(self) -> Iterator[Sample]:
        while not self._stop.is_set():
            self._clock.refresh(self._pumps.statuses)
            came = self._pumps.take(_WAIT_S)
            if came is None:
                continue
            for sample in self._clock.take(*came):
                if self._record is not None:
                    self._record(sample)
                yield sample
