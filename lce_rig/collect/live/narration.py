"""What goes on, and the one thing to do about it, in words for the person who holds the board."""

from dataclasses import dataclass

from lce_rig.collect.board_tracker import BoardDetection, CaptureMoment, ImageKey
from lce_rig.collect.event_moment import BEST_SPEED_MPS
from lce_rig.collect.guidance import say
from lce_rig.collect.live.guide import Guide
from lce_rig.collect.live.state import Phase
from lce_rig.core.findings import Refusal
from lce_rig.core.geometry import Array
from lce_rig.core.results import ImageBoard, LidarBoard

_HOLD = "hold still"
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
        why = reasons.get(stream_name(guide.key))
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


def narrate_still(
    guide: Guide, present: Array, held_s: float | None, hold_s: float, refusal: Refusal | None
) -> Narration:
    """Say where a board goes that has to stand still to be captured.

    Args:
        guide: of the sensors that see it.
        present: (4, 4) where it is.
        held_s: for how long it has stood still; None while it moves.
        hold_s: for how long it has to.
        refusal: why it need not be captured here; None where it adds something.
    """
    if held_s is not None and refusal is not None:
        return narrate_refused(guide, present, refusal)
    if held_s is not None:
        return Narration("holding", _HOLD, "", max(hold_s - held_s, 0.0))
    return Narration("moving", _next(guide, present, _HOLD), _problem(guide))


def narrate_refused(guide: Guide, present: Array, refusal: Refusal) -> Narration:
    """Say why a board is not captured where it is, and where it goes instead."""
    return Narration("refused", _next(guide, present, refusal.advice), f"not here: {refusal.text}")


def narrate_moving(guide: Guide, present: Array, judged: CaptureMoment | Refusal | None) -> Narration:
    """Say where a board goes that has to move slowly to be captured."""
    headline = _next(guide, present, f"move it slowly, about {100 * BEST_SPEED_MPS:.0f} cm/s")
    if isinstance(judged, Refusal):
        return Narration("moving", headline, judged.sentence)
    if isinstance(judged, CaptureMoment) and guide.is_there(present):
        return Narration("holding", "good: go on slowly", f"{judged.figures['speed_mps']:.2f} m/s")
    return Narration("moving", headline, _problem(guide))


def stream_name(key: ImageKey) -> str:
    """Name a camera's channel as views do."""
    return f"{key[0]}.{key[1]}"


def image_figures(board: ImageBoard) -> str:
    """Sum a board in an image up in few words."""
    return f"{board.distance_m:.1f} m, {board.reprojection_px:.2f} px"


def scan_figures(board: LidarBoard) -> str:
    """Sum a board in a scan up in few words."""
    return f"{board.quality.n_rings} rings, {len(board.points)} points"


def _problem(guide: Guide) -> str:
    """Say why there is no guidance; "" while there is."""
    return guide.problem.sentence if guide.problem else ""


def _next(guide: Guide, present: Array, otherwise: str) -> str:
    """Say how to go on to the wanted placement; something else where the board is there, or none is known."""
    if guide.wanted is None:
        return _ELSEWHERE if guide.guidance is None else otherwise
    instructions = guide.instruct(present)
    return say(instructions) if instructions else otherwise
