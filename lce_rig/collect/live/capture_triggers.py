"""When a live board is captured, and the one thing that the person who holds it is told to do."""

from dataclasses import dataclass

from lce_rig.collect.board_tracker import BoardDetection, CaptureMoment
from lce_rig.collect.gates import BEST_SPEED_MPS, MotionGate, StillnessGate, stillness_window_s
from lce_rig.collect.guidance.instructions import say
from lce_rig.collect.live.guide import Guide
from lce_rig.collect.live.state import Phase
from lce_rig.collect.placement_dedupe import Placements
from lce_rig.core.findings import Refusal
from lce_rig.core.geometry import Array
from lce_rig.core.losses import Losses
from lce_rig.rig import Rig
from lce_rig.timing.event_buffer import EventCut

_HOLD, _MOVE = "hold still", f"move it slowly, about {100 * BEST_SPEED_MPS:.0f} cm/s"
_SHOW = "show the board to the camera"
_ELSEWHERE = "hold it somewhere else, tilted otherwise"


@dataclass(frozen=True)
class Narration:
    """One moment in words.

    Attributes:
        phase, headline, detail, hold_s: as `LiveState`.
    """

    phase: Phase
    headline: str
    detail: str = ""
    hold_s: float | None = None


def narrate_unseen(detection: BoardDetection, guide: Guide, reasons: dict[str, Refusal]) -> Narration:
    """Say what keeps a board out of sight.

    Args:
        detection: in which the guide's camera or LiDAR does not see the board, or not well enough.
        guide: whose sensors they are.
        reasons: the last refusal of each stream, by its name.
    """
    if guide.key not in detection.images:
        why = reasons.get(".".join(guide.key))
        # An image without a board hardly tells why; one with half a board does.
        headline = f"show the board to {guide.key[0]}" if detection.images else _SHOW
        return Narration("searching", headline, why.sentence if why else "")
    if guide.key in detection.unfit:
        why = detection.unfit[guide.key]
        headline = _next(guide, detection.images[guide.key].T_cam_board, why.advice)
        return Narration("moving", headline, f"cannot be used here: {why.text}")
    why = reasons.get(guide.lidar)
    headline = why.advice if why else "the LiDAR does not see the board"
    return Narration("searching", headline, f"{guide.lidar}: {why.text}" if why else "")


def narrate_refused(guide: Guide, present: Array, refusal: Refusal) -> Narration:
    """Say why a board is not captured where it is, and where it goes instead."""
    return Narration("refused", _next(guide, present, refusal.advice), f"not here: {refusal.text}")


def _problem(guide: Guide) -> str:
    """Say why there is no guidance; "" while there is."""
    return guide.problem.sentence if guide.problem else ""


def _next(guide: Guide, present: Array, otherwise: str) -> str:
    """Say how to go on to the wanted placement; something else where the board is there, or none is known."""
    if guide.wanted is None:
        return _ELSEWHERE if guide.guidance is None else otherwise
    instructions = guide.instruct(present)
    return say(instructions) if instructions else otherwise


#: A live moment waits for a better one of its place no longer than this.
LIVE_PATIENCE_S = 0.7


class StillBoards:
    """Captures boards that stand still for `hold_s`."""

    def __init__(self, rig: Rig, hold_s: float) -> None:
        self._hold_s = hold_s
        self._max_motion_m = rig.quality.max_motion_m
        # The first window of stillness has passed when the hold begins.
        window_s = stillness_window_s(rig)
        self._gate = StillnessGate(rig.board.to_board(), self._max_motion_m, hold_s, window_s=window_s)
        self._is_judged = self._is_decided = False
        self._refusal: Refusal | None = None

    def take(self, detection: BoardDetection) -> list[CaptureMoment]:
        """Take the next detection; a board that is moved on before its time is not captured."""
        moments = self._gate.take(detection)
        if self._gate.motion_m > self._max_motion_m:
            self._is_judged = self._is_decided = False
            return []
        if not moments or self._is_decided:
            return []
        self._is_decided = True
        return moments

    def narrate(self, guide: Guide, present: Array) -> Narration:
        """Say what to do with a board that is seen at (4, 4)."""
        held_s = self._gate.held_s
        # Weighing a placement takes long: once a stretch of stillness is enough.
        if held_s is not None and not self._is_judged:
            self._is_judged, self._refusal = True, guide.adds_nothing(present)
            if self._refusal is not None:
                guide.note_refusal(present)
        if held_s is None or self._is_decided:
            return Narration("moving", _next(guide, present, _HOLD), _problem(guide))
        if self._refusal is not None:
            return narrate_refused(guide, present, self._refusal)
        return Narration("holding", _HOLD, "", max(self._hold_s - held_s, 0.0))

    def events_of(self, moment: CaptureMoment) -> tuple[EventCut, ...]:
        """Give none: a board that stands still makes too few events."""
        return ()

    def note_capture(self, detection: BoardDetection) -> None:
        """Capture a board that was captured no more before it has moved."""
        self._is_decided = True

    def forget_capture(self, time_ns: int) -> None:
        """Do nothing: a key captures it again, and by itself it is captured after it has moved only."""


class SlowBoards:
    """Captures boards that move slowly before a camera of events."""

    def __init__(self, rig: Rig, novelty: Placements) -> None:
        self._novelty = novelty
        self._gate = MotionGate(rig, novelty, Losses(), LIVE_PATIENCE_S)

    def take(self, detection: BoardDetection) -> list[CaptureMoment]:
        """Take the next detection."""
        return self._gate.take(detection)

    def narrate(self, guide: Guide, present: Array) -> Narration:
        """Say what to do with a board that is seen at (4, 4)."""
        headline, judged = _next(guide, present, _MOVE), self._gate.judged
        if isinstance(judged, Refusal):
            return Narration("moving", headline, judged.sentence)
        if isinstance(judged, CaptureMoment) and guide.is_there(present):
            return Narration("holding", "good: go on slowly", f"{judged.figures['speed_mps']:.2f} m/s")
        return Narration("moving", headline, _problem(guide))

    def events_of(self, moment: CaptureMoment) -> tuple[EventCut, ...]:
        """Give all of them."""
        return moment.detection.frame.events

    def note_capture(self, detection: BoardDetection) -> None:
        """Count the place of a capture as taken; what the gate itself has chosen is taken already."""
        self._novelty.add(str(detection.frame.time_ns), detection.poses)

    def forget_capture(self, time_ns: int) -> None:
        """Let the place of a capture be new again."""
        self._novelty.remove(str(time_ns))
