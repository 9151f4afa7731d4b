"""iniVation's AEDAT4 files: events and images, read by aedat, up to the end of a torn file.

References:
    https://docs.inivation.com/software/software-advanced-usage/file-formats/aedat-4.0.html
    https://github.com/neuromorphicsystems/aedat
"""

import re
import struct
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import count
from pathlib import Path
from typing import Any, NamedTuple

import aedat
import numpy as np
from numpy.typing import NDArray

from lce_rig.core.data import MAX_TIME_NS, EventColumns
from lce_rig.core.errors import reading, reason_of
from lce_rig.core.findings import Losses
from lce_rig.io import findings
from lce_rig.io.decoding import to_8_bit
from lce_rig.io.events.event_recording import NS_PER_US, EventStream, NoEventsError, parse_size, to_ns

_SOURCE = re.compile(rb'"source"[^>]*>(?:DAVIS|DV)[A-Za-z0-9]*_([A-Za-z0-9]{1,64})<')
_MAGIC, _MOST_HEADER_BYTES = b"#!AER-DAT4.0\r\n", 1 << 16
# A decoder at the end of a torn file fails again and again.
_TORN, _MOST_FAILURES = "failed to fill whole buffer", 100


class Aedat4Frame(NamedTuple):
    """One image of a file.

    Attributes:
        mid_exposure_ns: device time; the frame's own timestamp if the exposure is unknown.
        exposure_ns: 0 if the file does not record it.
        pixels: (H, W) grey or (H, W, 3) BGR, uint8.
    """

    mid_exposure_ns: int
    exposure_ns: int
    pixels: NDArray[np.uint8]


@contextmanager
def _panics() -> Iterator[None]:
    """Convert aedat's panic on damaged data, which is not an Exception, to a ValueError."""
    try:
        yield
    except BaseException as error:
        if type(error).__name__ != "PanicException":
            raise
        raise ValueError(str(error)) from None


class Aedat4File:
    """The streams of an AEDAT4 file.

    Attributes:
        path: the file.
        streams: type ("events", "frame" and others) and size by number.
        serial: the camera's serial number, if a stream's source is named like DAVIS346_00000499, else "".
        notes: remarks on an unusual file, in words.
    """

    def __init__(self, path: Path) -> None:
        """Read the header.

        Raises:
            SourceError: not an AEDAT4 file, or its header is damaged.
        """
        self.path = path
        self.notes: list[str] = []
        self.streams: dict[int, dict[str, Any]] = {}
        hint = "Convert older files (AEDAT 2, 3) with DV first."
        with reading(path, hint=hint), path.open("rb") as file:
            header = file.read(_MOST_HEADER_BYTES)
            if header.startswith(_MAGIC):
                (n_bytes,) = struct.unpack_from("<I", header, len(_MAGIC))
                # aedat ends the program if the header is not text.
                header[header.index(b"<dv") : len(_MAGIC) + 4 + n_bytes].decode()
            with _panics():
                self.streams |= sorted(aedat.Decoder(path).id_to_stream().items())
        source = _SOURCE.search(header)
        self.serial = source[1].decode() if source else ""

    def first_stream(self, kind: str) -> int | None:
        """Return the number of the first stream of a type, "events" or "frame"; note other streams."""
        numbers = [number for number, stream in self.streams.items() if stream["type"] == kind]
        if len(numbers) > 1:
            self.notes.append(f"{self.path.name}: {kind} of stream {numbers[0]}, the first of {len(numbers)}")
        return numbers[0] if numbers else None

    def packets(self, stream: int, losses: Losses) -> Iterator[dict[str, Any]]:
        """Yield the packets of a stream; damaged ones are skipped."""
        with reading(self.path):
            decoder, n_failures = aedat.Decoder(self.path), 0
            for number in count():
                try:
                    with _panics():
                        packet = next(decoder, None)
                except (RuntimeError, ValueError) as error:
                    n_failures += 1
                    if _TORN in str(error) or n_failures > _MOST_FAILURES:
                        losses.add(findings.TORN_END(where=f"after packet {number - 1}"))
                        return
                    losses.add(findings.BROKEN_PACKETS(where=f"packet {number}: {reason_of(error)}"))
                    continue
                if packet is None:
                    return
                n_failures = 0
                if packet["stream_id"] == stream:
                    yield packet

    def frames(self, stream: int, losses: Losses) -> Iterator[Aedat4Frame]:
        """Yield the images of a stream of frames; damaged ones are skipped."""
        for packet in self.packets(stream, losses):
            frame = packet["frame"]
            begin_us, exposure_us = frame["t"], 0
            if frame["exposure_end_t"] > frame["exposure_begin_t"] > 0:
                begin_us = frame["exposure_begin_t"]
                exposure_us = frame["exposure_end_t"] - begin_us
            mid_ns = begin_us * NS_PER_US + exposure_us * NS_PER_US // 2
            if abs(mid_ns) >= MAX_TIME_NS:
                losses.add(findings.BROKEN_PACKETS(where="a frame's timestamp is beyond any clock"))
                continue
            # Colours are RGB, with or without alpha.
            pixels = frame["pixels"] if frame["pixels"].ndim == 2 else frame["pixels"][..., 2::-1]
            yield Aedat4Frame(mid_ns, exposure_us * NS_PER_US, to_8_bit(pixels))


class Aedat4Events(EventStream):
    """Events of an AEDAT4 file; see `EventStream`."""

    def __init__(self, path: Path) -> None:
        """Read the header and take the first stream of events.

        Raises:
            NoEventsError: the file has no events.
            SourceError: not an AEDAT4 file.
        """
        self._file = Aedat4File(path)
        number = self._file.first_stream("events")
        if number is None:
            kinds = ", ".join(stream["type"] for stream in self._file.streams.values()) or "none"
            raise NoEventsError(f"{path} holds no stream of events; its streams: {kinds}")
        self._number = number
        self.notes = self._file.notes
        stream = self._file.streams[number]
        self.resolution_px = parse_size(str(stream["width"]), str(stream["height"]))

    def stretches(self, losses: Losses) -> Iterator[EventColumns]:
        """Yield the events, a packet at a time."""
        for packet in self._file.packets(self._number, losses):
            events = packet["events"]
            t_ns = to_ns(events["t"].astype(np.int64))
            yield EventColumns(t_ns, events["x"].copy(), events["y"].copy(), events["on"].copy())
