"""NumPy archives of events: this program's own, and others' with columns of the usual names."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from lce_rig.core.errors import SourceError
from lce_rig.core.event_file import decode_events
from lce_rig.sources.events.stream import EventColumns, Findings

_STRETCH_EVENTS = 1 << 20


class NpzEvents:
    """Events of an .npz file, which has to be read whole; see `EventStream`."""

    def __init__(self, path: Path) -> None:
        """Read the file.

        Raises:
            SourceError: it is damaged, or no archive of events.
        """
        self.notes: list[str] = []
        data = path.read_bytes()
        try:
            events = decode_events(data, sensor="")
        except ValueError as error:
            raise SourceError(f"{path}: {error}", "Expected columns t_us, x, y, polarity.") from None
        with np.load(path, allow_pickle=False) as archive:
            is_sized = "resolution_px" in archive.files
        self.resolution_px = (events.width_px, events.height_px) if is_sized else None
        self._events = EventColumns(events.t_ns, events.x, events.y, events.polarity, events.host_ns)

    def stretches(self, findings: Findings) -> Iterator[EventColumns]:
        """Yield the events a million at a time."""
        for begin in range(0, len(self._events), _STRETCH_EVENTS):
            yield self._events.select(slice(begin, begin + _STRETCH_EVENTS))
