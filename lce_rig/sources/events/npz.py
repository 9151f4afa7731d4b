"""NumPy archives of events: this program's own, and others' with columns of the usual names."""

from collections.abc import Iterator
from pathlib import Path

from lce_rig.core.errors import SourceError
from lce_rig.core.event_file import read_events
from lce_rig.sources.events.stream import EventColumns, Findings, open_recorded

_STRETCH_EVENTS = 1 << 20
_UNKNOWN_PX = (0, 0)


class NpzEvents:
    """Events of an .npz file, which has to be read whole; see `EventStream`."""

    def __init__(self, path: Path) -> None:
        """Read the file.

        Raises:
            SourceError: it is damaged, or no archive of events.
        """
        self.notes: list[str] = []
        with open_recorded(path) as file:
            try:
                events = read_events(file, sensor="", resolution_px=_UNKNOWN_PX)
            except ValueError as error:
                raise SourceError(f"{path}: {error}", "Expected columns t_us, x, y, polarity.") from None
        size_px = events.width_px, events.height_px
        self.resolution_px = None if size_px == _UNKNOWN_PX else size_px
        self._events = EventColumns(events.t_ns, events.x, events.y, events.polarity, events.host_ns)

    def stretches(self, findings: Findings) -> Iterator[EventColumns]:
        """Yield the events a million at a time."""
        for begin in range(0, len(self._events), _STRETCH_EVENTS):
            yield self._events.select(slice(begin, begin + _STRETCH_EVENTS))
