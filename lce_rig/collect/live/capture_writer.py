"""What a live collection writes to disk: captures and, where wanted, the raw streams beside them."""

import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from lce_rig.collect.board_tracker import CaptureMoment, ImageKey
from lce_rig.collect.live.learning import Learning
from lce_rig.collect.offline.stored_events import StoredEvents
from lce_rig.collect.placement_dedupe import board_figures
from lce_rig.core.data import Image, Sample
from lce_rig.core.results import ImageBoard
from lce_rig.devices.disk_writer import DiskWriter, Sink
from lce_rig.devices.reading import LiveSource
from lce_rig.io.folder.folder_recorder import FolderRecorder
from lce_rig.rig import Rig
from lce_rig.session import Session
from lce_rig.timing.event_buffer import EventCut


@dataclass(frozen=True, eq=False)
class Task:
    """One capture to be written.

    Attributes:
        moment: what the sensors saw.
        images: its images that are stored.
        events: stretches of events that are stored.
        meta: how it came about.
        asked_s: time.monotonic() of the decision.
    """

    moment: CaptureMoment
    images: Sequence[Image]
    events: Sequence[EventCut]
    meta: Mapping[str, object]
    asked_s: float


@dataclass(frozen=True, eq=False)
class Kept:
    """One capture that is safe on the disk.

    Attributes:
        name: of the capture.
        boards: where each camera saw the board.
        latency_s: from the decision until it was safe.
    """

    name: str
    boards: Mapping[ImageKey, ImageBoard]
    latency_s: float


@dataclass(frozen=True)
class TakenBack:
    """One capture that was taken back, by its name: it has moved to the rejected ones."""

    name: str


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
        self._done: deque[Kept | TakenBack] = deque()
        self._sink: Sink[Task | TakenBack] = disk.add(session.path, self._write, is_vital=True)

    @property
    def is_busy(self) -> bool:
        """Whether a capture is not on the disk, or not taken back, yet."""
        return self._sink.is_busy

    def keep(self, task: Task) -> None:
        """Have a capture written; returns at once."""
        self._sink.put(task)

    def take_back(self, name: str) -> None:
        """Have a capture, which may still wait to be written, put aside; returns at once."""
        self._sink.put(TakenBack(name))

    def take(self) -> list[Kept | TakenBack]:
        """Give the captures that have become safe, or were taken back, since the last call.

        Raises:
            SessionError: one cannot be written: the disk is full, or gone.
        """
        failure = self._sink.failure
        done = [self._done.popleft() for _ in range(len(self._done))]
        if failure is not None and not done:
            raise failure
        return done

    def notes(self) -> list[str]:
        """Say what was odd about the events that were stored."""
        return self._stored.notes()

    def _write(self, item: Task | TakenBack) -> None:
        """Do what is asked, in its order: a capture is stored before it can be taken back."""
        if isinstance(item, TakenBack):
            self._session.reject(item.name, "taken back while collecting")
            self._learning.forget(item.name)
            self._done.append(item)
        else:
            self._store(item)

    def _store(self, task: Task) -> None:
        detection = task.moment.detection
        meta = {**task.meta, **task.moment.figures, **board_figures(detection.images)}
        events = [cut.events for cut in task.events]
        name = self._session.add_capture(task.images, detection.frame.scans, meta, events)
        self._done.append(Kept(name, detection.images, time.monotonic() - task.asked_s))
        # The capture is safe: what follows delays nothing.
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
        What takes each sample, never blocking; and the sink of samples.

    Raises:
        SourceError: the folder exists already, or cannot be made.
    """
    recorder = FolderRecorder(folder, rig)
    by_packets = {source.sensor for source in sources if source.record_packets(folder, disk)}
    sink: Sink[Sample] = disk.add(folder, recorder.write, recorder.close)

    def record(sample: Sample) -> None:
        if sample.sensor not in by_packets:
            arrays = [each for each in vars(sample).values() if isinstance(each, np.ndarray)]
            sink.put(sample, sum(each.nbytes for each in arrays))

    return record, sink
