"""Captures of two sensors, the next placement, and the decision when to capture a board."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from lce_rig.calibrate.likelihood.levels import Levels
from lce_rig.collect.board_tracker import BoardDetection, CaptureMoment, ImageKey
from lce_rig.collect.findings import (
    CALIBRATE_SAME_PLACEMENT,
    GUIDE_CONTINUES,
    GUIDE_NO_BEAMS,
    GUIDE_NO_NOMINAL,
    GUIDE_OF_PEERS,
    GUIDE_PREDICTED,
)
from lce_rig.collect.gates import BEST_SPEED_MPS, MotionGate, StillnessGate, stillness_window_s
from lce_rig.collect.guidance.instructions import Kind, instruct, is_there, say
from lce_rig.collect.guidance.planner import (
    ENOUGH_SHARE,
    Beside,
    Coverage,
    Guidance,
    Planner,
    measure_coverage,
)
from lce_rig.collect.guidance.sensor_model import SensorModel, SensorPlace
from lce_rig.collect.live.state import Phase
from lce_rig.collect.placement_dedupe import MIN_MOVE_M, MIN_TURN_DEG, Placements, capture_poses, find_alike
from lce_rig.core.errors import LceRigError, ProfileError
from lce_rig.core.findings import Finding, Losses, Refusal
from lce_rig.core.geometry import Array, invert
from lce_rig.detect.events.figures import outline_px
from lce_rig.rig import Rig
from lce_rig.session import Capture, Session

#: Time after which another placement is proposed if the board has not reached the target, s.
GIVE_UP_S = 30.0
# Sufficient number of captures of two sensors of one kind: in simulations it gives 0.04 deg and 2 mm for two
# LiDARs, 0.04 deg and 8 mm for two cameras.
_ENOUGH_OF_PEERS = 12


class Guide:
    """Guides the board in front of one camera and one LiDAR.

    Without nominal extrinsics in the profile, guidance starts after a first calibration. It is not available
    for a LiDAR with unknown beams, nor for two sensors of one kind, whose captures are only counted.

    Attributes:
        key: camera and channel that follow the board; the first of two LiDARs, and "".
        lidar: name of the LiDAR, or of the second camera.
        second: key of that LiDAR or second camera.
        is_of_peers: whether both sensors are of one kind.
        problem: why guidance is not available yet; None while it is.
        guidance: the latest; None before the first.
    """

    def __init__(self, rig: Rig, key: ImageKey, lidar: str) -> None:
        """Begin without captures."""
        self.key = key
        self.lidar = lidar
        self.second = lidar, _channel_of(rig, lidar)
        self.is_of_peers = key[0] in rig.lidars or lidar in rig.cameras
        self.problem: Finding | None = None
        self.guidance: Guidance | None = None
        self._min_captures = rig.quality.min_captures
        self._target_deg = rig.calibration.target_sigma_deg
        self._target_mm = 1000 * rig.calibration.target_sigma_m
        self._names: list[str] = []
        self._held: list[Array] = []
        self._avoid: list[Array] = []
        self._wanted_since_s = 0.0
        self._coverage: Coverage | None = None
        self._planner: Planner | None = None
        self._at_first: tuple[Planner | None, Finding | None]
        self._model: SensorModel | None = None
        self._n_enough = max(_ENOUGH_OF_PEERS, rig.quality.min_captures)
        if self.is_of_peers:
            self.problem = GUIDE_OF_PEERS(n_captures=self._n_enough)
            self._at_first = None, self.problem
            return
        try:
            self._model = SensorModel.of(rig, key[0], lidar)
        except ProfileError as error:
            self.problem = GUIDE_NO_BEAMS(lidar, cause=error.what)
            self._at_first = None, self.problem
            return
        nominal = rig.nominal(key[0], lidar)
        if nominal is None:
            self.problem = GUIDE_NO_NOMINAL(n_captures=rig.quality.min_captures, camera=key[0], lidar=lidar)
        else:
            self._planner = Planner(SensorPlace(self._model, nominal.to_matrix()))
        self._at_first = self._planner, self.problem

    @property
    def n_held(self) -> int:
        """Captures so far."""
        return len(self._held)

    @property
    def is_enough(self) -> bool:
        """Whether the target is predicted to be met, or a pair of one kind has enough captures."""
        if self.is_of_peers:
            return self.n_held >= self._n_enough
        return self.guidance is not None and self.guidance.is_enough

    @property
    def has_enough(self) -> bool:
        """Whether there are enough captures: as predicted or, without a prediction, by their number."""
        return self.n_held >= self._min_captures if self._planner is None else self.is_enough

    @property
    def need(self) -> float:
        """Predicted standard deviation relative to the target: more captures are needed above 1."""
        if self.guidance is None:
            return (self._n_enough if self.is_of_peers else self._min_captures) / max(self.n_held, 0.5)
        return max(
            self.guidance.bound_rotation_deg / (ENOUGH_SHARE * self._target_deg),
            1000 * self.guidance.bound_translation_m / (ENOUGH_SHARE * self._target_mm),
        )

    @property
    def why_none(self) -> str:
        """Reason why guidance is unavailable; "" if it is available."""
        return self.problem.sentence if self.problem else ""

    @property
    def is_exhausted(self) -> bool:
        """Whether no new placement is known."""
        return self.guidance is not None and self.guidance.T_cam_board is None

    @property
    def wanted(self) -> Array | None:
        """Target placement T_cam_board (4, 4); None if no reachable placement is new."""
        return None if self.guidance is None else self.guidance.T_cam_board

    def sees(self, detection: BoardDetection) -> bool:
        """Check whether both sensors detect the board within the profile's limits."""
        seen = {(lidar, "") for lidar in detection.lidars} | (
            detection.images.keys() - detection.unfit.keys()
        )
        return {self.key, self.second} <= seen

    def add(self, name: str, T_cam_board: Array) -> None:
        """Add a capture; `plan` then chooses the next placement."""
        self._names.append(name)
        self._held.append(T_cam_board)
        self.guidance = self._coverage = None

    def remove(self, name: str) -> None:
        """Remove a capture that was rejected; its placement is new again."""
        left = [k for k in range(len(self._names)) if self._names[k] != name]
        self._names, self._held = [self._names[k] for k in left], [self._held[k] for k in left]
        self.guidance = self._coverage = None

    def prepare(self, T_cam_lidar: Array, levels: Levels, inflation: float) -> Planner | None:
        """Build a planner from a calibration of the captures, without changing the guide; takes a second.

        Args:
            T_cam_lidar: (4, 4).
            levels: estimated noise levels.
            inflation: factor by which the scatter of the captures widened the covariance.
        """
        if self._model is None:
            return None
        learned = replace(self._model, levels=levels, inflation=inflation)
        return Planner(SensorPlace(learned, T_cam_lidar))

    def adopt(self, planner: Planner | None) -> None:
        """Adopt a planner from `prepare`; None returns to the planner before any capture."""
        before = self._planner
        self._planner, self.problem = self._at_first if planner is None else (planner, None)
        if self._planner is not before:
            self.guidance = self._coverage = None

    def plan(
        self,
        present: Array | None,
        now_s: float,
        *,
        is_asked: bool = True,
        others: Sequence["Guide"] = (),
    ) -> None:
        """Choose the next placement if there is none, or if the last one was not reached in time.

        Args:
            present: (4, 4) T_cam_board now; None if the board is not seen.
            now_s: current time of the sensors' clock.
            is_asked: whether the user follows this guide.
            others: other guides of the rig, whose sensors may see the board, too.
        """
        if self._planner is None:
            return
        if not is_asked or now_s < self._wanted_since_s:  # Clocks may be set back.
            self._wanted_since_s = now_s
        if self.guidance is not None and now_s - self._wanted_since_s < GIVE_UP_S:
            return
        if self.guidance is not None:
            self.give_up()
        beside = [each for other in others if (each := self._beside(other)) is not None]
        guidance = self._planner.guide(self._held_poses(), present, self._avoided(), beside)
        if guidance.T_cam_board is None and self._avoid:
            # Obstacles may be gone: propose unreachable placements again rather than nothing.
            del self._avoid[:-1]
            guidance = self._planner.guide(self._held_poses(), present, self._avoided(), beside)
        self.guidance = guidance
        self._wanted_since_s = now_s

    def _beside(self, other: "Guide") -> Beside | None:
        """Describe another guide that still needs captures, related by the common camera or LiDAR."""
        if self._planner is None or other._planner is None or other is self or other.is_enough:
            return None
        own, its = self._planner.view.T_cam_lidar, other._planner.view.T_cam_lidar
        if other.key == self.key:
            return Beside(other._planner, np.eye(4), other._held_poses())
        if other.lidar == self.lidar:
            return Beside(other._planner, its @ invert(own), other._held_poses())
        return None

    def note_refusal(self, present: Array) -> None:
        """Choose another placement if a board (4, 4) was refused at the target."""
        if self.is_there(present):
            self.give_up()

    def give_up(self) -> None:
        """Choose another placement because this one is out of reach."""
        if self.wanted is not None:
            self._avoid.append(self.wanted)
        self.guidance = None

    def adds_nothing(self, present: Array) -> Refusal | None:
        """Return why a capture of the board (4, 4) is not needed; None if it adds information."""
        if self.is_of_peers:
            is_alike = find_alike(self._held_poses(), present[None], MIN_MOVE_M, np.radians(MIN_TURN_DEG))
            return CALIBRATE_SAME_PLACEMENT.refusal() if is_alike.any() else None
        if self._planner is None:
            return None
        held, avoid = self._held_poses(), self._avoided()
        return self._planner.adds_nothing(held, present, self._names, avoid, self.wanted)

    def explain(self) -> Finding | None:
        """Return why more captures are needed, and about how many; None if there are enough."""
        guidance = self.guidance
        if guidance is None or guidance.is_enough or not self._names:
            return None
        return GUIDE_CONTINUES(
            self.key[0],
            n_more=guidance.n_more,
            n_least=guidance.n_least,
            rotation_deg=guidance.bound_rotation_deg,
            limit_deg=ENOUGH_SHARE * self._target_deg,
            position_mm=1000 * guidance.bound_translation_m,
            limit_mm=ENOUGH_SHARE * self._target_mm,
        )

    def predict(self) -> Finding | None:
        """Return the predicted standard deviations for the captures; None without a prediction."""
        if self._planner is None or not self._names:
            return None
        guidance = self.guidance or self._planner.guide(self._held_poses())
        return GUIDE_PREDICTED(
            f"{self.key[0]}, {self.lidar}",
            n_captures=guidance.n_captures,
            rotation_deg=guidance.bound_rotation_deg,
            target_deg=self._target_deg,
            position_mm=1000 * guidance.bound_translation_m,
            target_mm=self._target_mm,
            is_enough=guidance.is_enough,
        )

    def instruct(self, present: Array) -> dict[Kind, str]:
        """Return the moves from a board (4, 4) to the target placement."""
        if self._planner is None or self.wanted is None:
            return {}
        return instruct(self._planner.view, present, self.wanted)

    def is_there(self, present: Array) -> bool:
        """Check whether a board (4, 4) is at the target placement."""
        if self._planner is None or self.wanted is None:
            return False
        return is_there(self._planner.view, present, self.wanted)

    def outline_px(self, T_cam_board: Array) -> Array | None:
        """Project a board (4, 4) into the image as a closed polygon."""
        model = self._model
        return None if model is None else outline_px(T_cam_board, model.board, model.lens)

    def coverage(self) -> Coverage | None:
        """Measure the coverage of the reachable placements by the captures."""
        if self._coverage is None and self._planner is not None:
            held, reachable = self._held_poses(), self._planner.candidates
            self._coverage = measure_coverage(self._planner.view, held, reachable)
        return self._coverage

    def _avoided(self) -> Array | None:
        return np.stack(self._avoid) if self._avoid else None

    def _held_poses(self) -> Array:
        return np.stack(self._held) if self._held else np.zeros((0, 4, 4))


