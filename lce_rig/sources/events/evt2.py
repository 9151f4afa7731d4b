"""Prophesee's EVT2 (32-bit words) and EVT2.1 (64-bit words, 32 pixels of a row each).

References:
    https://docs.prophesee.ai/stable/data/encoding_formats/evt2.html
    https://docs.prophesee.ai/stable/data/encoding_formats/evt21.html
"""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from lce_rig.sources.events.counter import WrappingCounter
from lce_rig.sources.events.stream import NS_PER_US, EventColumns

_OFF, _ON, _TIME_HIGH = 0, 1, 8
_KNOWN = (_OFF, _ON, _TIME_HIGH, 0xA, 0xE, 0xF)
_HIGH_BITS = 28
_MAX_STEP_BACK = 1 << 10


@dataclass
class Evt2Decoder:
    """Decodes EVT2 or EVT2.1 block by block; the time continues from one to the next.

    Attributes:
        has_vectors: EVT2.1, whose events carry 32 pixels each.
        n_untimed: words with events met before any timestamp, skipped.
        n_unknown: words of no known code, passed over.
    """

    has_vectors: bool
    n_untimed: int = 0
    n_unknown: int = 0
    _clock: WrappingCounter = field(default_factory=lambda: WrappingCounter(_HIGH_BITS, _MAX_STEP_BACK))

    @property
    def n_repaired(self) -> int:
        """Time words that did not fit those around them, for which the one before was taken."""
        return self._clock.n_repaired

    def decode(self, words: NDArray[np.unsignedinteger]) -> EventColumns:
        """Decode a block of words (N,), uint32 for EVT2 and uint64 for EVT2.1."""
        vector = words.astype(np.uint32) if self.has_vectors else np.ones(1, np.uint32)
        upper = (words >> np.uint64(32)).astype(np.uint32) if self.has_vectors else words.astype(np.uint32)
        code = (upper >> 28).astype(np.uint8)
        self.n_unknown += int(np.count_nonzero(~np.isin(code, _KNOWN)))
        high, timed_from = self._high_parts(code, upper)
        emitting = np.flatnonzero(code <= _ON)
        n_untimed = int(np.searchsorted(emitting, timed_from))
        self.n_untimed += n_untimed
        emitting = emitting[n_untimed:]
        event = upper[emitting]
        t_us = (high[emitting] << 6) | ((event >> 22) & 0x3F)
        x = ((event >> 11) & 0x7FF).astype(np.uint16)
        y = (event & 0x7FF).astype(np.uint16)
        columns = EventColumns(t_us * NS_PER_US, x, y, code[emitting] == _ON)
        return _expand(columns, vector[emitting]) if self.has_vectors else columns

    def _high_parts(
        self, code: NDArray[np.uint8], upper: NDArray[np.uint32]
    ) -> tuple[NDArray[np.int64], int]:
        """Give the high part (N,) of the time that holds at each word, and the first word that has one."""
        at = np.flatnonzero(code == _TIME_HIGH)
        values = (upper[at] & np.uint32((1 << _HIGH_BITS) - 1)).astype(np.int64)
        before = self._clock.last
        timed_from = 0 if before is not None else int(at[0]) if len(at) else len(code)
        values = self._clock.unwrap(values)
        lengths = np.diff(at, prepend=0, append=len(code))
        return np.repeat(np.concatenate(([before or 0], values)), lengths), timed_from


def _expand(columns: EventColumns, vector: NDArray[np.uint32]) -> EventColumns:
    """Make one event of every bit that is set; bit i is the pixel x + i."""
    flags = np.unpackbits(vector.astype("<u4").view(np.uint8), bitorder="little").view(np.bool_)
    flat = np.flatnonzero(flags)
    word, bit = flat >> 5, flat & 31
    x = columns.x[word] + bit.astype(np.uint16)
    return EventColumns(columns.t_ns[word], x, columns.y[word], columns.polarity[word])
