"""Recordings of event cameras: `open_events` finds the reader for a path, `EventCameraFile` adds frames."""

import re
from collections.abc import Iterable, Iterator
from pathlib import Path
from pkgutil import resolve_name

from lce_rig.core.data import Image, Sample, Stream
from lce_rig.core.errors import SourceError
from lce_rig.core.findings import Losses
from lce_rig.io.events.aedat4 import Aedat4File
from lce_rig.io.events.event_recording import EventRecording, NoEventsError
from lce_rig.io.findings import worded
from lce_rig.io.recording import SourceOptions, choose_event_camera, fingerprint, follows, merge_by_time
from lce_rig.io.ros.bag_file import SUFFIXES, kind_of
from lce_rig.rig import Rig

READERS = {
    ".aedat4": "lce_rig.io.events.aedat4:Aedat4Events",
    **dict.fromkeys(SUFFIXES, "lce_rig.io.ros.event_messages:BagEvents"),
    ".raw": "lce_rig.io.events.prophesee:PropheseeEvents",
    ".h5": "lce_rig.io.events.hdf5:Hdf5Events",
    ".hdf5": "lce_rig.io.events.hdf5:Hdf5Events",
}
"""Reader by suffix; a folder is a ROS 2 bag. Imported when wanted."""

__all__ = ["READERS", "EventCameraFile", "EventRecording", "open_events"]


def open_events(
    path: Path | str,
    *,
    sensor: str = "events",
    resolution: tuple[int, int] | None = None,
    topic: str | None = None,
) -> EventRecording:
    """Open a recording of events.

    Args:
        path: an AEDAT4, Prophesee .raw or HDF5 file, or a ROS 1 or ROS 2 bag.
        sensor: name of the camera to assign the events to.
        resolution: (width, height) px of that camera; None for the file's, or the extent of its events.
        topic: topic of a bag; None for the only one with events.

    Raises:
        SourceError: the path is missing or unreadable, or has no events or those of a camera of another
            resolution.
    """
    path = Path(path)
    if not path.exists():
        raise SourceError(f"{path} does not exist")
    kind = kind_of(path)
    if kind not in READERS:
        hint = f"Give a ROS 2 bag's folder or a file of one of these kinds: {', '.join(READERS)}."
        raise SourceError(f"{path} is not an event recording that lce-rig reads", hint)
    reader = resolve_name(READERS[kind])
    stream = reader(path, topic) if reader.__name__ == "BagEvents" else reader(path)
    return EventRecording(path, stream, sensor, resolution)


class EventCameraFile:
    """One file of one event camera; see `ContinuousRecording`. Its LiDAR is recorded elsewhere.

    Attributes:
        path: the file.
        notes: assumptions on opening; after reading, losses with their causes.
        key: fingerprint of the file.
        n_samples: number of frames to come, estimated from the file's size.
        streams: the camera's events and, if the file and the profile have them, its frames.
        serials: the camera's serial number, if the file records it.
    """

    def __init__(self, path: Path, rig: Rig, options: SourceOptions) -> None:
        """Open the file.

        Raises:
            SourceError: the file cannot be read or is empty, the rig has no event camera, or the events have
                another resolution.
        """
        self.path = path
        self.notes: list[str] = []
        self.key = fingerprint([path])
        self.n_samples = 0
        self.streams: set[Stream] = set()
        self._rig = rig
        self._camera, channel = choose_event_camera(rig, options, self.notes)
        aedat4 = Aedat4File(path) if path.suffix.lower() == ".aedat4" else None
        self._frames = None if aedat4 is None else self._open_frames(aedat4)
        serial = "" if aedat4 is None else aedat4.serial
        self._events: EventRecording | None = None
        try:
            size = rig.cameras[self._camera].resolution_px
            self._events = open_events(path, sensor=self._camera, resolution=size)
            self._events.tie_to_host()
            self.streams.add(Stream(self._camera, channel, "events"))
            self.notes.append(f"{path.name}: {self._camera}.{channel}")
            serial = serial or self._events.serial
        except NoEventsError as error:
            if self._frames is None:
                raise
            self.notes.append(f"{error.what}; its frames are read")
        self.serials = {self._camera: serial} if re.fullmatch("[A-Za-z0-9]{1,64}", serial) else {}

    def samples(self) -> Iterator[Sample]:
        """Yield packets of events, and frames, in order of time.

        Raises:
            SourceError: after the readable part, if the events' clock was set back.
        """
        parts: list[Iterable[Sample]] = [] if self._events is None else [self._events]
        losses = Losses()
        if self._frames is not None:
            parts.append(self._images(*self._frames, losses))
        try:
            yield from merge_by_time(parts, self._rig)
        finally:
            notes = [f"{self.path.name}: frames: {line}" for line in worded(losses)]
            notes += [] if self._events is None else self._events.notes
            self.notes += [note for note in notes if note not in self.notes]

    def _open_frames(self, file: Aedat4File) -> tuple[Aedat4File, int, str] | None:
        """Find the images of an AEDAT4 file: their stream number and channel; None without images."""
        number = file.first_stream("frame")
        if number is None:
            return None
        first = next(file.frames(number, Losses()), None)
        if first is None:
            return None
        channel = self._rig.cameras[self._camera].first_channel("frames")
        if channel is None:
            note = f"frames skipped; {self._camera} has no channel of kind frames"
            self.notes.append(f"{self.path.name}: {note}")
            return None
        self.streams.add(Stream(self._camera, channel, "images"))
        # A file with many events has fewer images.
        self.n_samples = max(1, self.path.stat().st_size // first.pixels.nbytes)
        meaning = "has no exposure time; its timestamps are used as mid exposure"
        if first.exposure_ns:
            exposure_ms = first.exposure_ns * 1e-6
            meaning = f"timestamped at mid exposure; exposure {exposure_ms:.1f} ms in the first frame"
        self.notes += [*file.notes, f"{self.path.name}: {self._camera}.{channel} {meaning}"]
        return file, number, channel

    def _images(self, file: Aedat4File, number: int, channel: str, losses: Losses) -> Iterator[Sample]:
        last_ns: int | None = None
        for frame in file.frames(number, losses):
            if follows(frame.mid_exposure_ns, last_ns, losses):
                last_ns = frame.mid_exposure_ns
                yield Image(self._camera, channel, last_ns, frame.pixels)
