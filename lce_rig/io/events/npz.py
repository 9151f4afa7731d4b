"""NumPy archives of events: this program's own, and others' with columns of the usual names."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from lce_rig.core.data import EventColumns
from lce_rig.core.errors import SourceError
from lce_rig.core.event_file import EventArchive
from lce_rig.core.losses import Losses
from lce_rig.io.events.stream import open_recorded

_STRETCH_EVENTS = 1 << 20


class NpzEvents:
    """Events of an .npz file; see `EventStream`."""

    def __init__(self, path: Path) -> None:
        """Find the columns.

        Raises:
            SourceError: it is damaged, or no archive of events.
        """
        self._path = path
        self.notes: list[str] = []
        with _archive(path) as archive:
            self.resolution_px = archive.resolution_px

    def stretches(self, losses: Losses) -> Iterator[EventColumns]:
        """Yield the events a million at a time.

        Raises:
            SourceError: it is damaged, after what lies before.
        """
        with _archive(self._path) as archive:
            host_ns = archive.host_ns
            for columns in archive.stretches(_STRETCH_EVENTS):
                yield EventColumns(*columns, host_ns)
                host_ns = None


@contextmanager
def _archive(path: Path) -> Iterator[EventArchive]:
    with open_recorded(path) as file:
        try:
            yield EventArchive(file)
        except ValueError as error:
            raise SourceError(f"{path}: {error}", "Expected columns t_us, x, y, polarity.") from None