def count_in(capture: Capture, session: Session, guides: Sequence[Guide]) -> None:
    """Add a session's capture to the guides."""
    try:
        poses, lidars = capture_poses(capture, session), capture.lidars
    except LceRigError:
        return  # A damaged capture is named when it is used.
    for guide in guides:
        seen = {*poses, *((lidar, "") for lidar in lidars)}
        if guide.key in poses and guide.second in seen:
            guide.add(capture.name, poses[guide.key])


def predict(session: Session) -> list[Finding]:
    """Predict the standard deviations for the captures of a session with nominal extrinsics.

    Captures without stored poses of the board, such as those of a folder, are not searched for it.
    """
    with_poses = [c for c in session.captures if isinstance(c.meta.get("T_cam_board"), dict)]
    guides = make_guides(session.rig) if with_poses else []
    for capture in with_poses:
        count_in(capture, session, guides)
    return [finding for guide in guides if (finding := guide.predict()) is not None]


def make_guides(rig: Rig) -> list[Guide]:
    """Make a guide for every camera with every LiDAR, on the camera's frames channel if it has one.

    In a rig of one kind of sensor, make one for the first with each other.
    """
    if not rig.cameras or not rig.lidars:
        first, *others = [*rig.lidars, *rig.cameras]
        return [Guide(rig, (first, _channel_of(rig, first)), other) for other in others]
    keys: list[ImageKey] = [(name, _channel_of(rig, name)) for name in rig.cameras]
    return [Guide(rig, key, lidar) for key in keys for lidar in rig.lidars]


