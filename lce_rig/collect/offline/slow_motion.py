"""The best moment of every place that a moving board passes.

Of the moments that will do for an event camera, follow each other within seconds and lie within a placement's
reach of each other, the one is taken whose events are whole, and whose speed is nearest to 10 cm/s and most
steady.
"""

from collections import deque
from collections.abc import Iterable, Iterator

import numpy as np

from lce_rig.collect.board_tracker import BoardDetection, CaptureMoment
from lce_rig.collect.event_moment import BEST_SPEED_MPS, SPEED_WINDOW_S, judge_detection
from lce_rig.collect.placement_dedupe import Placements
from lce_rig.core.findings import Refusal
from lce_rig.core.losses import Losses
from lce_rig.rig import Rig

# A way that strays from a straight one by this counts as much as a speed e times too high or low.
_UNSTEADY_M = 0.01


def find_moving_moments(
    detections: Iterable[BoardDetection],
    rig: Rig,
    taken: Placements,
    tally: Losses,
) -> Iterator[CaptureMoment]:
    """Yield the best moment of every place that the board passes, each place once.

    Which they are depends on the recording alone, so that a second run finds the same.

    Args:
        detections: in order of time.
        rig: the profile.
        taken: no placements yet; it says how far apart they must be.
        tally: receives why other detections are no moments.
    """
    gate = MotionGate(rig, taken, tally)
    for detection in detections:
        yield from gate.take(detection)
    yield from gate.finish()


class MotionGate:
    """Takes detections in order of time, and gives the best moment of every place that the board passes.

    Attributes:
        judged: the last detection that could be judged: a moment that will do, or why it does not; None where
            no camera of events saw the board.
    """

    def __init__(self, rig: Rig, taken: Placements, tally: Losses, patience_s: float = 2.0) -> None:
        """Begin without detections; a moment waits for `patience_s` for a better one of the same place."""
        self.judged: CaptureMoment | Refusal | None = None
        self._rig = rig
        self._tally = tally
        self._neighbours = _Neighbours(SPEED_WINDOW_S)
        self._chooser = _Chooser(patience_s, taken)

    def take(self, detection: BoardDetection) -> list[CaptureMoment]:
        """Take the next detection, and give the moments that nothing better can follow."""
        return self._judge(self._neighbours.take(detection))

    def finish(self) -> list[CaptureMoment]:
        """Give what is left when nothing more comes."""
        return [*self._judge(self._neighbours.finish()), *self._chooser.finish()]

    def _judge(
        self, detections: Iterable[tuple[BoardDetection, list[BoardDetection]]]
    ) -> list[CaptureMoment]:
        moments: list[CaptureMoment] = []
        for detection, around in detections:
            self.judged = judge_detection(detection, around, self._rig)
            if isinstance(self.judged, Refusal):
                self._tally.add(self.judged)
            moment = self.judged if isinstance(self.judged, CaptureMoment) else None
            moments.extend(self._chooser.take(detection.frame.time_ns, moment))
        return moments


class _Chooser:
    """Holds moments back until it is known whether a better one of the same place follows shortly."""

    def __init__(self, patience_s: float, taken: Placements) -> None:
        self._patience_s = patience_s
        self._taken = taken
        self._pending: deque[CaptureMoment] = deque()

    def take(self, now_ns: int, moment: CaptureMoment | None) -> Iterator[CaptureMoment]:
        """Take the moment at a time, where there is one, and yield those that nothing better came after."""
        patience_ns = self._patience_s * 1e9
        while self._pending and not 0 <= now_ns - self._pending[0].detection.frame.time_ns < patience_ns:
            yield from self._decide_oldest()
        if moment is not None and self._taken.find_like(moment.detection.images) is None:
            self._pending.append(moment)

    def finish(self) -> Iterator[CaptureMoment]:
        """Yield what is left when the recording has ended."""
        while self._pending:
            yield from self._decide_oldest()

    def _decide_oldest(self) -> Iterator[CaptureMoment]:
        """Give up the oldest moment, unless it stands when the best of all are taken first, one a place."""
        oldest = self._pending.popleft()
        if self._taken.find_like(oldest.detection.images) is not None:
            return

        def badness(moment: CaptureMoment) -> tuple[bool, float]:
            is_short = any(cut.missing_ns > 0 for cut in moment.detection.frame.events)
            speed_ratio = max(moment.figures["speed_mps"], 1e-3) / BEST_SPEED_MPS
            return is_short, abs(float(np.log(speed_ratio))) + moment.figures["unsteady_m"] / _UNSTEADY_M

        kept: list[CaptureMoment] = []
        for moment in sorted((oldest, *self._pending), key=badness):
            boards = moment.detection.images
            if any(self._taken.are_alike(boards, other.detection.images) for other in kept):
                continue
            if moment is oldest:
                self._taken.add(str(oldest.detection.frame.time_ns), boards)
                yield oldest
                return
            kept.append(moment)


class _Neighbours:
    """Gives each detection with all within half a window of it, itself among them, once they have come."""

    def __init__(self, window_s: float) -> None:
        self._half_ns = round(window_s * 0.5e9)
        self._near: deque[BoardDetection] = deque()
        self._n_waiting = 0

    def take(self, detection: BoardDetection) -> Iterator[tuple[BoardDetection, list[BoardDetection]]]:
        """Take the next detection, and give those whose neighbours are complete."""
        near, now_ns = self._near, detection.frame.time_ns
        if near and now_ns <= near[-1].frame.time_ns:
            # The clocks were set back.
            yield from self.finish()
        near.append(detection)
        self._n_waiting += 1
        while now_ns - near[-self._n_waiting].frame.time_ns >= self._half_ns:
            oldest = near[-self._n_waiting]
            yield oldest, self._around(oldest)
            self._n_waiting -= 1
        while near[-max(self._n_waiting, 1)].frame.time_ns - near[0].frame.time_ns > self._half_ns:
            near.popleft()

    def finish(self) -> Iterator[tuple[BoardDetection, list[BoardDetection]]]:
        """Give those that still wait, and forget all."""
        for place in range(len(self._near) - self._n_waiting, len(self._near)):
            yield self._near[place], self._around(self._near[place])
        self._near.clear()
        self._n_waiting = 0

    def _around(self, detection: BoardDetection) -> list[BoardDetection]:
        time_ns = detection.frame.time_ns
        return [other for other in self._near if abs(other.frame.time_ns - time_ns) <= self._half_ns]
