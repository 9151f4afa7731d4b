"""Streams of 16-bit words, 4 bits of code and 12 of payload: Prophesee's EVT3, the ROS driver's libcaer_cmp.

Both are state machines: words set the time, the row (or column) and a polarity; others emit events from that
state. Here a whole block is decoded at once: what a word sets is repeated up to the next of its kind, and a
single event is a vector with one bit, so that both expand alike and keep their order.

References:
    https://docs.prophesee.ai/stable/data/encoding_formats/evt3.html
    https://github.com/ros-event-camera/event_camera_codecs (libcaer_cmp: rows and columns exchanged)
"""

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from lce_rig.core.data import EventColumns
from lce_rig.io.events.counter import WrappingCounter
from lce_rig.io.events.stream import NS_PER_US

# Time-high words count 4.096 ms each, wrap every 16.8 s, and may step back a little without having wrapped.
_HIGH_BITS = 12
_MAX_STEP_BACK = 10


@dataclass(frozen=True)
class WordLayout:
    """Which code means what.

    Attributes:
        time_high, time_low: bits 12 to 23 and 0 to 11 of the time in us.
        line: sets the coordinate that the following events share (row in EVT3).
        single: one event at the other coordinate.
        base: first coordinate and polarity of the vectors that follow.
        vectors: number of bits by code of vector.
        known: other codes that may occur and are skipped.
        is_line_x: the shared coordinate is the column.
    """

    time_high: int
    time_low: int
    line: int
    single: int
    base: int
    vectors: Mapping[int, int]
    known: frozenset[int]
    is_line_x: bool


EVT3 = WordLayout(8, 6, 0, 2, 3, {4: 12, 5: 8}, frozenset({7, 9, 10, 14, 15}), is_line_x=False)
LIBCAER_CMP = WordLayout(0, 1, 2, 3, 4, {5: 8}, frozenset(), is_line_x=True)


