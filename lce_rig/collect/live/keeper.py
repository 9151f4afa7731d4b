"""Captures to the disk, and first calibrations of them, in a thread: guidance waits for no slow disk."""

import threading
import time
from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import TracebackType

import numpy as np

from lce_rig.calibrate import CalibrateOptions, CaptureCandidates, fit_extrinsic
from lce_rig.collect.event_buffer import EventCut
from lce_rig.collect.guidance import Planner
from lce_rig.collect.live.guide import Guide, Learned
from lce_rig.collect.novelty import board_figures
from lce_rig.collect.stored_events import StoredEvents
from lce_rig.collect.watching import ImageKey, Moment, Sighting
from lce_rig.core.data import Image
from lce_rig.core.errors import LceRigError, NotEnoughDataError, SessionError
from lce_rig.core.results import ImageBoard
from lce_rig.session import Session


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

    moment: Moment
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


class Keeper:
    """Writes captures one after the other, and calibrates what it has; open while its `with` block lasts.

    What is being written when the block ends is finished first.
    """

    def __init__(self, session: Session, guides: Sequence[Guide], min_captures: int) -> None:
        """Prepare.

        Args:
            session: open for writing.
            guides: to be taught by a calibration of their sensors after each capture.
            min_captures: fewer are not calibrated.
        """
        self._session = session
        self._guides = guides
        self._min_captures = min_captures
        self._stored = StoredEvents()
        self._candidates: dict[int, list[CaptureCandidates]] = {k: [] for k in range(len(guides))}
        self._tasks: deque[Task] = deque()
        self._kept: deque[Kept] = deque()
        self._taught: deque[tuple[Guide, Planner]] = deque()
        self._failure: LceRigError | None = None
        self._changed = threading.Condition()
        self._is_closing = False
        self._thread = threading.Thread(target=self._run, name="keep captures", daemon=True)

    def __enter__(self) -> "Keeper":
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
            kept, taught = list(self._kept), list(self._taught)
            self._kept.clear()
            self._taught.clear()
            failure = self._failure
        for guide, planner in taught:
            guide.adopt(planner)
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
                is_free = not self._tasks and not self._is_closing
            if failure is None and is_free:
                try:
                    self._teach()
                except Exception as error:  # Captures must be written, whatever a calibration trips over.
                    self._session.journal("calibration failed", error=repr(error))

    def _store(self, task: Task) -> LceRigError | None:
        sighting = task.moment.sighting
        meta = {**task.meta, **task.moment.figures, **board_figures(sighting.images)}
        try:
            events = self._stored.join(task.events)
            name = self._session.add_capture(task.images, sighting.frame.scans, meta, events)
        except LceRigError as error:
            return error
        except Exception as error:  # Nothing that goes wrong with the disk may end the thread in silence.
            return SessionError(f"{self._session.path} cannot be written: {error!r}", "Please report it.")
        with self._changed:
            self._kept.append(Kept(name, sighting.images, time.monotonic() - task.asked_s))
        self._gather(name, sighting)
        return None

    def _gather(self, name: str, sighting: Sighting) -> None:
        for k, guide in enumerate(self._guides):
            if guide.sees(sighting):
                image, scans = sighting.images[guide.key], sighting.lidars[guide.lidar]
                self._candidates[k].append(CaptureCandidates(name, image, scans))

    def _teach(self) -> None:
        """Calibrate what each guide's sensors have shown in this run, and let it know."""
        for k, guide in enumerate(self._guides):
            if len(self._candidates[k]) < self._min_captures:
                continue
            try:
                board = self._session.rig.board.to_board()
                estimate = fit_extrinsic(self._candidates[k], board, CalibrateOptions(n_draws=0))
            except (NotEnoughDataError, np.linalg.LinAlgError):
                continue  # More captures will tell.
            figures = estimate.diagnostics
            learned = Learned(
                estimate.T_cam_lidar,
                figures["fit_plane_rms_m"],
                figures["fit_edge_rms_m"],
                len(estimate.used),
            )
            planner = guide.prepare(learned)
            if planner is not None:
                with self._changed:
                    self._taught.append((guide, planner))
