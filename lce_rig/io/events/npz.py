"""Events in the format of a capture's file: one NumPy archive."""

from collections.abc import Iterator
from pathlib import Path

from lce_rig.core.data import EventColumns
from lce_rig.core.errors import reading
from lce_rig.core.event_file import decode_events
from lce_rig.core.losses import Losses


class NpzEvents:
    """Events of an .npz file; see `EventStream`."""

    def __init__(self, path: Path) -> None:
        """Read the file.

        Raises:
            SourceError: it is damaged, or no archive of events.
        """
        self.notes: list[str] = []
        with reading(path):
            events = decode_events(path.read_bytes(), "")
        self.resolution_px = events.width_px, events.height_px
        self._columns = EventColumns(events.t_ns, events.x, events.y, events.polarity, events.host_ns)

    def stretches(self, losses: Losses) -> Iterator[EventColumns]:
        """Yield all events."""
        yield self._columns
