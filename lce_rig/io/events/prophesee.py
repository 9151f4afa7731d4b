"""Events in words of 16 bits: Prophesee's EVT3 and its .raw files; libcaer_cmp of ROS.

A .raw file is lines of text, then words up to the end. Both encodings are state machines: some words set the
time, the row (or column) or a base; others emit events from that state. A whole block is decoded at once:
a value set by a word is repeated up to the next word of its kind, and the words that hold the state at a
block's end are put before the next block.

References:
    https://docs.prophesee.ai/stable/data/file_formats/raw.html
    https://docs.prophesee.ai/stable/data/encoding_formats/evt3.html
    https://github.com/ros-event-camera/event_camera_codecs (libcaer_cmp: rows and columns exchanged)
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from lce_rig.core.data import EventColumns
from lce_rig.core.errors import SourceError, reading
from lce_rig.core.findings import Losses
from lce_rig.io.events.event_recording import NS_PER_US, EventStream, parse_size

_BLOCK_BYTES = 1 << 18


@dataclass
class WrappingCounter:
    """Tracks the high part of a camera's clock, which wraps around, from block to block.

    Attributes:
        n_bits: the counter wraps at 2**n_bits.
        max_step_back: smaller steps back are not wraps; cameras mix their words a little.
        last: value of the last word, wraps included; None before the first.
    """

    n_bits: int
    max_step_back: int
    last: int | None = None

    def unwrap(self, values: NDArray[np.int64]) -> NDArray[np.int64]:
        """Return the next counter values (N,) with wraps added."""
        if not len(values):
            return values
        # A single outlier in an ascending series would add a wrap permanently: the previous value replaces
        # it.
        before, word, after = values[:-2], values[1:-1], values[2:]
        is_steady = (after >= before) & (after - before <= self.max_step_back)
        is_odd = is_steady & (np.abs(word - before) > self.max_step_back)
        values = np.concatenate((values[:1], np.where(is_odd, before, word), values[1:][-1:]))
        last = int(values[0]) if self.last is None else self.last
        previous = np.concatenate(([last % (1 << self.n_bits)], values[:-1]))
        wraps = np.cumsum(values + self.max_step_back < previous) + (last >> self.n_bits)
        unwrapped = values + (wraps << self.n_bits)
        self.last = int(unwrapped[-1])
        return np.asarray(unwrapped, dtype=np.int64)


@dataclass(frozen=True)
class WordLayout:
    """Meaning of the codes: the upper 4 of 16 bits.

    Attributes:
        time_high, time_low: bits 12 to 23 and 0 to 11 of the time in us.
        line: sets the coordinate that the following events share (row in EVT3).
        single: one event at the other coordinate.
        base: first coordinate and polarity of the vectors that follow.
        vectors: number of bits by code of vector.
        is_line_x: the shared coordinate is the column.
    """

    time_high: int
    time_low: int
    line: int
    single: int
    base: int
    vectors: Mapping[int, int]
    is_line_x: bool


EVT3 = WordLayout(8, 6, 0, 2, 3, {4: 12, 5: 8}, is_line_x=False)
LIBCAER_CMP = WordLayout(0, 1, 2, 3, 4, {5: 8}, is_line_x=True)


class WordDecoder:
    """Decodes a stream of 16-bit words, block by block; events before any timestamp are skipped.

    Attributes:
        clock: the high part of the time: 12 bits of 4.096 ms.
    """

    def __init__(self, layout: WordLayout) -> None:
        self.clock = WrappingCounter(12, 10)
        self._layout = layout
        self._time = self._place = np.empty(0, np.uint16)
        # Number of bits of a vector by code, 0 for other words.
        self._n_bits = np.zeros(16, np.int64)
        self._n_bits[list(layout.vectors)] = list(layout.vectors.values())

    def start_packet(self) -> None:
        """Start a packet with times relative to its start."""
        layout = self._layout
        self._time = np.array([layout.time_high << 12, layout.time_low << 12], np.uint16)
        self.clock.last = 0

    def decode(self, words: NDArray[np.uint16]) -> EventColumns:
        """Decode a block of words (N,), of any length."""
        layout = self._layout
        words = np.concatenate((self._time, self._place, words))
        code, payload = (words >> 12).astype(np.uint8), (words & 0xFFF).astype(np.int64)
        at_high, at_low, at_line, at_base = (
            np.flatnonzero(code == c) for c in (layout.time_high, layout.time_low, layout.line, layout.base)
        )
        t_us = _held(at_high, self.clock.unwrap(payload[at_high]) << 12, len(words))
        t_us |= _held(at_low, payload[at_low], len(words))
        line = _held(at_line, payload[at_line] & 0x7FF, len(words))
        # Every vector advances the base by its width, until a word sets it again.
        n_bits = self._n_bits[code]
        moved = np.cumsum(n_bits) - n_bits
        base = _held(at_base, (payload[at_base] & 0x7FF) - moved[at_base], len(words)) + moved
        base_is_on = _held(at_base, payload[at_base] >> 11, len(words))
        is_single = code == layout.single
        start = np.where(is_single, payload & 0x7FF, base)
        is_on = np.where(is_single, payload >> 11, base_is_on) > 0

        word, bit = _expand(payload, is_single, n_bits)
        # A timestamp needs its low part after its high one.
        timed = at_low[at_low > at_high[0]] if len(at_high) else at_low[:0]
        n_untimed = int(np.searchsorted(word, timed[0])) if len(timed) else len(word)
        word, bit = word[n_untimed:], bit[n_untimed:]

        if len(words):
            self._time = words[np.concatenate((at_high[-1:], timed[-1:]))]
            next_base = (base[-1] + n_bits[-1]) & 0x7FF | base_is_on[-1] << 11
            place = (layout.line << 12 | line[-1], layout.base << 12 | next_base)
            self._place = np.array(place, np.uint16)
        along, across = (start[word] + bit).astype(np.uint16), line[word].astype(np.uint16)
        x, y = (across, along) if layout.is_line_x else (along, across)
        return EventColumns(t_us[word] * NS_PER_US, x, y, is_on[word])


def _held(at: NDArray[np.intp], values: NDArray[np.int64], n: int) -> NDArray[np.int64]:
    """Hold each value (K,) from its place to the next; (n,), 0 before the first."""
    lengths = np.diff(at, prepend=0, append=n)
    return np.repeat(np.concatenate((np.zeros(1, np.int64), values)), lengths)


def _expand(
    payload: NDArray[np.int64], is_single: NDArray[np.bool_], n_bits: NDArray[np.int64]
) -> tuple[NDArray[np.intp], NDArray[np.int64]]:
    """List the word and the bit of every event in order: one per single event, the set bits per vector."""
    vectors = np.flatnonzero(n_bits)
    masks = (payload[vectors] & ((1 << n_bits[vectors]) - 1)).astype("<u2")
    # Only vectors are unpacked: 16 places per word are many if nearly all events are single.
    set_bits = np.flatnonzero(np.unpackbits(masks.view(np.uint8), bitorder="little"))
    n_events = is_single.astype(np.intp)
    n_events[vectors] = np.bincount(set_bits >> 4, minlength=len(vectors))
    word = np.repeat(np.arange(len(payload)), n_events)
    bit = np.zeros(len(word), np.int64)
    bit[~is_single[word]] = set_bits & 15
    return word, bit


class PropheseeEvents(EventStream):
    """Events of a .raw file; see `EventStream`."""

    def __init__(self, path: Path) -> None:
        """Read the header.

        Raises:
            SourceError: not a .raw file, or one in another encoding.
        """
        self._path = path
        self.notes: list[str] = []
        with reading(path), path.open("rb") as file:
            header = _read_header(file)
            self._begin = file.tell()
        self.serial = header.get("serial_number", "")
        # The format line holds more: "EVT3;height=720;width=1280".
        encoding, *fields = header.get("format", "").split(";")
        named = header.get("evt", encoding.upper().removeprefix("EVT"))
        if named.removesuffix(".0") != "3":
            hint = "Check that it is a Prophesee .raw file, or convert it to EVT3."
            raise SourceError(f"{path} has the encoding {named[:20]!r}, not EVT3", hint)
        size = dict(field.partition("=")[::2] for field in fields)
        width, height = size.get("width", ""), size.get("height", "")
        if not (width and height):
            width, _, height = header.get("geometry", "").partition("x")
        self.resolution_px = parse_size(width, height)

    def stretches(self, losses: Losses) -> Iterator[EventColumns]:
        """Yield the events of the file, block by block."""
        decoder = WordDecoder(EVT3)
        with reading(self._path), self._path.open("rb") as file:
            file.seek(self._begin)
            while block := file.read(_BLOCK_BYTES):
                yield decoder.decode(np.frombuffer(block, "<u2", len(block) // 2))


def _read_header(file: BinaryIO) -> dict[str, str]:
    """Read "% key value" lines, up to the first other line or "% end"."""
    header: dict[str, str] = {}
    while True:
        begin = file.tell()
        line = file.readline()
        if not line.startswith(b"% ") or not line.endswith(b"\n"):
            file.seek(begin)
            return header
        key, _, value = line[2:].decode("utf-8", errors="replace").strip().partition(" ")
        if key == "end":
            return header
        header[key] = value
