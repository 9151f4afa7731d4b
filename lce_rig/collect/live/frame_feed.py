"""Pair samples into frames in a separate thread, so that slow detection delays no sensor."""

import threading
import time
from collections.abc import Callable, Iterator

from lce_rig.collect.event_pictures import with_event_pictures
from lce_rig.core.data import Sample
from lce_rig.core.errors import LceRigError
from lce_rig.core.findings import Losses
from lce_rig.devices.reading import AttachedSensors, Inbox
from lce_rig.devices.sync_board import SyncBoard
from lce_rig.rig import Rig
from lce_rig.timing.rig_clock import SLOW_TRIGGERS_HZ, RigClock
from lce_rig.timing.scan_pairing import LIVE_NS, Frame, event_channel, pair_by_time

# Longest wait for a sample or frame, s: the delay until keys and the end are handled.
_WAIT_S = 0.1
# Interval at which the rig's clock adopts the sync board's models, s: at 20 ppm it drifts by 10 us meanwhile.
_REFRESH_S = 0.5


class FrameFeed:
    """Reads the sensors, converts timestamps to the rig's clock, pairs samples; open in its `with` block.

    Attributes:
        sensors: open.
        clock: converts the timestamps to the rig's clock.
        losses: scans without an image of their time, or without events to reconstruct one.
    """

    def __init__(
        self,
        rig: Rig,
        sensors: AttachedSensors,
        clock: RigClock,
        board: SyncBoard | None,
        record: Callable[[Sample], None] | None = None,
        *,
        are_events_enough: bool = False,
    ) -> None:
        """Prepare the feed.

        Args:
            rig: the profile.
            sensors: open.
            clock: converts the timestamps to the rig's clock.
            board: the sync board; None without one.
            record: also receives every sample, unchanged except for its time; must not block.
            are_events_enough: whether events are used without an image reconstructed from them.
        """
        self.losses = Losses()
        self._rig = rig
        self.sensors = sensors
        self.clock = clock
        self._board = board
        self._record = record
        self._are_events_enough = are_events_enough
        self._refreshed_s = -1e9
        self._is_slow = False
        self._frames = Inbox[Frame]()
        self._stop = threading.Event()
        self._failure: BaseException | None = None
        self._thread = threading.Thread(target=self._run, name="pair samples", daemon=True)

    def __enter__(self) -> "FrameFeed":
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        self._thread.join()

    def take(self, timeout_s: float = _WAIT_S) -> Frame | None:
        """Return the newest frame; None if no frame arrived in time.

        Raises:
            LceRigError: the feed cannot continue, for example because the profile's network is unusable.
        """
        came = self._frames.take(timeout_s)
        if came is None and self._failure is not None:
            raise self._failure
        return None if came is None else came[1]

    def _run(self) -> None:
        try:
            samples = self._samples()
            # Cameras that show the board only in images reconstructed from their events.
            cameras = {
                name
                for name, camera in self._rig.cameras.items()
                if event_channel(self._rig, name) and not camera.first_channel("frames")
            }
            if cameras and not self._are_events_enough:
                samples = with_event_pictures(samples, self._rig, cameras, self.losses, is_live=True)
            for frame in pair_by_time(
                samples, self._rig, self.losses, LIVE_NS, are_events_enough=self._are_events_enough
            ):
                self._frames.put("pairs", [frame], n_slots=1)
        except BaseException as error:  # Pass bugs on to the consumer of frames as well.
            self._failure = error
            self._frames.close()
            if not isinstance(error, LceRigError):
                raise

    def _samples(self) -> Iterator[Sample]:
        """Yield samples with timestamps of the rig's clock, which follows the sensors and the sync board."""
        board = self._board
        while not self._stop.is_set():
            if time.monotonic() - self._refreshed_s > _REFRESH_S:
                self._refreshed_s = time.monotonic()
                locked = [name for name, status in self.sensors.statuses().items() if status.is_utc]
                host, utc = (None, None) if board is None else (board.host_clock, board.utc_clock)
                self.clock.refresh(host, utc, locked)
                if board is not None and self.clock.needs_slow_triggers != self._is_slow:
                    self._is_slow = not self._is_slow
                    board.start_triggers(SLOW_TRIGGERS_HZ if self._is_slow else None)
            came = self.sensors.take(_WAIT_S)
            if came is None:
                continue
            for sample in self.clock.take(*came):
                if self._record is not None:
                    self._record(sample)
                yield sample
