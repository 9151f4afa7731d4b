"""A file of an event camera's own recorder: its events and, in AEDAT4, its frames."""

from collections.abc import Iterator
from pathlib import Path

from lce_rig.core.data import Image, Sample, Stream
from lce_rig.core.losses import Losses
from lce_rig.io.events import open_events
from lce_rig.io.events.aedat4 import decode_frame
from lce_rig.io.events.aedat4_file import Aedat4File
from lce_rig.io.events.choice import CameraEvents
from lce_rig.io.events.prophesee_raw import PropheseeEvents
from lce_rig.io.events.stream import NoEventsError, damage, worded
from lce_rig.io.fingerprint import fingerprint
from lce_rig.io.merging import merge_by_time
from lce_rig.io.protocol import SourceOptions, Span
from lce_rig.io.sensor_choice import choose_event_camera
from lce_rig.rig import Rig

_MAX_SERIAL = 64


class EventCameraFile:
    """One file of one event camera; see `ContinuousRecording`. Its LiDAR is recorded elsewhere.

    Attributes:
        path: the file.
        notes: what was assumed on opening, and after reading what was skipped and why.
        key: fingerprint of the file.
        n_samples: number of frames.
        streams: the camera's events and, where the file and the profile have them, its frames.
        serials: the camera's serial number, where the file tells it.
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
        self._events = self._open_events()
        if self._events is not None:
            self.streams[Stream(self._camera, channel, "events")] = self._events.span_ns
            length_s = (self._events.span_ns[1] - self._events.span_ns[0]) * 1e-9
            self.notes.append(f"{path.name}: {length_s:.1f} s of {self._camera}.{channel}")
        self.key = fingerprint([path])
        serial = _told_serial(path)
        self.serials = {self._camera: serial} if serial else {}

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
            found = [f"{self.path.name}: frames: {line}" for line in worded(losses)]
            found += [] if self._events is None else self._events.notes
            self.notes += [note for note in found if note not in self.notes]

    def _open_events(self) -> CameraEvents | None:
        size = self._rig.cameras[self._camera].resolution_px
        try:
            return CameraEvents(open_events(self.path, sensor=self._camera, resolution=size))
        except NoEventsError as error:
            if not self._has_frames:
                raise
            self.notes.append(f"{error.what}; its frames are read")
            return None

    def _open_frames(self) -> bool:
        """Find the frames of an AEDAT4 file, and the channel they belong to; False where none are read."""
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
        self.n_samples = self._file.n_packets(number)
        self.notes += self._file.notes
        self.notes.append(f"{self.path.name}: {self._camera}.{channel} {_meaning(first.exposure_ns)}")
        return True

    def _images(self, losses: Losses) -> Iterator[Sample]:
        last_ns: int | None = None
        for frame in self._file.packets(self._number, losses, decode_frame):
            if last_ns is not None and frame.mid_exposure_ns <= last_ns:
                losses.add(damage("recording.frames_out_of_order"))
                continue
            last_ns = frame.mid_exposure_ns
            yield Image(self._camera, self._channel, last_ns, frame.pixels)


def _told_serial(path: Path) -> str:
    """Read the camera's serial number from the head of a file that was opened before; "" without one."""
    readers: dict[str, type[Aedat4File | PropheseeEvents]] = {".aedat4": Aedat4File, ".raw": PropheseeEvents}
    reader = readers.get(path.suffix.lower())
    told = "" if reader is None else reader(path).serial
    return told if told.isalnum() and len(told) <= _MAX_SERIAL else ""


def _meaning(exposure_ns: int) -> str:
    if exposure_ns:
        return f"timestamped at mid exposure; exposure {exposure_ns * 1e-6:.1f} ms in the first frame"
    return "has no exposure time; its timestamps are used as mid exposure"
