"""A file of an event camera's own recorder: its events and, in AEDAT4, its frames."""

from collections.abc import Iterator
from pathlib import Path

from lce_rig.core.data import Image, Sample, Stream
from lce_rig.rig import Rig
from lce_rig.sources.base import SourceOptions, Span
from lce_rig.sources.events import open_events
from lce_rig.sources.events.aedat4_file import Aedat4File
from lce_rig.sources.events.aedat4_frames import Aedat4Frames
from lce_rig.sources.events.camera import CameraEvents
from lce_rig.sources.events.stream import Findings, NoEventsError
from lce_rig.sources.fingerprint import fingerprint
from lce_rig.sources.merging import merge_by_time
from lce_rig.sources.sensors import choose_event_camera


class EventCameraFile:
    """One file of one event camera; see `ContinuousRecording`. Its LiDAR is recorded elsewhere.

    Attributes:
        path: the file.
        notes: what was assumed on opening, and after reading what was skipped and why.
        key: fingerprint of the file.
        n_samples: number of frames.
        streams: the camera's events and, where the file and the profile have them, its frames.
    """

    def __init__(self, path: Path, rig: Rig, options: SourceOptions) -> None:
        """Open the file.

        Raises:
            SourceError: it cannot be read or holds nothing, the rig has no event camera, or the events are
                of another resolution than its.
        """
        self.path = path
        self.notes: list[str] = []
        self._rig = rig
        self._camera, channel = choose_event_camera(rig, options, self.notes)
        self.streams: dict[Stream, Span | None] = {}
        self._frames = self._open_frames()
        self._events = self._open_events()
        if self._events is not None:
            self.streams[Stream(self._camera, channel, "events")] = self._events.span_ns
            length_s = (self._events.span_ns[1] - self._events.span_ns[0]) * 1e-9
            self.notes.append(f"{path.name}: {length_s:.1f} s of {self._camera}.{channel}")
        self.key = fingerprint([path])
        self.n_samples = 0 if self._frames is None else self._frames.count()

    def samples(self) -> Iterator[Sample]:
        """Yield packets of events, and frames, in order of time.

        Raises:
            SourceError: after all that can be read, where the events' clock was set back.
        """
        parts: list[Iterator[Sample]] = []
        findings = Findings()
        if self._events is not None:
            parts.append(self._events.samples())
        if self._frames is not None:
            parts.append(self._images(self._frames, findings))
        try:
            yield from merge_by_time(parts, self._rig)
        finally:
            found = [f"{self.path.name}: frames: {line}" for line in findings.lines()]
            found += [] if self._events is None else self._events.notes
            self.notes += [note for note in found if note not in self.notes]

    def _open_events(self) -> CameraEvents | None:
        size = self._rig.cameras[self._camera].resolution_px
        try:
            return CameraEvents(open_events(self.path, sensor=self._camera, resolution=size))
        except NoEventsError as error:
            if self._frames is None:
                raise
            self.notes.append(f"{error.what}; its frames are read")
            return None

    def _open_frames(self) -> Aedat4Frames | None:
        """Find the frames of an AEDAT4 file, and the channel they belong to."""
        if self.path.suffix.lower() != ".aedat4":
            return None
        file = Aedat4File(self.path)
        number = file.first_stream("FRME")
        frames = None if number is None else Aedat4Frames(file, number)
        first = None if frames is None else frames.first()
        if frames is None or first is None:
            return None
        channel = self._rig.cameras[self._camera].first_channel("frames")
        if channel is None:
            self.notes.append(
                f"{self.path.name}: frames left out; {self._camera} has no channel of kind frames"
            )
            return None
        self._channel = channel
        self.streams[Stream(self._camera, channel, "pictures")] = frames.span_ns()
        self.notes += file.notes
        self.notes.append(f"{self.path.name}: {self._camera}.{channel} {_meaning(first.exposure_ns)}")
        return frames

    def _images(self, frames: Aedat4Frames, findings: Findings) -> Iterator[Sample]:
        last_ns: int | None = None
        for frame in frames.frames(findings):
            if last_ns is not None and frame.mid_exposure_ns <= last_ns:
                findings.add("out of order left out")
                continue
            last_ns = frame.mid_exposure_ns
            yield Image(self._camera, self._channel, last_ns, frame.pixels)


def _meaning(exposure_ns: int) -> str:
    if exposure_ns:
        return f"stamped at the middle of the exposure, {exposure_ns * 1e-6:.1f} ms in the first frame"
    return "carries no exposure: its stamps are taken for the middle of it"
