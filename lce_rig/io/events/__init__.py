"""Recordings of event cameras: `open_events` finds the reader for a path."""

from pathlib import Path
from pkgutil import resolve_name

from lce_rig.core.errors import SourceError
from lce_rig.io.events.event_recording import EventRecording
from lce_rig.io.ros.bag_file import kind_of

READERS = {
    ".aedat4": "lce_rig.io.events.aedat4:Aedat4Events",
    ".bag": "lce_rig.io.ros.event_messages:BagEvents",
    ".db3": "lce_rig.io.ros.event_messages:BagEvents",
    ".mcap": "lce_rig.io.ros.event_messages:BagEvents",
    ".raw": "lce_rig.io.events.prophesee:PropheseeEvents",
    ".h5": "lce_rig.io.events.hdf5:Hdf5Events",
    ".hdf5": "lce_rig.io.events.hdf5:Hdf5Events",
    ".txt": "lce_rig.io.events.text:TextEvents",
}
"""Reader by suffix; a folder is a ROS 2 bag. Imported when wanted."""

__all__ = ["READERS", "EventRecording", "open_events"]


def open_events(
    path: Path | str,
    *,
    sensor: str = "events",
    resolution: tuple[int, int] | None = None,
    topic: str | None = None,
) -> EventRecording:
    """Open a recording of events.

    Args:
        path: an AEDAT4, Prophesee .raw, HDF5 (DSEC) or text file, or a ROS 1 or ROS 2 bag.
        sensor: name of the camera that its events are taken for.
        resolution: (width, height) px of that camera; None takes the file's, or the extent of its events.
        topic: of a bag; None takes the only one with events.

    Raises:
        SourceError: nothing is there, nothing that can be read, no events, or those of a camera of another
            resolution.
    """
    path = Path(path)
    if not path.exists():
        raise SourceError(f"{path} does not exist")
    kind = kind_of(path)
    if kind not in READERS:
        hint = f"Give a ROS 2 bag's folder or a file of one of these kinds: {', '.join(READERS)}."
        raise SourceError(f"{path} is not an event recording that lce-rig reads", hint)
    reader = resolve_name(READERS[kind])
    stream = reader(path, topic) if reader.__name__ == "BagEvents" else reader(path)
    return EventRecording(path, stream, sensor, resolution)
