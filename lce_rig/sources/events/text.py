"""E2VID's text: "width height", then a line "t x y polarity" for every event, t in s; plain or in a zip.

References:
    https://github.com/uzh-rpg/rpg_e2vid
"""

import zipfile
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO

import numpy as np
from numpy.typing import NDArray

from lce_rig.core.errors import SourceError
from lce_rig.sources.events.stream import NS_PER_US, EventColumns, Findings

_BLOCK_BYTES = 1 << 18
_N_COLUMNS = 4
# RuntimeError: encryption or a compression that cannot be; a flipped bit says so.
_ZIP_DAMAGE = (zipfile.BadZipFile, zlib.error, OSError, EOFError, RuntimeError)


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
                first = file.readline(4096).split()
            except _ZIP_DAMAGE as error:
                raise SourceError(f"{path} is damaged: {error}") from None
        self._has_size = len(first) == 2 and all(word.isdigit() for word in first)
        is_comment = bool(first) and first[0].startswith(b"#")
        if not self._has_size and not is_comment and _parse_line(b" ".join(first)) is None:
            raise SourceError(
                f"{path} is no text of events: its first line is neither a size nor an event",
                'Expected "width height", then lines "t x y polarity" with t in seconds.',
            )
        self.resolution_px = (int(first[0]), int(first[1])) if self._has_size else None

    def stretches(self, findings: Findings) -> Iterator[EventColumns]:
        """Yield the events of some megabytes of text at a time."""
        with _open(self._path) as file:
            if self._has_size:
                file.readline(4096)
            n_lines = 1 + self._has_size
            while True:
                try:
                    block = file.read(_BLOCK_BYTES) + file.readline()
                except _ZIP_DAMAGE as error:
                    findings.add("torn ends of the file left out", f"line {n_lines}: {error}")
                    return
                if not block:
                    return
                yield _to_columns(_parse_block(block, n_lines, findings))
                n_lines += block.count(b"\n")


@contextmanager
def _open(path: Path) -> Iterator[IO[bytes]]:
    """Open the text, in a zip or not."""
    if not zipfile.is_zipfile(path):
        with path.open("rb") as file:
            yield file
        return
    try:
        archive = zipfile.ZipFile(path)
        names = [name for name in archive.namelist() if name.lower().endswith((".txt", ".csv"))]
        if len(names) != 1:
            raise SourceError(f"{path} holds {len(names)} texts, not one of events")
        member = archive.open(names[0])
    except _ZIP_DAMAGE as error:
        raise SourceError(f"{path} is damaged: {error}") from None
    with archive, member:
        yield member


def _parse_block(block: bytes, first_line: int, findings: Findings) -> NDArray[np.float64]:
    """Parse whole lines; (N, 4). The fast way serves where every line is sound, as nearly always."""
    lines = block.splitlines()
    values = _parse_numbers(block)
    if values is not None and values.size == len(lines) * _N_COLUMNS:
        table = values.reshape(-1, _N_COLUMNS)
        if _is_sound(table):
            return table
    rows = []
    for number, line in enumerate(lines, first_line):
        row = _parse_line(line)
        if row is not None:
            rows.append(row)
        elif line.strip() and not line.lstrip().startswith(b"#"):
            findings.add("broken lines left out", f"line {number}: {line[:60].decode(errors='replace')!r}")
    return np.array(rows, dtype=np.float64).reshape(-1, _N_COLUMNS)


def _parse_numbers(block: bytes) -> NDArray[np.float64] | None:
    try:
        return np.array(block.split(), dtype=np.bytes_).astype(np.float64)
    except ValueError:
        return None


def _parse_line(line: bytes) -> tuple[float, ...] | None:
    """Parse one event; None where the line is none."""
    try:
        row = tuple(float(word) for word in line.split())
    except ValueError:
        return None
    return row if len(row) == _N_COLUMNS and _is_sound(np.array([row])) else None


def _is_sound(table: NDArray[np.float64]) -> bool:
    """Tell whether rows are events: finite times, whole pixels of any sensor, a polarity of 0, 1 or -1."""
    t_s, x, y, polarity = table.T
    if not np.isfinite(t_s).all():
        return False
    pixels = np.concatenate((x, y))
    is_pixel = (pixels >= 0) & (pixels < 1 << 15) & (pixels == np.floor(pixels))
    return bool(is_pixel.all() and np.isin(polarity, (-1, 0, 1)).all())


def _to_columns(table: NDArray[np.float64]) -> EventColumns:
    # Doubles hold today's seconds to 0.24 us: rounding gives the microsecond that was written.
    t_us = np.rint(table[:, 0] * 1e6).astype(np.int64)
    x, y = table[:, 1].astype(np.uint16), table[:, 2].astype(np.uint16)
    return EventColumns(t_us * NS_PER_US, x, y, table[:, 3] > 0)
