"""Writes captures of a live collection and, on request, the raw streams beside them."""

import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from lce_rig.collect.board_tracker import CaptureMoment
from lce_rig.collect.live.learning import Learning
from lce_rig.collect.offline.stored_events import StoredEvents
from lce_rig.collect.placement_dedupe import board_figures
from lce_rig.core.data import Sample
from lce_rig.devices.disk_writer import DiskWriter, Sink
from lce_rig.devices.reading import LiveSource
from lce_rig.io.ros.bag_recorder import FolderRecorder
from lce_rig.rig import Rig
from lce_rig.session import Session
from lce_rig.timing.event_buffer import EventCut


class Task(NamedTuple):
    """One capture to be written.

    Attributes:
        moment: the board in its frame, whose images are stored.
        events: stretches of events that are stored.
        meta: the origin of the capture.
        asked_s: time.monotonic() of the decision.
    """

    moment: CaptureMoment
    events: Sequence[EventCut]
    meta: Mapping[str, object]
    asked_s: float


class CaptureWriter:
    """Writes captures one after the other, and takes them back in the same order."""

    def __init__(self, session: Session, learning: Learning, disk: DiskWriter) -> None:
        """Prepare.

        Args:
            session: open for writing.
            learning: receives each capture that is safe.
            disk: writes.
        """
        self._session = session
        self._learning = learning
        self._stored = StoredEvents()
        self._done: deque[tuple[str, float | None]] = deque()
        self._sink: Sink[Task | str] = disk.add(session.path, self._write, is_vital=True)

    @property
    def is_busy(self) -> bool:
        """Whether a capture is not on the disk, or not taken back, yet."""
        return self._sink.is_busy

    def keep(self, task: Task) -> None:
        """Have a capture written; returns at once."""
        self._sink.put(task)

    def take_back(self, name: str) -> None:
        """Reject a capture, which may still wait to be written; returns at once."""
        self._sink.put(name)

    def take(self) -> list[tuple[str, float | None]]:
        """Return the captures saved or taken back since the last call, by name.

        Each comes with the time in s from the decision until it was safe; None where it was taken back.

        Raises:
            SessionError: one cannot be written: the disk is full, or gone.
        """
        failure = self._sink.failure
        done = [self._done.popleft() for _ in range(len(self._done))]
        if failure is not None and not done:
            raise failure
        return done

    def notes(self) -> list[str]:
        """Describe problems of the stored events."""
        return self._stored.notes()

    def _write(self, task: Task | str) -> None:
        """Store or reject, in the order of the requests: a capture is stored before it is taken back."""
        if isinstance(task, str):
            self._session.reject(task, "taken back while collecting")
            self._learning.forget(task)
            self._done.append((task, None))
            return
        detection, frame = task.moment.detection, task.moment.detection.frame
        meta = {**task.meta, **task.moment.figures, **board_figures(detection.images)}
        events = [cut.events for cut in task.events]
        name = self._session.add_capture(frame.images, frame.scans, meta, events)
        self._done.append((name, time.monotonic() - task.asked_s))
        # The capture is safe: the rest delays nothing.
        self._stored.note(task.events)
        self._learning.show(name, detection)


def record_streams(
    folder: Path, rig: Rig, sources: Sequence[LiveSource], disk: DiskWriter
) -> tuple[Callable[[Sample], None], Sink[Sample]]:
    """Record raw streams in a new folder: packets of sources that have them, samples of all others.

    Args:
        folder: does not exist yet.
        rig: the profile.
        sources: not open yet.
        disk: writes.

    Returns:
        A function that takes each sample without blocking; and the sink of samples.

    Raises:
        SourceError: the folder exists already, or cannot be made.
    """
    recorder = FolderRecorder(folder, rig)
    by_packets = {source.sensor for source in sources if source.record_packets(folder, disk)}
    sink: Sink[Sample] = disk.add(folder, recorder.write, recorder.close)

    def record(sample: Sample) -> None:
        if sample.sensor not in by_packets:
            arrays = [value for value in vars(sample).values() if isinstance(value, np.ndarray)]
            sink.put(sample, sum(array.nbytes for array in arrays))

    return record, sink
