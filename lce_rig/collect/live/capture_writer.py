"""Captures to the disk, in a thread: guidance waits for no slow disk."""

import threading
import time
from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import TracebackType

from lce_rig.collect.board_tracker import CaptureMoment, ImageKey
from lce_rig.collect.live.learning import Learning
from lce_rig.collect.offline.stored_events import StoredEvents
from lce_rig.collect.placement_dedupe import board_figures
from lce_rig.core.data import Image
from lce_rig.core.errors import LceRigError, SessionError
from lce_rig.core.results import ImageBoard
from lce_rig.session import Session
from lce_rig.timing.event_buffer import EventCut


@dataclass(frozen=True, eq=False)
class Task:
    """One capture to be kept.

    Attributes:
        moment: what the sensors saw.
        images: its pictures that are stored.
        events: stretches of events that are stored.
        meta: how it came about.
        asked_s: time.monotonic() when it was decided on.
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


class CaptureWriter:
    """Writes captures one after the other; open while its `with` block lasts.

    What is being written when the block ends is finished first.
    """

    def __init__(self, session: Session, learning: Learning) -> None:
        """Prepare.

        Args:
            session: open for writing.
            learning: is shown what is safe.
        """
        self._session = session
        self._learning = learning
        self._stored = StoredEvents()
        self._tasks: deque[Task] = deque()
        self._kept: deque[Kept] = deque()
        self._failure: LceRigError | None = None
        self._changed = threading.Condition()
        self._is_closing = False
        self._thread = threading.Thread(target=self._run, name="keep captures", daemon=True)

    def __enter__(self) -> "CaptureWriter":
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Finish what is asked for.

        Raises:
            SessionError: a capture could not be written; nothing is raised over another error.
        """
        with self._changed:
            self._is_closing = True
            self._changed.notify()
        self._thread.join()
        if error is None and self._failure is not None:
            raise self._failure

    @property
    def is_busy(self) -> bool:
        """Whether a capture is not on the disk yet."""
        with self._changed:
            return bool(self._tasks)

    def keep(self, task: Task) -> None:
        """Ask for a capture to be written; returns at once."""
        with self._changed:
            self._tasks.append(task)
            self._changed.notify()

    def take(self) -> list[Kept]:
        """Give the captures that have become safe since the last call.

        Raises:
            SessionError: one cannot be written: the disk is full, or gone.
        """
        with self._changed:
            kept = list(self._kept)
            self._kept.clear()
            failure = self._failure
        if failure is not None and not kept:
            raise failure
        return kept

    def notes(self) -> list[str]:
        """Say what was odd about the events that were stored."""
        return self._stored.notes()

    def _run(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._tasks or self._is_closing)
                if not self._tasks or self._failure is not None:
                    return
                task = self._tasks[0]
            failure = self._store(task)
            with self._changed:
                self._tasks.popleft()
                self._failure = failure

    def _store(self, task: Task) -> LceRigError | None:
        sighting = task.moment.sighting
        meta = {**task.meta, **task.moment.figures, **board_figures(sighting.images)}
        try:
            events = [cut.events for cut in task.events]
            name = self._session.add_capture(task.images, sighting.frame.scans, meta, events)
        except LceRigError as error:
            return error
        except Exception as error:  # Nothing that goes wrong with the disk may end the thread in silence.
            return SessionError(f"{self._session.path} cannot be written: {error!r}", "Please report it.")
        with self._changed:
            self._kept.append(Kept(name, sighting.images, time.monotonic() - task.asked_s))
        # Nobody waits for this any more.
        self._stored.note(task.events)
        self._learning.show(name, sighting)
        return None
