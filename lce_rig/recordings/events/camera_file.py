"""A file of an event camera's own recorder: its events and, in AEDAT4, its frames."""

import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lce_rig.core import limits
from lce_rig.core.data import Image, Sample, Stream
from lce_rig.recordings.events import open_events
from lce_rig.recordings.events.aedat4_file import Aedat4File, add_broken, field_at, vector_at
from lce_rig.recordings.events.choice import CameraEvents
from lce_rig.recordings.events.stream import NS_PER_US, DamageCounts, NoEventsError
from lce_rig.recordings.fingerprint import fingerprint
from lce_rig.recordings.merging import merge_by_time
from lce_rig.recordings.protocol import SourceOptions, Span
from lce_rig.recordings.sensor_choice import choose_event_camera
from lce_rig.rig import Rig

# Frames of iniVation's AEDAT4 files, with timestamps at the middle of their exposure.
#
# What a frame's own timestamp means has changed: DV's timestamps were the middle of the exposure,
# dv-processing's are its start. Both also write its start and end, which mean the same in every file, and
# are
# taken.
#
# References:
#     https://gitlab.com/inivation/dv/dv-processing/-/blob/master/include/dv-processing/data/frame_base.hpp

# Places in dv's table Aedat4Image; 1 and 2 are of the read-out.
_TIMESTAMP, _EXPOSURE_START, _EXPOSURE_END, _FORMAT, _WIDTH, _HEIGHT, _PIXELS, _EXPOSURE = (
    0,
    3,
    4,
    5,
    6,
    7,
    10,
    11,
)
# OpenCV's type numbers of 8-bit images.
_CHANNELS = {0: 1, 16: 3, 24: 4}


@dataclass(frozen=True, eq=False)
class Aedat4Image:
    """One image of a file.

    Attributes:
        mid_exposure_ns: device time; the frame's own timestamp where the exposure is not known.
        exposure_ns: 0 where the file does not say.
        pixels: (H, W) grey or (H, W, 3) BGR, uint8.
    """

    mid_exposure_ns: int
    exposure_ns: int
    pixels: NDArray[np.uint8]


class Aedat4Frames:
    """A stream of frames of an AEDAT4 file."""

    def __init__(self, file: Aedat4File, number: int) -> None:
        """Open the stream of that number, as `Aedat4File.first_stream` found it."""
        self._file = file
        self._number = number

    def first(self) -> Aedat4Image | None:
        """Decode the first frame that is whole; None where there is none."""
        return next(self.frames(DamageCounts()), None)

    def count(self) -> int:
        """Count the frames, damaged ones too, without decoding them."""
        return self._file.n_packets(self._number)

    def frames(self, findings: DamageCounts) -> Iterator[Aedat4Image]:
        """Yield the frames as they lie in the file; damaged ones are skipped and counted."""
        for where, table in self._file.packets(self._number, findings):
            try:
                frame = decode_frame(table)
            except Exception as error:  # A damaged packet fails in any way: struct, sizes.
                add_broken(findings, where, error)
                continue
            yield frame

    def span_ns(self) -> tuple[int, int] | None:
        """Find the first and last timestamp, skipping the frames between them; None without frames."""
        first = self.first()
        table = self._file.last_packet(self._number)
        if first is None or table is None:
            return None
        try:
            return first.mid_exposure_ns, decode_frame(table).mid_exposure_ns
        except Exception:  # As above.
            return None


def decode_frame(table: bytes) -> Aedat4Image:
    """Decode one packet.

    Raises:
        ValueError: it holds no frame, or one of a kind that is not known.
    """
    if table[4:8] != b"FRME":
        raise ValueError(f"it holds {bytes(table[4:8])!r}, no frame")
    stamp_us, start_us, end_us, exposure_us = (
        _number(table, index, "q") for index in (_TIMESTAMP, _EXPOSURE_START, _EXPOSURE_END, _EXPOSURE)
    )
    if end_us > start_us > 0:
        mid_ns, exposure_us = (start_us + end_us) * NS_PER_US // 2, end_us - start_us
    else:
        mid_ns = stamp_us * NS_PER_US + exposure_us * NS_PER_US // 2
    if abs(mid_ns) >= limits.MAX_TIME_NS:
        raise ValueError("its timestamp is beyond any clock")
    return Aedat4Image(mid_ns, exposure_us * NS_PER_US, _pixels(table))


def _pixels(table: bytes) -> NDArray[np.uint8]:
    width, height, kind = (
        _number(table, _WIDTH, "h"),
        _number(table, _HEIGHT, "h"),
        _number(table, _FORMAT, "b"),
    )
    n_channels = _CHANNELS.get(kind)
    at, n_bytes = vector_at(table, _PIXELS)
    if n_channels is None:
        raise ValueError(f"its pixels are of OpenCV's type {kind}, not 8-bit grey or colour")
    if width <= 0 or height <= 0 or n_bytes != width * height * n_channels:
        raise ValueError(f"{n_bytes} bytes are no picture of {width}x{height} pixels")
    pixels = np.frombuffer(table, np.uint8, n_bytes, at).reshape(height, width, n_channels)
    return np.array(pixels[..., 0] if n_channels == 1 else pixels[..., :3])


def _number(table: bytes, index: int, kind: str) -> int:
    at = field_at(table, index)
    return 0 if at is None else int(struct.unpack_from(f"<{kind}", table, at)[0])


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
        findings = DamageCounts()
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

    def _images(self, frames: Aedat4Frames, findings: DamageCounts) -> Iterator[Sample]:
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
