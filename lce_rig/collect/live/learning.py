"""Calibrations of the captures in a process of its own, from which guidance learns."""

import threading
from collections import deque
from collections.abc import Sequence
from types import TracebackType

import numpy as np

from lce_rig.calibrate import EstimateSettings, fit_extrinsic
from lce_rig.collect.board_tracker import BoardDetection
from lce_rig.collect.guidance import Planner
from lce_rig.collect.live.guide import Guide, make_guides
from lce_rig.collect.worker import Worker
from lce_rig.core.errors import NotEnoughDataError
from lce_rig.core.results import Observation
from lce_rig.rig import Rig

_NICE = 10


class Learning:
    """Calibrates the captures of each guide's sensors; open while its `with` block lasts."""

    def __init__(self, rig: Rig, guides: Sequence[Guide]) -> None:
        """Prepare; no process is started before there are captures enough."""
        self._guides = guides
        self._min_captures = rig.quality.min_captures
        self._worker = Worker("calibrate captures", _Teacher, rig, nice=_NICE)
        self._candidates: dict[int, list[Observation]] = {k: [] for k in range(len(guides))}
        self._due: deque[int] = deque()
        self._taught: deque[tuple[Guide, Planner | None]] = deque()
        self._unlearned: set[int] = set()
        self._problem = ""
        self._changed = threading.Condition()
        self._is_closing = False
        self._thread = threading.Thread(target=self._run, name="learn from captures", daemon=True)

    def __enter__(self) -> "Learning":
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """End, without waiting for a calibration."""
        with self._changed:
            self._is_closing = True
            self._changed.notify()
        self._worker.__exit__(None, None, None)
        self._thread.join()

    def show(self, name: str, detection: BoardDetection) -> None:
        """Take a capture's detection; returns at once."""
        with self._changed:
            for k, guide in enumerate(self._guides):
                if guide.sees(detection):
                    image, scans = detection.images[guide.key], detection.lidars[guide.lidar]
                    self._candidates[k].append(Observation.of(name, image, scans))
                    if len(self._candidates[k]) >= self._min_captures and k not in self._due:
                        self._due.append(k)
            self._changed.notify()

    def forget(self, name: str) -> None:
        """Forget a capture; returns at once, and the remaining ones are calibrated again."""
        with self._changed:
            for k, candidates in self._candidates.items():
                left = [candidate for candidate in candidates if candidate.capture != name]
                if len(left) < len(candidates):
                    self._candidates[k] = left
                    self._unlearned.add(k)
                    if k not in self._due:
                        self._due.append(k)
            self._changed.notify()

    def teach(self) -> None:
        """Pass the planners learned since the last call to their guides."""
        with self._changed:
            taught = list(self._taught)
            self._taught.clear()
        for guide, planner in taught:
            guide.adopt(planner)

    def notes(self) -> list[str]:
        """Say what went wrong."""
        return [self._problem] if self._problem else []

    def _run(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._due or self._is_closing)
                if self._is_closing:
                    return
                k = self._due.popleft()
                candidates = list(self._candidates[k])
            planner: Planner | None = None
            try:
                if len(candidates) >= self._min_captures:
                    planner = self._worker.call("learn", k, candidates)
            except Exception as error:  # Captures are safe even if a calibration fails.
                if self._is_closing:
                    return
                self._problem = f"guidance does not learn from captures: {error}"
            with self._changed:
                if any(all(each is not left for left in self._candidates[k]) for each in candidates):
                    continue  # One was taken back meanwhile: it is due again.
                # A planner learned from a capture that was taken back holds no longer.
                if planner is not None or k in self._unlearned:
                    self._taught.append((self._guides[k], planner))
                    self._unlearned.discard(k)


class _Teacher:
    """The object in the worker's process."""

    def __init__(self, rig: Rig) -> None:
        self._board = rig.board.to_board()
        self._guides = make_guides(rig)

    def learn(self, k: int, candidates: Sequence[Observation]) -> Planner | None:
        """Calibrate one guide's sensors; None where more captures are needed."""
        try:
            estimate = fit_extrinsic(list(candidates), self._board, EstimateSettings("paper", n_draws=0))
        except (NotEnoughDataError, np.linalg.LinAlgError):
            return None
        figures = estimate.diagnostics
        return self._guides[k].prepare(
            estimate.T_cam_lidar, figures.fit_plane_rms_m, figures.fit_edge_rms_m, len(estimate.used)
        )
