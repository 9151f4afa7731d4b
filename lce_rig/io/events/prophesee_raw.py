"""Prophesee's .raw files: lines of text, then EVT2, EVT2.1 or EVT3 words up to the end.

References:
    https://docs.prophesee.ai/stable/data/file_formats/raw.html
"""

import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from lce_rig.core import limits
from lce_rig.core.data import EventColumns
from lce_rig.core.errors import SourceError
from lce_rig.core.losses import Losses
from lce_rig.io.events.counter import WrappingCounter
from lce_rig.io.events.stream import NS_PER_US, damage, open_recorded, parse_size
from lce_rig.io.events.word_codec import EVT3, WordDecoder

# Prophesee's EVT2 (32-bit words) and EVT2.1 (64-bit words, 32 pixels of a row each).
#
# References:
#     https://docs.prophesee.ai/stable/data/encoding_formats/evt2.html
#     https://docs.prophesee.ai/stable/data/encoding_formats/evt21.html

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
        n_unknown: words of no known code, skipped.
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


_BLOCK_BYTES = 1 << 18
_MAX_HEADER_BYTES = 1 << 18
_WORDS = {"2": "<u4", "21": "<u8", "3": "<u2"}
# Where a file names its sensor but not its resolution.
_RESOLUTION_PX = {
    "gen31": (640, 480),
    "gen3": (640, 480),
    "genx320": (320, 320),
    "gen4": (1280, 720),
    "imx636": (1280, 720),
    "imx646": (1280, 720),
}


class PropheseeEvents:
    """Events of a .raw file; see `EventStream`."""

    def __init__(self, path: Path) -> None:
        """Read the header.

        Raises:
            SourceError: it is no .raw file, or of another encoding.
        """
        self._path = path
        self.notes: list[str] = []
        with open_recorded(path) as file:
            header = _read_header(path, file)
            self._begin = file.tell()
        self.serial = header.get("serial_number", "")
        self._version = _version(path, header)
        order = _field(header, "endianness")
        self._is_swapped = self._version == "21" and (
            order == "legacy" or (not order and _looks_swapped(path, self._begin))
        )
        self.resolution_px = _resolution(header)
        said = _field(header, "width"), _field(header, "height")
        if self.resolution_px is None and (any(said) or "geometry" in header):
            size = header.get("geometry") or "x".join(said)
            self.notes.append(
                f"{path.name}: its header's size {limits.describe(size)} is not a sensor's and is ignored"
            )

    def stretches(self, losses: Losses) -> Iterator[EventColumns]:
        """Yield the events of the file, block by block."""
        dtype = np.dtype(_WORDS[self._version])
        decoder: Any = WordDecoder(EVT3) if self._version == "3" else Evt2Decoder(self._version == "21")
        with open_recorded(self._path) as file:
            file.seek(self._begin)
            while block := file.read(_BLOCK_BYTES):
                n_torn = len(block) % dtype.itemsize
                words: NDArray[Any] = np.frombuffer(block, dtype, len(block) // dtype.itemsize)
                yield decoder.decode(_swapped(words) if self._is_swapped else words)
                if n_torn:
                    losses.add(damage("recording.torn_word"), n_torn)
        losses.add(damage("recording.events_untimed"), decoder.n_untimed)
        losses.add(damage("recording.time_words_repaired"), decoder.n_repaired)
        losses.add(damage("recording.unknown_words"), decoder.n_unknown)


def _read_header(path: Path, file: BinaryIO) -> dict[str, str]:
    """Read "% key value" lines, up to the first other line, or one that says "% end".

    Raises:
        SourceError: there is no end to them.
    """
    header: dict[str, str] = {}
    while True:
        begin = file.tell()
        if begin > _MAX_HEADER_BYTES:
            raise SourceError(f"{path}: its header is longer than {_MAX_HEADER_BYTES >> 10} kB")
        line = file.readline(limits.MAX_LINE_BYTES)
        if not line.startswith(b"% ") or not line.endswith(b"\n"):
            file.seek(begin)
            return header
        key, _, value = line[2:].decode("utf-8", errors="replace").strip().partition(" ")
        if key == "end":
            return header
        header[key] = value


def _swapped(words: NDArray[np.uint64]) -> NDArray[np.uint64]:
    """Exchange the halves of EVT2.1 words: the IMX636 sends the upper one first."""
    return np.asarray(words >> np.uint64(32) | words << np.uint64(32))


def _looks_swapped(path: Path, begin: int) -> bool:
    """Return the order of EVT2.1's halves by the timestamps, which rise in the right one."""
    with open_recorded(path) as file:
        file.seek(begin)
        block = file.read(_BLOCK_BYTES)
    words = np.frombuffer(block, "<u8", len(block) // 8)
    upper, swapped = (w >> np.uint64(32) for w in (words, _swapped(words)))
    return not _has_clock(upper) and _has_clock(swapped)


def _has_clock(upper: NDArray[np.uint64]) -> bool:
    high = upper[upper >> np.uint64(28) == 8].astype(np.int64)
    return len(high) > 0 and bool(np.all(np.diff(high) >= 0))


def _version(path: Path, header: dict[str, str]) -> str:
    """Say which encoding the header names: "2", "21" or "3"."""
    named = header.get("evt") or header.get("format", "").split(";")[0].upper().removeprefix("EVT")
    version = named.replace(".0", "").replace(".", "").strip()
    if version not in _WORDS:
        said = f"encoding {limits.describe(named)}" if named else "no encoding in its header"
        raise SourceError(
            f"{path} has {said}, not EVT2, EVT2.1 or EVT3", "Check that it is a Prophesee .raw file."
        )
    return version


def _field(header: dict[str, str], key: str) -> str:
    """Find "key=value" in the format line: "EVT3;height=720;width=1280"."""
    found = re.search(rf"(?:^|;){key}=([^;]*)", header.get("format", ""))
    return found[1] if found else ""


def _resolution(header: dict[str, str]) -> tuple[int, int] | None:
    if _field(header, "width") and _field(header, "height"):
        return parse_size(_field(header, "width"), _field(header, "height"))
    if "geometry" in header:
        width, _, height = header["geometry"].partition("x")
        return parse_size(width, height)
    generation = header.get("sensor_generation", "").replace(".", "")
    sensor = f"{header.get('plugin_name', '')} {header.get('sensor_name', '')} gen{generation}".lower()
    return next((size for name, size in _RESOLUTION_PX.items() if name in sensor), None)
