"""E2VID's text: "width height", then a line "t x y polarity" for every event, t in s.

References:
    https://github.com/uzh-rpg/rpg_e2vid
"""

from collections.abc import Iterator
from itertools import islice
from pathlib import Path

import numpy as np

from lce_rig.core.data import EventColumns
from lce_rig.core.errors import SourceError, reading
from lce_rig.core.losses import Losses
from lce_rig.io import findings
from lce_rig.io.events.event_recording import EventStream, parse_size, to_ns

_BLOCK_LINES = 1 << 16
_NO_LINES = np.empty((0, 4))


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
        is_event = len(words) == 4 or line.startswith(b"#")
        if words and self.resolution_px is None and not is_event:
            raise SourceError(
                f"{path} is not a text file of events: the first line is neither a size nor an event",
                'Expected "width height", then lines "t x y polarity" with t in seconds.',
            )

    def stretches(self, losses: Losses) -> Iterator[EventColumns]:
        """Yield the events of some megabytes of text at a time; a torn last line is skipped.

        Raises:
            SourceError: a line is no event.
        """
        n_lines = int(self._has_size)
        with reading(self._path), self._path.open("rb") as file:
            next(islice(file, n_lines, n_lines), None)
            while lines := list(islice(file, _BLOCK_LINES)):
                if not lines[-1].endswith(b"\n"):
                    losses.add(findings.TORN_END(where=f"line {n_lines + len(lines)}"))
                    lines.pop()
                n_lines += len(lines)
                table = np.loadtxt(lines, ndmin=2, comments="#") if any(map(_has_event, lines)) else _NO_LINES
                if table.shape[1] != 4:
                    raise ValueError(f"lines up to {n_lines} have {table.shape[1]} numbers, not 4")
                t_s, x, y, polarity = table.T
                is_pixel = (x >= 0) & (x < 1 << 15) & (x % 1 == 0) & (y >= 0) & (y < 1 << 15) & (y % 1 == 0)
                is_event = np.isfinite(t_s) & is_pixel & (np.abs(polarity) <= 1) & (polarity % 1 == 0)
                losses.add(findings.BROKEN_LINES(where=f"up to line {n_lines}"), int((~is_event).sum()))
                # Doubles hold today's seconds to 0.24 us: rounding gives the microsecond that was written.
                t_ns, pixels = to_ns(np.rint(t_s[is_event] * 1e6)), table[is_event, 1:3].astype(np.uint16)
                yield EventColumns(t_ns, pixels[:, 0], pixels[:, 1], polarity[is_event] > 0)


def _has_event(line: bytes) -> bool:
    return bool(line.partition(b"#")[0].strip())
