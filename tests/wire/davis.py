"""A fake DAVIS346 with dv-processing's interface, fed from a reel and random events."""

import time
from datetime import timedelta

import numpy as np

from wire.timing import placement_at

EVENTS_HZ = 2_000_000
_SIZE, _BATCH_US, _FRAME_EVERY, _EXPOSURE_US = (346, 260), 10_000, 4, 4_000
_SECOND_US = 1_000_000


class RandomDavis:
    """A camera of dv-processing that makes random events, and shows a reel's pictures, in real time.

    Its trigger input sees the pulses at whole seconds.

    It runs in the collector's process, as the threads of an attached camera do; dv-processing's own network
    writer takes more than half a core for itself, however little is sent.
    """

    def __init__(self, reel, camera, loops_per_hold, *, has_frames):
        """Prepare."""
        import dv_processing

        self._has_frames, self._loops = has_frames, loops_per_hold
        self._dv = dv_processing
        self._batch = self._frame = time.time_ns() // 1000 // _BATCH_US
        self._n_placements = reel.n_placements
        self._frames = [
            [_read_frame(data) for data in reel.pictures(camera, placement)]
            for placement in range(reel.n_placements)
        ]
        self._pulse = time.time_ns() // 1000 // _SECOND_US + 1
        self.n_events = self.n_frames = 0

    def getNextEventBatch(self):
        """Return the events of the next 10 ms, after their end."""
        start_us = self._batch * _BATCH_US
        if time.time_ns() // 1000 < start_us + _BATCH_US:
            return None
        self._batch += 1
        n, seed, span = (
            round(EVENTS_HZ * _BATCH_US * 1e-6),
            self._batch % 1000,
            timedelta(microseconds=_BATCH_US),
        )
        events = self._dv.data.generate.uniformEventsWithinTimeRange(start_us, span, _SIZE, n, seed)
        self.n_events += events.size()
        return events

    def getNextFrame(self):
        """Return the image of the next 40 ms, once it is exposed."""
        start_us = self._frame * _BATCH_US
        if not self._has_frames or time.time_ns() // 1000 < start_us + _EXPOSURE_US:
            return None
        self._frame += _FRAME_EVERY
        shown = placement_at(1000 * start_us, self._loops, self._n_placements)
        image = self._frames[shown][self.n_frames % len(self._frames[shown])]
        self.n_frames += 1
        return self._dv.Frame(start_us, _EXPOSURE_US, 0, 0, image, self._dv.FrameSource.SENSOR)

    def getNextTriggerBatch(self):
        """Return the edge of the last whole second, only once."""
        stamp_us = self._pulse * _SECOND_US
        if time.time_ns() // 1000 < stamp_us:
            return None
        self._pulse += 1
        return [self._dv.Trigger(stamp_us, self._dv.TriggerType.EXTERNAL_SIGNAL_RISING_EDGE)]

    def isEventStreamAvailable(self):
        """It has events."""
        return True

    isFrameStreamAvailable = isRunning = isEventStreamAvailable

    isTriggerStreamAvailable = isEventStreamAvailable

    def isImuStreamAvailable(self):
        """It does not move."""
        return False


def _read_frame(data):
    return np.frombuffer(data, np.uint8).reshape(_SIZE[::-1])
