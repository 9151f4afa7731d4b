"""When a live board is captured: standing still, or moving slowly where events are wanted."""

from lce_rig.collect.board_tracker import BoardDetection, CaptureMoment
from lce_rig.collect.live.guide import Guide
from lce_rig.collect.live.narration import Narration, narrate_moving, narrate_still
from lce_rig.collect.offline.slow_motion import MotionGate
from lce_rig.collect.offline.stillness import StillnessGate
from lce_rig.collect.placement_dedupe import Placements
from lce_rig.core.findings import Refusal
from lce_rig.core.geometry import Array
from lce_rig.core.losses import Losses
from lce_rig.rig import Rig
from lce_rig.timing.event_buffer import EventCut

#: A live moment waits for a better one of its place no longer than this.
LIVE_PATIENCE_S = 0.7


class StillBoards:
    """Captures boards that stand still for `hold_s`."""

    def __init__(self, rig: Rig, hold_s: float) -> None:
        self._hold_s = hold_s
        self._max_motion_m = rig.quality.max_motion_m
        # The first window of stillness has passed when the hold begins.
        self._gate = StillnessGate(rig.board.to_board(), self._max_motion_m, hold_s)
        self._is_judged = self._is_decided = self._is_captured = False
        self._refusal: Refusal | None = None

    def take(self, detection: BoardDetection) -> list[CaptureMoment]:
        """Take the next detection; a board that is moved on before its time is not captured."""
        moment = self._gate.take(detection)
        if self._gate.motion_m > self._max_motion_m:
            self._is_judged = self._is_decided = self._is_captured = False
            return []
        if moment is None or self._is_decided:
            return []
        self._is_decided = True
        return [moment]

    def narrate(self, guide: Guide, present: Array) -> Narration:
        """Say what to do with a board that is seen at (4, 4)."""
        held_s = self._gate.held_s
        # Weighing a placement takes long: once a stretch of stillness is enough.
        if held_s is not None and not self._is_judged:
            self._is_judged, self._refusal = True, guide.adds_nothing(present)
            if self._refusal is not None:
                guide.note_refusal(present)
        if self._is_decided:
            return narrate_still(guide, present, None, self._hold_s, None)
        return narrate_still(guide, present, held_s, self._hold_s, self._refusal)

    def events_of(self, moment: CaptureMoment) -> tuple[EventCut, ...]:
        """Give none: a board that stands still makes too few events."""
        return ()

    @property
    def is_captured(self) -> bool:
        """Whether the board still stands where it was captured."""
        return self._is_captured

    def note_capture(self, detection: BoardDetection) -> None:
        """Capture a board that was captured no more before it has moved."""
        self._is_decided = self._is_captured = True

    def forget_capture(self, time_ns: int) -> None:
        """Let a key capture it again; by itself it is captured after it has moved only."""
        self._is_captured = False


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
        return narrate_moving(guide, present, self._gate.judged)

    def events_of(self, moment: CaptureMoment) -> tuple[EventCut, ...]:
        """Give all of them."""
        return moment.detection.frame.events

    @property
    def is_captured(self) -> bool:
        """Never known: boards move."""
        return False

    def note_capture(self, detection: BoardDetection) -> None:
        """Count the place of a capture as taken; what the gate itself has chosen is taken already."""
        self._novelty.add(str(detection.frame.time_ns), detection.images)

    def forget_capture(self, time_ns: int) -> None:
        """Let the place of a capture be new again."""
        self._novelty.remove(str(time_ns))
