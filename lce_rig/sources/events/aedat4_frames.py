"""Frames of iniVation's AEDAT4 files, with timestamps at the middle of their exposure.

What a frame's own timestamp means has changed: DV's timestamps were the middle of the exposure,
dv-processing's are its start. Both also write its start and end, which mean the same in every file, and are
taken.

References:
    https://gitlab.com/inivation/dv/dv-processing/-/blob/master/include/dv-processing/data/frame_base.hpp
"""

import struct
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lce_rig.core import limits
from lce_rig.sources.events.aedat4_file import Aedat4File, add_broken, field_at, vector_at
from lce_rig.sources.events.stream import NS_PER_US, Findings

# Places in dv's table Frame; 1 and 2 are of the read-out.
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
class Frame:
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

    def first(self) -> Frame | None:
        """Decode the first frame that is whole; None where there is none."""
        return next(self.frames(Findings()), None)

    def count(self) -> int:
        """Count the frames, damaged ones too, without decoding them."""
        return self._file.n_packets(self._number)

    def frames(self, findings: Findings) -> Iterator[Frame]:
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


def decode_frame(table: bytes) -> Frame:
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
    return Frame(mid_ns, exposure_us * NS_PER_US, _pixels(table))


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
