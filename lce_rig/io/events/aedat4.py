"""Events and frames of iniVation's AEDAT4 files, read without iniVation's library."""

import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lce_rig.core import limits
from lce_rig.core.data import EventColumns
from lce_rig.core.losses import Losses
from lce_rig.io.events.aedat4_file import Aedat4File, field_at, vector_at
from lce_rig.io.events.stream import (
    NS_PER_US,
    NoEventsError,
    join_small,
    parse_size,
    to_ns,
)

EVENT = np.dtype({"names": ["t", "x", "y", "on"], "formats": ["<i8", "<i2", "<i2", "?"], "itemsize": 16})
_STRETCH_EVENTS = 1 << 16


class Aedat4Events:
    """Events of an AEDAT4 file; see `EventStream`."""

    def __init__(self, path: Path) -> None:
        """Read the header and take the first stream of events.

        Raises:
            NoEventsError: it has no events.
            SourceError: it is not an AEDAT4 file.
        """
        self._file = Aedat4File(path)
        number = self._file.first_stream("EVTS")
        if number is None:
            kinds = ", ".join(kind for kind, _ in self._file.header.streams.values()) or "none"
            raise NoEventsError(f"{path} holds no stream of events; its streams: {kinds}")
        self._number = number
        self.notes = self._file.notes
        _, attributes = self._file.header.streams[number]
        self.resolution_px = parse_size(attributes.get("sizeX", ""), attributes.get("sizeY", ""))

    def stretches(self, losses: Losses) -> Iterator[EventColumns]:
        """Yield the events, some packets at a time."""
        yield from join_small(self._packets(losses), _STRETCH_EVENTS)

    def duration_ns(self) -> int | None:
        """Compare the first packet with the last; None where they are damaged."""
        last = self._file.last_packet(self._number, _decode_packet)
        first = next((packet for packet in self._packets(Losses()) if len(packet)), None)
        return int(last.t_ns[-1]) - int(first.t_ns[0]) if first is not None and last else None

    def _packets(self, losses: Losses) -> Iterator[EventColumns]:
        return self._file.packets(self._number, losses, _decode_packet)


def _decode_packet(table: bytes) -> EventColumns:
    """Decode one packet of events.

    Raises:
        ValueError: it holds no events.
    """
    if table[4:8] != b"EVTS":
        raise ValueError(f"it holds {bytes(table[4:8])!r}, not events")
    at, n_events = vector_at(table, 0)
    events = np.frombuffer(table, EVENT, n_events, at) if n_events else np.empty(0, EVENT)
    x, y = events["x"].astype(np.uint16), events["y"].astype(np.uint16)
    return EventColumns(to_ns(events["t"]), x, y, events["on"].view(np.uint8) != 0)


# Frames of iniVation's AEDAT4 files, with timestamps at the middle of their exposure.
#
# What a frame's own timestamp means has changed: DV's timestamps were the middle of the exposure,
# dv-processing's are its start. Both also write its start and end, which mean the same in every file: these
# are taken.
#
# References:
#     https://gitlab.com/inivation/dv/dv-processing/-/blob/master/include/dv-processing/data/frame_base.hpp

# Places in dv's table Aedat4Image; 1 and 2 are of the read-out.
_TIMESTAMP, _EXPOSURE_START, _EXPOSURE_END, _FORMAT = 0, 3, 4, 5
_WIDTH, _HEIGHT, _PIXELS, _EXPOSURE = 6, 7, 10, 11
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


def decode_frame(table: bytes) -> Aedat4Image:
    """Decode one packet.

    Raises:
        ValueError: it holds no frame, or one of a kind that is not known.
    """
    if table[4:8] != b"FRME":
        raise ValueError(f"it holds {bytes(table[4:8])!r}, not a frame")
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
        raise ValueError(f"{n_bytes} bytes are not an image of {width}x{height} pixels")
    pixels = np.frombuffer(table, np.uint8, n_bytes, at).reshape(height, width, n_channels)
    return np.array(pixels[..., 0] if n_channels == 1 else pixels[..., :3])


def _number(table: bytes, index: int, kind: str) -> int:
    at = field_at(table, index)
    return 0 if at is None else int(struct.unpack_from(f"<{kind}", table, at)[0])