@dataclass
class WordDecoder:
    """Decodes a stream block by block; the state continues from one to the next.

    Attributes:
        layout: what the codes mean.
        n_untimed: events met before any timestamp, skipped.
        n_unknown: words of no known code, skipped.
    """

    layout: WordLayout
    n_untimed: int = 0
    n_unknown: int = 0
    _clock: WrappingCounter = field(default_factory=lambda: WrappingCounter(_HIGH_BITS, _MAX_STEP_BACK))
    _low: int | None = None
    _line: int = 0
    _next: int = 0
    _polarity: int = 0
    _tables: dict[str, NDArray[np.uint8]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        width = np.zeros(16, np.uint8)
        width[self.layout.single] = 1
        for code, n_bits in self.layout.vectors.items():
            width[code] = n_bits
        unknown = np.ones(16, np.uint8)
        named = (*_named_codes(self.layout), *self.layout.known)
        unknown[list(named)] = 0
        self._tables = {"width": width, "unknown": unknown}

    @property
    def n_repaired(self) -> int:
        """Time words that did not fit those around them, for which the one before was taken."""
        return self._clock.n_repaired

    def start_packet(self) -> None:
        """Begin a packet that counts its time from zero."""
        self._clock.last, self._low = 0, 0

    def decode(self, words: NDArray[np.uint16]) -> EventColumns:
        """Decode a block of words (N,), of any length."""
        code = (words >> 12).astype(np.uint8)
        payload = words & np.uint16(0xFFF)
        self.n_unknown += int(self._tables["unknown"][code].sum())
        width = self._tables["width"][code]
        emitting = np.flatnonzero(width > 0)
        t_us, is_timed = self._times(code, payload, emitting)
        line = self._lines(code, payload, emitting)
        is_vector = code[emitting] != self.layout.single
        start, polarity, bits = self._spans(code, payload, emitting, is_vector)
        word, bit = _expand(bits, is_vector)
        if not is_timed.all():
            keep = is_timed[word]
            self.n_untimed += int(np.count_nonzero(~keep))
            word, bit = word[keep], bit[keep]
        along = (start[word] + bit).astype(np.uint16)
        across = line[word]
        x, y = (across, along) if self.layout.is_line_x else (along, across)
        return EventColumns(t_us[word] * NS_PER_US, x, y, polarity[word])

    def _times(
        self, code: NDArray[np.uint8], payload: NDArray[np.uint16], emitting: NDArray[np.intp]
    ) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
        """Give timestamp (M,) us of every emitting word, and whether it has one."""
        at_high = np.flatnonzero(code == self.layout.time_high)
        at_low = np.flatnonzero(code == self.layout.time_low)
        timed_from = len(code)
        last = self._clock.last
        if last is not None and self._low is not None:
            timed_from = 0
        elif last is not None and len(at_low):
            timed_from = int(at_low[0])
        elif len(at_high) and len(at_low[at_low > at_high[0]]):
            timed_from = int(at_low[at_low > at_high[0]][0])
        high = self._clock.unwrap(payload[at_high].astype(np.int64))
        low = payload[at_low]
        t_us = _held(at_high, high, last or 0, len(code))[emitting] << 12
        t_us |= _held(at_low, low, self._low or 0, len(code))[emitting]
        # A timestamp needs its low part after its high one.
        if len(low) and timed_from < len(code):
            self._low = int(low[-1])
        return t_us, emitting >= timed_from

    def _lines(
        self, code: NDArray[np.uint8], payload: NDArray[np.uint16], emitting: NDArray[np.intp]
    ) -> NDArray[np.uint16]:
        at = np.flatnonzero(code == self.layout.line)
        line = payload[at] & np.uint16(0x7FF)
        held = _held(at, line, self._line, len(code))[emitting]
        if len(line):
            self._line = int(line[-1])
        return held.astype(np.uint16)

    def _spans(
        self,
        code: NDArray[np.uint8],
        payload: NDArray[np.uint16],
        emitting: NDArray[np.intp],
        is_vector: NDArray[np.bool_],
    ) -> tuple[NDArray[np.int64], NDArray[np.bool_], NDArray[np.uint16]]:
        """Give first coordinate, polarity and bits (M,) of every emitting word."""
        words = payload[emitting]
        start = (words & np.uint16(0x7FF)).astype(np.int64)
        polarity = (words >> 11).astype(bool)
        bits = np.ones(len(words), np.uint16)
        at_base = np.flatnonzero(code == self.layout.base)
        if len(at_base) or is_vector.any():
            vectors = emitting[is_vector]
            steps = self._tables["width"][code[vectors]].astype(np.int64)
            base = payload[at_base]
            # Every vector moves the base on by its width, until a word sets it again.
            moved = np.concatenate(([0], np.cumsum(steps)))
            group = _held(at_base, np.arange(1, len(base) + 1), 0, len(code))[vectors]
            begins = np.concatenate(([self._next], base & np.uint16(0x7FF))).astype(np.int64)
            moved_at_base = np.concatenate(([0], moved[np.searchsorted(vectors, at_base)]))
            signs = np.concatenate(([self._polarity], base >> 11)).astype(bool)
            start[is_vector] = begins[group] + moved[:-1] - moved_at_base[group]
            polarity[is_vector] = signs[group]
            bits[is_vector] = words[is_vector] & ((1 << steps) - 1).astype(np.uint16)
            self._next = int(begins[-1] + moved[-1] - moved_at_base[-1])
            self._polarity = int(signs[-1])
        return start, polarity, bits


def _named_codes(layout: WordLayout) -> tuple[int, ...]:
    return (
        layout.time_high,
        layout.time_low,
        layout.line,
        layout.single,
        layout.base,
        *layout.vectors,
    )


def _held(at: NDArray[np.intp], values: NDArray[np.generic], initial: int, n: int) -> NDArray[np.int64]:
    """Hold each value (K,) from its place on until the next: (n,)."""
    filled = np.empty(len(at) + 1, np.int64)
    filled[0], filled[1:] = initial, values
    lengths = np.diff(at, prepend=0, append=n)
    return np.repeat(filled, lengths)


def _expand(
    bits: NDArray[np.uint16], is_vector: NDArray[np.bool_]
) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """List word and place of every event, in order: each single's one, and a vector's bits that are set."""
    vectors = np.flatnonzero(is_vector)
    # Vectors alone are unpacked: 16 places a word are many where nearly all events are single.
    flags = np.unpackbits(bits[vectors].astype("<u2").view(np.uint8), bitorder="little").view(np.bool_)
    at = np.flatnonzero(flags)
    n_events = np.ones(len(bits), np.intp)
    n_events[vectors] = np.bincount(at >> 4, minlength=len(vectors))
    word = np.repeat(np.arange(len(bits)), n_events)
    bit = np.zeros(len(word), np.intp)
    bit[is_vector[word]] = at & 15
    return word, bit
