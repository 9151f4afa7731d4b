"""E2VID's text: "width height", then a line "t x y polarity" for every event, t in s.

References:
    https://github.com/uzh-rpg/rpg_e2vid
"""

from collections.abc import Iterator, Sequence
from contextlib import suppress
from itertools import islice
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lce_rig.core.data import EventColumns
from lce_rig.core.errors import SourceError, reading
from lce_rig.core.losses import Losses
from lce_rig.io import findings
from lce_rig.io.events.event_recording import EventStream, parse_size, to_ns

_BLOCK_LINES = 1 << 16


class TextEvents(EventStream):
    """Events of a text file; see `EventStream`."""

    def __init__(self, path: Path) -> None:
        """Read the first line.

        Raises:
            SourceError: it is no such file.
        """
        self._path = path
        self.notes: list[str] = []
        with reading(path), path.open("rb") as file:
            line = file.readline()
        words = line.decode(errors="replace").split()
        self._has_size = len(words) == 2
        self.resolution_px = parse_size(*words) if self._has_size else None
        if self.resolution_px is None and words and words[0][0] != "#" and _parse(line) is None:
            raise SourceError(
                f"{path} is not a text file of events: the first line is neither a size nor an event",
                'Expected "width height", then lines "t x y polarity" with t in seconds.',
            )

    def stretches(self, losses: Losses) -> Iterator[EventColumns]:
        """Yield the events of some megabytes of text at a time."""
        n_lines = int(self._has_size)
        with reading(self._path), self._path.open("rb") as file:
            next(islice(file, n_lines, n_lines), None)
            while lines := list(islice(file, _BLOCK_LINES)):
                table = _parse_block(lines, n_lines, losses)
                n_lines += len(lines)
                # Doubles hold today's seconds to 0.24 us: rounding gives the microsecond that was written.
                t_ns, pixels = to_ns(np.rint(table[:, 0] * 1e6)), table[:, 1:3].astype(np.uint16)
                yield EventColumns(t_ns, pixels[:, 0], pixels[:, 1], table[:, 3] > 0)


def _parse_block(lines: Sequence[bytes], first_line: int, losses: Losses) -> NDArray[np.float64]:
    """Parse lines to (N, 4): t (s), x, y, polarity; line by line only if one of them is no event."""
    with suppress(ValueError):
        table = np.loadtxt(lines, ndmin=2, comments="#")
        if table.shape == (len(lines), 4) and _are_events(table).all():
            return table
    rows = []
    for number, line in enumerate(lines, first_line + 1):
        row = _parse(line)
        if row is not None:
            rows.append(row)
        elif line.strip() and not line.lstrip().startswith(b"#"):
            text = line[:60].decode(errors="replace").strip()
            losses.add(findings.BROKEN_LINES(where=f"line {number}: {text!r}"))
    return np.array(rows, dtype=np.float64).reshape(-1, 4)


def _parse(line: bytes) -> NDArray[np.float64] | None:
    """Parse one event to (4,); None if the line is none."""
    try:
        row = np.array(line.split(), dtype=np.float64)
    except ValueError:
        return None
    return row if row.shape == (4,) and _are_events(row[None])[0] else None


def _are_events(table: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Select the rows of a clock's times, whole pixels of any sensor and a polarity of 0, 1 or -1; (N,)."""
    t_s, x, y, polarity = table.T
    is_pixel = (x >= 0) & (x < 1 << 15) & (x % 1 == 0) & (y >= 0) & (y < 1 << 15) & (y % 1 == 0)
    return np.asarray(np.isfinite(t_s) & is_pixel & ((polarity == 0) | (np.abs(polarity) == 1)))
