"""Write live captures, raw streams on request, and update the guidance from the captures."""

import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path

import numpy as np

from lce_rig.calibrate import CalibrateOptions, EstimateSettings, fit_extrinsic
from lce_rig.calibrate.options import Tolerances
from lce_rig.collect.board_tracker import BoardDetection, CaptureMoment
from lce_rig.collect.guidance.planner import Planner
from lce_rig.collect.live.guide import Guide, make_guides
from lce_rig.collect.placement_dedupe import pose_figures
from lce_rig.collect.worker import Worker
from lce_rig.core.data import Sample
from lce_rig.core.errors import NotEnoughDataError
from lce_rig.core.results import Observation
from lce_rig.devices.disk_writer import DiskWriter
from lce_rig.io.ros.bag_recorder import BagRecorder
from lce_rig.rig import Rig
from lce_rig.session import Session
from lce_rig.timing.scan_pairing import EventCut

_NICE = 10


class Learning:
    """Calibrates each guide's captures in the background; open while its `with` block lasts."""

    def __init__(self, rig: Rig, guides: Sequence[Guide]) -> None:
        """Prepare; the process starts once there are enough captures."""
        self._guides = guides
        self._min_captures = rig.quality.min_captures
        self._worker = Worker("calibrate captures", _Teacher, rig, nice=_NICE)
        self._caller = ThreadPoolExecutor(1, "learn from captures")
        self._shown: dict[str, BoardDetection] = {}
        self._due: deque[int] = deque()
        self._running: tuple[int, Future[Planner | None]] | None = None
        self._problem = ""
        self._is_open = True

    def __enter__(self) -> "Learning":
        return self

    def __exit__(self, *_: object) -> None:
        """Stop without waiting for a running calibration."""
        self._is_open = False
        self._worker.__exit__(None, None, None)
        self._caller.shutdown(cancel_futures=True)

    def show(self, name: str, detection: BoardDetection) -> None:
        """Add a capture's detection."""
        self._shown[name] = detection
        self._calibrate_again(detection)

    def forget(self, name: str) -> None:
        """Forget a capture; the remaining ones are calibrated again."""
        self._calibrate_again(self._shown.pop(name))

    def _calibrate_again(self, detection: BoardDetection) -> None:
        for k, guide in enumerate(self._guides):
            if not guide.is_of_peers and guide.sees(detection) and k not in self._due:
                self._due.append(k)

    def teach(self) -> None:
        """Pass the planner calibrated since the last call to its guide, and calibrate newer captures."""
        if self._running is not None and self._running[1].done():
            k, learned = self._running
            self._running, planner = None, None
            try:
                planner = learned.result()
            except Exception as error:  # Captures are safe even if a calibration fails.
                self._problem = f"guidance does not learn from captures: {error}" if self._is_open else ""
            # If captures were added or rejected meanwhile, calibrate this guide again.
            if k not in self._due:
                self._guides[k].adopt(planner)
        if self._running is None and self._due and self._is_open:
            k = self._due.popleft()
            guide = self._guides[k]
            candidates = [
                Observation.of(name, detection.images[guide.key], detection.lidars[guide.lidar])
                for name, detection in self._shown.items()
                if guide.sees(detection)
            ]
            if len(candidates) >= self._min_captures:
                self._running = k, self._caller.submit(self._worker.call, "learn", k, candidates)
            else:
                guide.adopt(None)

    def notes(self) -> list[str]:
        """Return the problem of the last calibration, if any."""
        return [self._problem] if self._problem else []


class _Teacher:
    """The calibrating object in the worker process."""

    def __init__(self, rig: Rig) -> None:
        self._rig, self._board = rig, rig.board.to_board()
        self._guides = make_guides(rig)

    def learn(self, k: int, candidates: Sequence[Observation]) -> Planner | None:
        """Calibrate one guide's sensors; None if more captures are needed."""
        guide = self._guides[k]
        tolerances = Tolerances.of(self._rig.cameras[guide.key[0]], self._rig.board)
        settings = EstimateSettings.of(CalibrateOptions(), self._rig.lidars[guide.lidar], tolerances)
        try:
            estimate = fit_extrinsic(list(candidates), self._board, settings)
        except (NotEnoughDataError, np.linalg.LinAlgError):
            return None
        if estimate.joint is None:
            return None
        levels, inflation = estimate.joint[0].levels, estimate.diagnostics.covariance_inflation
        return guide.prepare(estimate.T_cam_lidar, levels, inflation)


class CaptureWriter:
    """Writes captures one after the other, and rejects them in the same order.

    Attributes:
        session: open for writing.
        disk: its thread; open while its `with` block lasts.
    """

    def __init__(self, session: Session) -> None:
        """Prepare; see `CaptureWriter`."""
        self.session = session
        self._done: deque[tuple[str, BoardDetection | None, float]] = deque()
        # Captures are stored and rejected in the order of the requests.
        self.disk: DiskWriter[Callable[[], None]] = DiskWriter(session.path, lambda step: step())

    def close(self) -> None:
        """Write the pending captures, and stop.

        Raises:
            SessionError: a capture cannot be written.
        """
        self.disk.close()
        if self.disk.failure is not None:
            raise self.disk.failure

    @property
    def is_busy(self) -> bool:
        """Whether a capture is still to be written or rejected."""
        return self.disk.n_waiting > 0

    def keep(self, moment: CaptureMoment, events: Sequence[EventCut], meta: Mapping[str, object]) -> None:
        """Queue a capture for writing; returns at once.

        Args:
            moment: the board in its frame, whose images are stored.
            events: stretches of events that are stored.
            meta: the origin of the capture.
        """
        asked_s = time.monotonic()

        def store() -> None:
            frame = moment.detection.frame
            whole = {**meta, **moment.figures, **pose_figures(moment.detection.poses)}
            cuts = [cut.events for cut in events]
            name = self.session.add_capture(frame.images, frame.scans, whole, cuts)
            self._done.append((name, moment.detection, time.monotonic() - asked_s))

        self.disk.put(store)

    def take_back(self, name: str) -> None:
        """Reject a capture, even one that is not written yet; returns at once."""

        def reject() -> None:
            self.session.reject(name, "taken back while collecting")
            self._done.append((name, None, 0.0))

        self.disk.put(reject)

    def take(self) -> list[tuple[str, BoardDetection | None, float]]:
        """Return the captures saved or rejected since the last call, by name.

        With each its detection, None if it was taken back, and the time in s until it was saved.

        Raises:
            SessionError: a capture cannot be written: the disk is full, or gone.
        """
        failure = self.disk.failure
        done = [self._done.popleft() for _ in range(len(self._done))]
        if failure is not None and not done:
            raise failure
        return done


def record_streams(folder: Path, rig: Rig) -> tuple[Callable[[Sample], None], DiskWriter[Sample]]:
    """Record the samples of all sensors as a bag in a new folder.

    Args:
        folder: does not exist yet.
        rig: the profile.

    Returns:
        A function that takes each sample without blocking; and the writer of samples.

    Raises:
        SourceError: the folder exists already, or cannot be made.
    """
    recorder = BagRecorder.in_folder(folder, rig)
    disk: DiskWriter[Sample] = DiskWriter(folder, recorder.write, recorder.close)

    def record(sample: Sample) -> None:
        arrays = [value for value in vars(sample).values() if isinstance(value, np.ndarray)]
        disk.put(sample, sum(array.nbytes for array in arrays))

    return record, disk
