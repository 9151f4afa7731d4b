"""A file of an event camera's own recorder: its events and, in AEDAT4, its frames."""

import re
from collections.abc import Iterator
from pathlib import Path

from lce_rig.core.data import Image, Sample, Stream
from lce_rig.core.losses import Losses
from lce_rig.io import findings
from lce_rig.io.events import open_events
from lce_rig.io.events.aedat4 import Aedat4File, decode_frame
from lce_rig.io.events.event_recording import CameraEvents, NoEventsError, worded
from lce_rig.io.events.prophesee import PropheseeEvents
from lce_rig.io.joining import merge_by_time
from lce_rig.io.protocol import SourceOptions, Span, choose_event_camera, fingerprint
from lce_rig.rig import Rig


class EventCameraFile:
    """One file of one event camera; see `ContinuousRecording`. Its LiDAR is recorded elsewhere.

    Attributes:
        path: the file.
        notes: assumptions on opening; after reading, losses with their causes.
        key: fingerprint of the file.
        n_samples: number of frames.
        streams: the camera's events and, if the file and the profile have them, its frames.
        serials: the camera's serial number, if the file records it.
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
        self.n_samples = 0
        self._has_frames = self._open_frames()
        size = rig.cameras[self._camera].resolution_px
        self._events: CameraEvents | None = None
        try:
            self._events = CameraEvents(open_events(path, sensor=self._camera, resolution=size))
        except NoEventsError as error:
            if not self._has_frames:
                raise
            self.notes.append(f"{error.what}; its frames are read")
        if self._events is not None:
            self.streams[Stream(self._camera, channel, "events")] = self._events.span_ns
            length_s = (self._events.span_ns[1] - self._events.span_ns[0]) * 1e-9
            self.notes.append(f"{path.name}: {length_s:.1f} s of {self._camera}.{channel}")
        self.key = fingerprint([path])
        readers: dict[str, type[Aedat4File | PropheseeEvents]] = {
            ".aedat4": Aedat4File,
            ".raw": PropheseeEvents,
        }
        reader = readers.get(path.suffix.lower())
        serial = "" if reader is None else reader(path).serial
        self.serials = {self._camera: serial} if re.fullmatch("[A-Za-z0-9]{1,64}", serial) else {}

    def samples(self) -> Iterator[Sample]:
        """Yield packets of events, and frames, in order of time.

        Raises:
            SourceError: after all that can be read, where the events' clock was set back.
        """
        parts: list[Iterator[Sample]] = []
        losses = Losses()
        if self._events is not None:
            parts.append(self._events.samples())
        if self._has_frames:
            parts.append(self._images(losses))
        try:
            yield from merge_by_time(parts, self._rig)
        finally:
            notes = [f"{self.path.name}: frames: {line}" for line in worded(losses)]
            notes += [] if self._events is None else self._events.notes
            self.notes += [note for note in notes if note not in self.notes]

    def _open_frames(self) -> bool:
        """Find the frames of an AEDAT4 file, and the channel they belong to; False if none are read."""
        if self.path.suffix.lower() != ".aedat4":
            return False
        self._file = Aedat4File(self.path)
        number = self._file.first_stream("FRME")
        if number is None:
            return False
        first = next(self._file.packets(number, Losses(), decode_frame), None)
        last = self._file.last_packet(number, decode_frame)
        if first is None or last is None:
            return False
        channel = self._rig.cameras[self._camera].first_channel("frames")
        if channel is None:
            self.notes.append(
                f"{self.path.name}: frames skipped; {self._camera} has no channel of kind frames"
            )
            return False
        self._channel, self._number = channel, number
        self.streams[Stream(self._camera, channel, "images")] = first.mid_exposure_ns, last.mid_exposure_ns
        self.n_samples = len(self._file.places[number])
        self.notes += self._file.notes
        meaning = "has no exposure time; its timestamps are used as mid exposure"
        if first.exposure_ns:
            exposure_ms = first.exposure_ns * 1e-6
            meaning = f"timestamped at mid exposure; exposure {exposure_ms:.1f} ms in the first frame"
        self.notes.append(f"{self.path.name}: {self._camera}.{channel} {meaning}")
        return True

    def _images(self, losses: Losses) -> Iterator[Sample]:
        last_ns: int | None = None
        for frame in self._file.packets(self._number, losses, decode_frame):
            if last_ns is not None and frame.mid_exposure_ns <= last_ns:
                losses.add(findings.FRAMES_OUT_OF_ORDER())
                continue
            last_ns = frame.mid_exposure_ns
            yield Image(self._camera, self._channel, last_ns, frame.pixels)
