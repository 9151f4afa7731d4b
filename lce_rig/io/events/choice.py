"""An event camera's stream as a part of a recording, on the clock that the other sensors share."""

from collections.abc import Iterator
from dataclasses import replace

from lce_rig.core.data import Events
from lce_rig.io.events.event_recording import EventRecording
from lce_rig.io.events.stream import NS_PER_US
from lce_rig.io.protocol import Span

# September 2001: clocks that count from 1970 read more, those that count from their start less.
_SINCE_1970_NS = 10**18


class CameraEvents:
    """Events of one camera, in the order of time.

    Sensors of some makers count from their own start. Where arrivals at the host are known the timestamps are
    moved by what they differ from those at least, so that they meet the timestamps of other sensors.

    Attributes:
        recording: the events on the sensor's own clock.
        shift_ns: what is added to their timestamps; whole microseconds.
        span_ns: first and last timestamp after that, the last within some ms.
    """

    def __init__(self, recording: EventRecording) -> None:
        self.recording = recording
        self.shift_ns = _shift_to_host_ns(recording)
        first_ns, last_ns = recording.extent_ns()
        self.span_ns: Span = first_ns + self.shift_ns, last_ns + self.shift_ns

    @property
    def notes(self) -> list[str]:
        """What was assumed, repaired or skipped so far, in words."""
        if not self.shift_ns:
            return self.recording.notes
        tied = (
            f"{self.recording.path.name}: {self.recording.sensor}'s events count from the sensor's start; "
            f"{self.shift_ns * 1e-9:.6f} s added, from the arrival of their packets"
        )
        return [*self.recording.notes, tied]

    def samples(self) -> Iterator[Events]:
        """Yield the events in packets.

        Raises:
            SourceError: the timestamps run back for good, or events lie off the sensor.
        """
        for events in self.recording:
            yield replace(events, t_ns=events.t_ns + self.shift_ns) if self.shift_ns else events


def _shift_to_host_ns(recording: EventRecording) -> int:
    if recording.start_ns >= _SINCE_1970_NS:
        return 0
    offset_ns = recording.host_offset_ns()
    if offset_ns is None or recording.start_ns + offset_ns < _SINCE_1970_NS:
        return 0
    return offset_ns // NS_PER_US * NS_PER_US
