"""Images of event cameras, reconstructed from the stream, one for every scan."""

from collections import deque
from collections.abc import Collection, Iterable, Iterator

from lce_rig.collect.findings import READ_EVENTS_GONE_BY, READ_NO_EVENTS_AT_SCAN
from lce_rig.core.data import Events, Image, Sample, Scan, Stream
from lce_rig.core.findings import Losses, Refusal
from lce_rig.detect.events.reconstructor import Reconstructor
from lce_rig.rig import Rig
from lce_rig.timing.scan_pairing import (
    PATIENCE_NS,
    event_channel,
    middle_of_sweep_ns,
    rig_offset_ns,
    rig_time_ns,
)

_NOT_BEGUN = READ_NO_EVENTS_AT_SCAN.refusal()
_GONE_BY = READ_EVENTS_GONE_BY.refusal()


def with_event_pictures(
    samples: Iterable[Sample], rig: Rig, cameras: Collection[str], tally: Losses, *, is_live: bool = False
) -> Iterator[Sample]:
    """Pass samples on, and add an image of each camera for the middle of every scan.

    The network's state runs through the whole stream. An image follows the events it was made of.

    Args:
        samples: scans and packets of events, the earliest first.
        rig: the profile, with the settings of the reconstruction.
        cameras: cameras whose events are reconstructed.
        tally: counts scans without an image, by cause.
        is_live: make each image a step of the network instead of an extra run, which is quicker; images
            then depend on the scans received.

    Raises:
        SourceError: onnxruntime is not installed, or the recording is torn.
    """
    darkrooms = [_Darkroom(rig, camera, tally, is_live) for camera in sorted(cameras)]
    for sample in samples:
        yield sample
        for darkroom in darkrooms:
            yield from darkroom.take(sample)
    for darkroom in darkrooms:
        yield from darkroom.finish()


class _Darkroom:
    """Events of one camera, buffered until the times of the requested images are known."""

    def __init__(self, rig: Rig, camera: str, tally: Losses, is_live: bool) -> None:
        channel = event_channel(rig, camera) or ""
        self._rig = rig
        self._camera = camera
        self._tally = tally
        self._is_live = is_live
        self._reconstructor = Reconstructor(channel)
        self._offset_ns = rig_offset_ns(Stream(camera, channel, "events"), rig)
        self._wanted: deque[int] = deque()
        self._packets: deque[Events] = deque()
        self._fed_ns: int | None = None
        self._newest_ns = -(2**62)

    def take(self, sample: Sample) -> Iterator[Image]:
        """Take the next sample and yield the images that can be reconstructed now."""
        if isinstance(sample, Events) and sample.sensor == self._camera:
            self._packets.append(sample)
        elif isinstance(sample, Scan):
            middle_ns = middle_of_sweep_ns(sample, self._rig)
            # Two LiDARs may request images out of order, by less than the buffer's delay.
            if middle_ns is not None and (not self._wanted or middle_ns > self._wanted[-1]):
                self._wanted.append(middle_ns)
        self._newest_ns = max(self._newest_ns, rig_time_ns(sample, self._rig) or self._newest_ns)
        yield from self._develop()

    def finish(self) -> Iterator[Image]:
        """Yield the remaining images after the end of the stream."""
        self._newest_ns = 2**62
        yield from self._develop()

    def _develop(self) -> Iterator[Image]:
        # Scans arrive late in bags: buffer the events before the network uses them.
        while self._wanted:
            stamp_ns = self._wanted[0] - self._offset_ns
            has_passed = bool(self._packets) and self._packets[-1].t_ns[-1] >= stamp_ns
            if not has_passed and self._newest_ns <= self._wanted[0] + PATIENCE_NS:
                break
            self._wanted.popleft()
            if self._fed_ns is not None and stamp_ns < self._fed_ns:
                self._tally.add(_GONE_BY)
                continue
            self._feed(stamp_ns)
            image: Image | Refusal = _NOT_BEGUN
            if self._fed_ns is not None:
                image = self._reconstructor.picture_at(stamp_ns, is_step=self._is_live)
            if isinstance(image, Refusal):
                self._tally.add(image)
            else:
                yield image
        if self._packets:
            self._feed(min([self._newest_ns - PATIENCE_NS, *self._wanted]) - self._offset_ns)

    def _feed(self, until_ns: int) -> None:
        """Feed the network all events before a timestamp of its clock."""
        while self._packets and self._packets[0].t_ns[0] < until_ns:
            packet = self._packets.popleft()
            rest = packet.between(until_ns, int(packet.t_ns[-1]) + 1)
            if len(rest):
                self._packets.appendleft(rest)
            early = packet.select(slice(0, len(packet) - len(rest)))
            self._reconstructor.feed(early)
            self._fed_ns = int(early.t_ns[-1])