def _channel_of(rig: Rig, sensor: str) -> str:
    """Return the channel of a camera that shows the board, preferably frames; "" for a LiDAR."""
    if sensor in rig.lidars:
        return ""
    camera = rig.cameras[sensor]
    return camera.first_channel("frames") or next(iter(camera.channels))


_HOLD, _MOVE = "hold still", f"move it slowly, about {100 * BEST_SPEED_MPS:.0f} cm/s"
_SHOW = "show the board to the camera"
_ELSEWHERE = "hold it somewhere else, with another tilt"


@dataclass(frozen=True)
class Narration:
    """The instruction shown to the person with the board.

    Attributes:
        phase, headline, detail, hold_s: see `LiveState`.
    """

    phase: Phase
    headline: str
    detail: str = ""
    hold_s: float | None = None


def narrate_unseen(detection: BoardDetection, guide: Guide, reasons: dict[str, Refusal]) -> Narration:
    """Explain why the board is not detected.

    Args:
        detection: detection in which a sensor of the guide does not see the board well enough.
        guide: the guide of these sensors.
        reasons: the last refusal of each stream, by its name.
    """
    lidar = guide.lidar
    if not guide.key[1] and guide.key[0] not in detection.lidars:
        lidar = guide.key[0]
    for key in (each for each in (guide.key, guide.second) if each[1]):
        if key not in detection.images:
            why = reasons.get(".".join(key))
            # The reason is useful only if part of the board was seen.
            headline = f"show the board to {key[0]}" if detection.images else _SHOW
            return Narration("searching", headline, why.sentence if why else "")
        if key in detection.unfit:
            why = detection.unfit[key]
            headline = _next(guide, detection.images[key].T_cam_board, why.advice)
            return Narration("moving", headline, f"cannot be used here: {why.text}")
    why = reasons.get(lidar)
    headline = why.advice if why else f"show the board to {lidar}"
    return Narration("searching", headline, f"{lidar}: {why.text}" if why else "")


