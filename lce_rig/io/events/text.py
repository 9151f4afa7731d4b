"""E2VID's text: "width height", then a line "t x y polarity" for every event, t in s; plain or in a zip.

References:
    https://github.com/uzh-rpg/rpg_e2vid
"""

import zipfile
import zlib
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO

import numpy as np
from numpy.typing import NDArray

from lce_rig.core import limits, unpacking
from lce_rig.core.data import EventColumns
from lce_rig.core.errors import SourceError
from lce_rig.core.losses import Losses
from lce_rig.io.events.stream import damage, open_recorded, parse_size, to_ns

_BLOCK_BYTES = 1 << 18
_N_COLUMNS = 4
# RuntimeError: encryption or a compression that cannot be; a flipped bit says so.
_ZIP_DAMAGE = (zipfile.BadZipFile, zlib.error, OSError, EOFError, RuntimeError, ValueError)
# NumPy makes every word as long as the longest.
_MAX_USUAL_BYTES = 256
_MAX_TIME_S = limits.MAX_TIME_NS * 1e-9


class TextEvents:
    """Events of a text file, or of the only one in a zip; see `EventStream`."""

    def __init__(self, path: Path) -> None:
        """Read the first line.

        Raises:
            SourceError: it is no such file.
        """
        self._path = path
        self.notes: list[str] = []
        with _open(path) as file:
            try:
                line = file.readline(limits.MAX_LINE_BYTES)
            except _ZIP_DAMAGE as error:
                raise SourceError(f"{path} is damaged: {error}") from None
        first = line.split()
        self._has_size = len(first) == 2 and all(word.isdigit() for word in first)
        is_comment = bool(first) and first[0].startswith(b"#")
        if not self._has_size and not is_comment and not len(_parse_lines([line])[0]):
            raise SourceError(
                f"{path} is not a text file of events: the first line is neither a size nor an event",
                'Expected "width height", then lines "t x y polarity" with t in seconds.',
            )
        self.resolution_px = parse_size(first[0].decode(), first[1].decode()) if self._has_size else None

    def stretches(self, losses: Losses) -> Iterator[EventColumns]:
        """Yield the events of some megabytes of text at a time."""
        with _open(self._path) as file:
            if self._has_size:
                file.readline(limits.MAX_LINE_BYTES)
            n_lines = 1 + self._has_size
            is_whole = True
            while is_whole:
                try:
                    block, is_whole = _read_lines(file)
                except _ZIP_DAMAGE as error:
                    losses.add(damage("recording.torn_end", f"line {n_lines}: {error}"))
                    return
                if not block and is_whole:
                    return
                yield _to_columns(_parse_block(block, n_lines, losses))
                n_lines += block.count(b"\n")
            said = f"line {n_lines}: it is longer than {limits.MAX_LINE_BYTES} bytes"
            losses.add(damage("recording.torn_end", said))


def _read_lines(file: IO[bytes]) -> tuple[bytes, bool]:
    """Read whole lines, some hundred kilobytes, and tell whether no line follows that is longer than any."""
    block = file.read(_BLOCK_BYTES)
    rest = file.readline(limits.MAX_LINE_BYTES)
    if len(rest) == limits.MAX_LINE_BYTES and not rest.endswith(b"\n"):
        return block[: block.rfind(b"\n") + 1], False
    return block + rest, True


@contextmanager
def _open(path: Path) -> Iterator[IO[bytes]]:
    """Open the text, in a zip or not."""
    with open_recorded(path) as file:
        if not zipfile.is_zipfile(file):
            file.seek(0)
            yield file
            return
        try:
            archive = unpacking.open_archive(file)
            texts = [m for m in archive.infolist() if m.filename.lower().endswith((".txt", ".csv"))]
            if len(texts) != 1:
                raise SourceError(f"{path} holds {len(texts)} text files, expected 1")
            n_stored = min(texts[0].compress_size, path.stat().st_size)
            member = unpacking.open_member(archive, texts[0], unpacking.unpacked_limit(n_stored))
        except _ZIP_DAMAGE as error:
            raise SourceError(f"{path} is damaged: {error}") from None
        with archive, member:
            yield member


def _parse_block(block: bytes, first_line: int, losses: Losses) -> NDArray[np.float64]:
    """Parse whole lines; (N, 4). The fast way serves where every line is sound, as nearly always."""
    lines = block.splitlines()
    table = _parse_quickly(block, lines)
    if table is not None:
        return table
    table, is_event = _parse_lines(lines)
    for i in np.flatnonzero(~is_event):
        line = lines[i]
        if line.strip() and not line.lstrip().startswith(b"#"):
            where = f"line {first_line + i}: {line[:60].decode(errors='replace')!r}"
            losses.add(damage("recording.broken_lines", where))
    return table


def _parse_quickly(block: bytes, lines: Sequence[bytes]) -> NDArray[np.float64] | None:
    """Parse lines that are events, all of them; None where one is none."""
    if max(map(len, lines), default=0) > _MAX_USUAL_BYTES:
        return None
    try:
        values = np.array(block.split(), dtype=np.bytes_).astype(np.float64)
    except ValueError:
        return None
    if values.size != len(lines) * _N_COLUMNS:
        return None
    table = values.reshape(-1, _N_COLUMNS)
    return table if _is_sound(table).all() else None


def _parse_lines(lines: Sequence[bytes]) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Parse the lines that are events; (N, 4), and which of all they are."""
    is_event = np.zeros(len(lines), np.bool_)
    rows = []
    for i, line in enumerate(lines):
        words = line.split() if len(line) <= _MAX_USUAL_BYTES else ()
        if len(words) == _N_COLUMNS:
            with suppress(ValueError):
                rows.append([float(word) for word in words])
                is_event[i] = True
    table = np.array(rows, dtype=np.float64).reshape(-1, _N_COLUMNS)
    is_sound = _is_sound(table)
    is_event[is_event] = is_sound
    return table[is_sound], is_event


def _is_sound(table: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Find which rows are events: times of a clock, whole pixels of any sensor, a polarity of 0, 1 or -1."""
    t_s, x, y, polarity = table.T
    is_pixel = (x >= 0) & (x < 1 << 15) & (x == np.floor(x)) & (y >= 0) & (y < 1 << 15) & (y == np.floor(y))
    is_polarity = (polarity == 0) | (np.abs(polarity) == 1)
    return np.asarray((np.abs(t_s) < _MAX_TIME_S) & is_pixel & is_polarity)


def _to_columns(table: NDArray[np.float64]) -> EventColumns:
    # Doubles hold today's seconds to 0.24 us: rounding gives the microsecond that was written.
    t_us = np.rint(table[:, 0] * 1e6).astype(np.int64)
    x, y = table[:, 1].astype(np.uint16), table[:, 2].astype(np.uint16)
    return EventColumns(to_ns(t_us), x, y, table[:, 3] > 0)