def narrate_refused(guide: Guide, present: Array, refusal: Refusal) -> Narration:
    """Explain why the board is not captured at its present placement, and return the next move."""
    return Narration("refused", _next(guide, present, refusal.advice), f"not here: {refusal.text}")


def _next(guide: Guide, present: Array, otherwise: str) -> str:
    """Return the next instruction; the fallback if the board is there or no placement is planned."""
    if guide.wanted is None:
        return _ELSEWHERE if guide.guidance is None else otherwise
    instructions = guide.instruct(present)
    return say(instructions) if instructions else otherwise


#: Longest wait for a better capture at the same placement, s.
LIVE_PATIENCE_S = 0.7


class StillBoards:
    """Captures boards that stand still for `hold_s`.

    Attributes:
        is_decided: whether the board has been captured or rejected since it last moved.
    """

    def __init__(self, rig: Rig, hold_s: float) -> None:
        self._hold_s = hold_s
        self._max_motion_m = rig.quality.max_motion_m
        # The first window of stillness has passed when the hold begins.
        window_s = stillness_window_s(rig)
        self._gate = StillnessGate(rig.board.to_board(), self._max_motion_m, hold_s, window_s=window_s)
        self._is_judged = self.is_decided = False
        self._refusal: Refusal | None = None

    def take(self, detection: BoardDetection) -> list[CaptureMoment]:
        """Process the next detection; a board that moves too early is not captured."""
        moments = self._gate.take(detection)
        if self._gate.motion_m > self._max_motion_m:
            self._is_judged = self.is_decided = False
            return []
        if not moments or self.is_decided:
            return []
        self.is_decided = True
        return moments

    def narrate(self, guide: Guide, present: Array) -> Narration:
        """Return the instruction for a board seen at (4, 4)."""
        held_s = self._gate.held_s
        # Judging a placement is slow: do it once per period of stillness.
        if held_s is not None and not self._is_judged:
            self._is_judged, self._refusal = True, guide.adds_nothing(present)
            if self._refusal is not None:
                guide.note_refusal(present)
        if held_s is None or self.is_decided:
            return Narration("moving", _next(guide, present, _HOLD), guide.why_none)
        if self._refusal is not None:
            return narrate_refused(guide, present, self._refusal)
        return Narration("holding", _HOLD, "", max(self._hold_s - held_s, 0.0))


class SlowBoards:
    """Captures boards moving slowly in front of an event camera, at placements not yet in `taken`."""

    def __init__(self, rig: Rig, taken: Placements) -> None:
        self._gate = MotionGate(rig, taken, Losses(), LIVE_PATIENCE_S)

    def take(self, detection: BoardDetection) -> list[CaptureMoment]:
        """Take the next detection."""
        return self._gate.take(detection)

    def narrate(self, guide: Guide, present: Array) -> Narration:
        """Return the instruction for a board seen at (4, 4)."""
        headline, judged = _next(guide, present, _MOVE), self._gate.judged
        if isinstance(judged, Refusal):
            return Narration("moving", headline, judged.sentence)
        if isinstance(judged, CaptureMoment) and guide.is_there(present):
            return Narration("holding", "good: go on slowly", f"{judged.figures['speed_mps']:.2f} m/s")
        return Narration("moving", headline, guide.why_none)
