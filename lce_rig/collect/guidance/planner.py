"""Placements that reduce the predicted covariance most: the next one, and the ones a session lacks."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from lce_rig.collect.findings import CALIBRATE_KNOWN_PLACEMENT, CALIBRATE_LITTLE_GAIN, GUIDE_ADD
from lce_rig.collect.guidance.evidence import Predictor, few_captures_factor, shortfall, sigmas
from lce_rig.collect.guidance.instructions import describe_pose, instruct, is_there, say
from lce_rig.collect.guidance.sensor_model import DIAMOND_DEG, SensorModel, SensorPlace, spread_candidates
from lce_rig.collect.placement_dedupe import MIN_MOVE_M, MIN_TURN_DEG, find_alike
from lce_rig.core.calibration import Calibration
from lce_rig.core.camera import Intrinsics
from lce_rig.core.errors import ProfileError
from lce_rig.core.findings import Finding, Refusal
from lce_rig.core.geometry import T_BODY_OPTICAL, Array
from lce_rig.rig import Rig

#: Span of the captures that fills a bar, as a fraction of the reachable placements' span.
FULL_SHARE = 0.7
#: Minimum angle at which a board is described as tilted to a side, deg.
LEANS_DEG = 15.0
#: Range of the boards' rolls that fills the bar, deg.
FULL_ROLL_DEG = 20.0


@dataclass(frozen=True)
class Coverage:
    """Five bars, each 0..1.

    Attributes:
        left_right, up_down: spread of the boards' positions in the image.
        near_far: ratio of the largest to the smallest distance.
        tilt: a quarter for each of top, bottom, left and right that was tilted to the rig by `LEANS_DEG`.
        roll: range of the boards' rotations in their plane.
    """

    left_right: float
    up_down: float
    near_far: float
    tilt: float
    roll: float


def measure_coverage(view: SensorPlace, held: Array, reachable: Array) -> Coverage:
    """Measure the coverage of captures.

    Args:
        view: the sensors.
        held: (N, 4, 4) T_cam_board of the captures.
        reachable: (M, 4, 4) T_cam_board of reachable placements, `Planner.candidates`.
    """
    if len(held) == 0:
        return Coverage(0.0, 0.0, 0.0, 0.0, 0.0)
    shown, whole = _places(view, held), _places(view, reachable)
    spans = np.ptp(shown, axis=0) / np.maximum(FULL_SHARE * np.ptp(whole, axis=0), 1e-9)
    left_right, up_down, near_far = np.clip(spans, 0.0, 1.0)
    poses = [describe_pose(view, T_cam_board) for T_cam_board in held]
    lean = np.array([[pose.tilt_deg, pose.turn_deg] for pose in poses])
    leanings = np.concatenate([lean.max(axis=0) > LEANS_DEG, lean.min(axis=0) < -LEANS_DEG])
    # A pattern looks the same upside down.
    roll = np.array([(pose.roll_deg - DIAMOND_DEG + 90) % 180 - 90 for pose in poses])
    return Coverage(
        left_right=float(left_right),
        up_down=float(up_down),
        near_far=float(near_far),
        tilt=float(leanings.mean()),
        roll=float(min(np.ptp(roll) / FULL_ROLL_DEG, 1.0)),
    )


def _places(view: SensorPlace, T_cam_board: Array) -> Array:
    """Return the board centres' position in the image, px, and the log of their distance, (N, 3)."""
    centre = T_cam_board[:, :3, 3]
    pixels, _ = view.model.lens.project(centre)
    # A centre outside the image counts as one in its middle.
    middle = [view.model.lens.cx_px, view.model.lens.cy_px]
    pixels = np.where(np.isfinite(pixels), pixels, middle)
    return np.column_stack([pixels, np.log(np.linalg.norm(centre, axis=1))])


#: Fraction of the target at which the predicted standard deviation counts as sufficient.
ENOUGH_SHARE = 0.9
#: Minimum gain of a new placement, as a fraction of the best placement's gain; a smaller gain adds nothing.
LEAST_SHARE = 0.1
#: Gain of the best placement below which any new placement is accepted.
LEAST_GAIN = 0.02
#: Radius around an unreachable placement.
AVOIDED_M = 0.4
# Relative increase of the cost per metre of walking and per radian of rotation.
_EFFORT = 0.01
# Upper bound of the "captures left" shown to the user.
_MOST_MORE = 60
# Number of captures per reachable placement that approximates infinitely many.
_MANY = 1e4
# Number of best placements for one pair of sensors that are also evaluated for other pairs.
_BEST = 40


class Guidance(NamedTuple):
    """State after some captures, and the next placement of the board.

    Attributes:
        n_captures: number of captures.
        sigma_rotation_deg, sigma_translation_m: predicted standard deviations of the calibration now.
        bound_rotation_deg, bound_translation_m: the same with a margin for few captures, which do not
            reveal their noise; they have to be at most `ENOUGH_SHARE` of the target.
        is_enough: whether the calibration is predicted to meet the profile's target, with a margin.
        n_least: least number of captures.
        n_more: approximate number of further captures; 0 if there are enough, None if unknown.
        T_cam_board: (4, 4) the next placement; None if no reachable placement is new.
    """

    n_captures: int
    sigma_rotation_deg: float
    sigma_translation_m: float
    is_enough: bool
    n_least: int
    bound_rotation_deg: float
    bound_translation_m: float
    n_more: int | None
    T_cam_board: Array | None


class Beside(NamedTuple):
    """Another pair of sensors that may detect the same board.

    Attributes:
        planner: planner of this pair.
        T_other_cam: (4, 4) from the camera's frame to that of its camera.
        held: (N, 4, 4) T_cam_board of its captures, frame of its camera.
    """

    planner: "Planner"
    T_other_cam: Array
    held: Array


class Planner:
    """Chooses placements of the board in front of one camera and one LiDAR.

    Args:
        view: the sensors, and the extrinsics as far as known.
        min_move_m, min_turn_deg: placements moved and rotated by less than this count as the same.
        n_places: number of places of the board's centre that are considered, with eight tilts each.
    """

    def __init__(
        self,
        view: SensorPlace,
        min_move_m: float = MIN_MOVE_M,
        min_turn_deg: float = MIN_TURN_DEG,
        n_places: int = 400,
    ) -> None:
        self.view = view
        self._min_move_m, self._min_turn_rad = min_move_m, np.radians(min_turn_deg)
        poses = spread_candidates(view, n_places)
        self._predictor = Predictor(view.model, view.T_cam_lidar)
        evidence = self._predictor.weigh(poses)
        # Require one ring more than the minimum, as people do not hold the board to the centimetre.
        is_seen = (evidence.n_rings > view.model.limits.min_rings) & (
            evidence.n_points >= view.model.limits.min_points
        )
        self.candidates, self._evidence = poses[is_seen], evidence.of(is_seen)
        # Covariance that further placements cannot reduce; unknown without placements.
        limit = self._predictor.combine(self._evidence, weight=_MANY).without_pattern
        self._limit = limit if len(self.candidates) else np.zeros_like(limit)

    def guide(
        self,
        held: Array,
        present: Array | None = None,
        avoid: Array | None = None,
        beside: Sequence[Beside] = (),
    ) -> Guidance:
        """Predict the standard deviations of the extrinsics, and choose the next placement.

        Args:
            held: (N, 4, 4) T_cam_board of the captures so far; N may be 0.
            present: (4, 4) pose of the board now; of nearly equal placements the nearest is chosen.
            avoid: (M, 4, 4) placements that cannot be reached, or where a sensor does not detect the board;
                those near them are not proposed either.
            beside: other pairs of sensors: of nearly equal placements, the one that also helps them is
                chosen.
        """
        model = self.view.model
        evidence = self._predictor.weigh(held)
        now = self._predictor.combine(evidence)
        after = self._predictor.combine(evidence, self._evidence).without_pattern - self._limit
        cost = shortfall(model, after)
        if present is not None:
            # Add the distance in m and the rotation in rad.
            way_m = np.linalg.norm(self.candidates[:, :3, 3] - present[:3, 3], axis=1)
            turn = np.arccos(np.clip(self.candidates[:, :3, 2] @ present[:3, 2], -1.0, 1.0))
            cost = cost * (1 + _EFFORT * np.asarray(way_m + turn))
        if avoid is not None:
            way_m = np.linalg.norm(avoid[:, None, :3, 3] - self.candidates[:, :3, 3], axis=-1)
            cost[way_m.min(axis=0, initial=np.inf) < AVOIDED_M] = np.inf
        if beside:
            few = np.argsort(cost, kind="stable")[:_BEST]
            for other in beside:
                left = other.planner.shortfall_after(other.held, other.T_other_cam @ self.candidates[few])
                cost[few] -= left.max(initial=0.0) - left
        best = self._choose(cost, held, present)
        wanted = None if best is None else self.candidates[best]
        rotation, translation = sigmas(now.cov)
        n_least = model.limits.min_captures
        improvable = now.without_pattern - self._limit
        bound = sigmas(now.cov + (few_captures_factor(len(held)) - 1) * improvable)
        worse = max(bound[0] / model.target_sigma_rad, bound[1] / model.target_sigma_m)
        return Guidance(
            n_captures=len(held),
            sigma_rotation_deg=float(np.degrees(rotation)),
            sigma_translation_m=float(translation),
            is_enough=bool(len(held) >= n_least and worse <= ENOUGH_SHARE),
            n_least=n_least,
            bound_rotation_deg=float(np.degrees(bound[0])),
            bound_translation_m=float(bound[1]),
            n_more=self._count_more(
                now.cov,
                improvable,
                None if best is None else after[best],
                len(held),
                n_least,
            ),
            T_cam_board=wanted,
        )

    def shortfall_after(self, held: Array, placements: Array) -> Array:
        """Predict the remaining ratio to the target after each further placement, detected or not.

        Args:
            held: (N, 4, 4) T_cam_board of the captures so far.
            placements: (K, 4, 4) T_cam_board.

        Returns:
            (K,) as `evidence.shortfall`.
        """
        model, evidence = self.view.model, self._predictor.weigh(held)
        pixels, is_valid = model.lens.project(
            np.einsum("kij,nj->kni", placements[:, :3, :3], model.board.corners())
            + placements[:, None, :3, 3]
        )
        is_seen = np.all(is_valid & model.lens.is_inside(pixels), axis=1)
        more = self._predictor.weigh(placements)
        is_seen &= (more.n_rings > model.limits.min_rings) & (more.n_points >= model.limits.min_points)
        now = shortfall(model, self._predictor.combine(evidence).without_pattern - self._limit)
        found = np.full(len(placements), float(now))
        if is_seen.any():
            after = self._predictor.combine(evidence, more.of(is_seen)).without_pattern - self._limit
            found[is_seen] = shortfall(model, after)
        return found

    def adds_nothing(
        self,
        held: Array,
        present: Array,
        names: Sequence[str] | None = None,
        avoid: Array | None = None,
        asked: Array | None = None,
    ) -> Refusal | None:
        """Refuse a placement that would hardly reduce the predicted covariance.

        Once the target is predicted to be met, or the best gain is small, only a placement that was captured
        before is refused: a user still collecting wants more captures.

        Args:
            held: (N, 4, 4) T_cam_board of the captures so far.
            present: (4, 4) T_cam_board now.
            names: names of the captures so far; numbers from 1 by default.
            avoid: (M, 4, 4) as `guide` takes them: no board is refused for a better place out of reach.
            asked: (4, 4) placement given to the user; a board there is refused only if captured before.

        Returns:
            The reason and the better placement; None if it adds information.
        """
        guidance = self.guide(held, present, avoid)
        wanted = guidance.T_cam_board
        action = "nowhere" if wanted is None else ""
        instruction = "" if wanted is None else say(instruct(self.view, present, wanted))
        alike = np.flatnonzero(self._is_like(held, present[None])[:, 0])
        if len(alike):
            name = str(alike[0] + 1) if names is None else names[alike[0]]
            return CALIBRATE_KNOWN_PLACEMENT.refusal(action=action, capture=name, instruction=instruction)
        is_asked = asked is not None and is_there(self.view, present, asked)
        if wanted is None or guidance.is_enough or is_asked:
            return None
        # Fraction of the improvable covariance that the present and the target placement remove.
        placements = np.stack([present, wanted])
        model, evidence = self.view.model, self._predictor.weigh(held)
        now = self._predictor.combine(evidence).without_pattern
        after = self._predictor.combine(evidence, self._predictor.weigh(placements)).without_pattern
        gain, best = np.asarray(
            1 - shortfall(model, after - self._limit) / shortfall(model, now - self._limit)
        )
        if best < LEAST_GAIN or gain >= LEAST_SHARE * best:
            return None
        gains = {"gain": max(float(gain), 0.0), "best_gain": float(best)}
        return CALIBRATE_LITTLE_GAIN.refusal(instruction=instruction, **gains)

    def _count_more(
        self, cov: Array, improvable: Array, then: Array | None, n_captures: int, n_least: int
    ) -> int | None:
        """Estimate how many more captures are needed if each adds as much information as the next one.

        Args:
            cov: (6, 6) predicted now.
            improvable: (6, 6) the part of it that captures can shrink.
            then: (6, 6) that part after the next capture; None if no placement is new.
            n_captures: number of captures so far.
            n_least: minimum number of captures.
        """
        model = self.view.model
        targets = np.square(ENOUGH_SHARE * np.array([model.target_sigma_rad, model.target_sigma_m]))
        # Errors common to all captures do not decrease.
        constant = np.square(sigmas(cov - improvable))
        before, after = (
            1 / np.maximum(np.square(sigmas(s)), 1e-18)
            for s in (improvable, improvable if then is None else then)
        )
        for n_more in range(max(n_least - n_captures, 0), _MOST_MORE):
            remaining = 1 / (before + n_more * np.maximum(after - before, 0.0))
            if np.all(few_captures_factor(n_captures + n_more) * remaining + constant <= targets):
                return n_more
        return None

    def _choose(self, cost: Array, held: Array, present: Array | None) -> int | None:
        """Choose the new candidate of lowest finite cost; None if there is none."""
        is_taken = self._is_like(held, self.candidates).any(axis=0)
        new = np.flatnonzero(~is_taken & np.isfinite(cost))
        if not len(new):
            return None
        ranked = new[np.argsort(cost[new], kind="stable")]
        if present is None or not self._is_like(held, present[None]).any():
            return int(ranked[0])
        # Move the board away from captured placements, not to one with the instruction "hold still".
        away = (k for k in ranked if not is_there(self.view, present, self.candidates[k]))
        return int(next(away, ranked[0]))

    def _is_like(self, held: Array, others: Array) -> NDArray[np.bool_]:
        """Check which of the other poses (M, 4, 4) match which of the captured poses (N, 4, 4): (N, M)."""
        return find_alike(held, others, self._min_move_m, self._min_turn_rad)


_FEWEST, _MOST = 2, 6
# Minimum ratio of distances at which boards are described as near and far.
_FAR = 1.4
# Default T_cam_lidar: a LiDAR beside the camera, facing the same way; accurate enough to place a board.
_SAME_WAY = T_BODY_OPTICAL.T


def plan_captures(
    rig: Rig, camera: str, lidar: str, held: Array, calibration: Calibration | None = None
) -> list[Finding]:
    """Plan the captures to add: each reduces the uncertainty most, given the ones before it.

    The plan ends when the predicted standard deviations, scaled to those of the calibration, meet the
    profile's target.

    Args:
        rig: the profile.
        camera, lidar: the sensors.
        held: (N, 4, 4) T_cam_board of the captures so far.
        calibration: their result; None without one.

    Returns:
        The plan; empty if the LiDAR's beams are unknown, or no new placement is left.
    """
    try:
        model = SensorModel.of(rig, camera, lidar)
    except ProfileError:
        return []
    nominal = rig.nominal(camera, lidar)
    T_cam_lidar = _SAME_WAY if nominal is None else nominal.to_matrix()
    if calibration is not None:
        T_cam_lidar = calibration.T_cam_lidar
    planner, wanted, needed = Planner(SensorPlace(model, T_cam_lidar)), held, rig.calibration
    guidance = planner.guide(held)
    # Ratio of the calibration's standard deviations to the predicted ones.
    ratios = np.ones(2)
    if calibration is not None:
        stated = np.array([calibration.sigma_rotation_deg, calibration.sigma_translation_m])
        ratios = np.maximum(stated / [guidance.sigma_rotation_deg, guidance.sigma_translation_m], 1.0)
    is_enough = False
    while guidance.T_cam_board is not None and len(wanted) < len(held) + _MOST and not is_enough:
        wanted = np.concatenate([wanted, guidance.T_cam_board[None]])
        guidance = planner.guide(wanted)
        sigmas = ratios * [guidance.sigma_rotation_deg, guidance.sigma_translation_m]
        is_met = guidance.is_enough if calibration is None else needed.in_targets(*sigmas) <= ENOUGH_SHARE
        is_enough = bool(is_met and len(wanted) >= max(rig.quality.min_captures, len(held) + _FEWEST))
    added = wanted[len(held) :]
    if not len(added):
        return []
    return [GUIDE_ADD(n_captures=len(added), is_enough=is_enough, placements=_describe(planner.view, added))]


def _describe(view: SensorPlace, poses: Array) -> tuple[tuple[int, float, str, tuple[str, ...]], ...]:
    """Describe boards (N, 4, 4) in a near and a far group.

    Returns:
        For each group the number, the mean distance in m, its place in the image if not central, and the
        directions that boards face, as seen by the person holding them.
    """
    ordered = poses[np.argsort(np.linalg.norm(poses[:, :3, 3], axis=1))]
    distance_m = np.linalg.norm(ordered[:, :3, 3], axis=1)
    gaps = distance_m[1:] / distance_m[:-1]
    parts = [ordered]
    if distance_m[-1] >= _FAR * distance_m[0]:
        parts = np.split(ordered, [int(np.argmax(gaps)) + 1])
    groups = []
    for part in parts:
        sides: dict[str, None] = {}
        for T_cam_board in part:
            held = describe_pose(view, T_cam_board)
            leans = {"down": held.tilt_deg, "up": -held.tilt_deg}
            leans |= {"right": held.turn_deg, "left": -held.turn_deg}
            side = max(leans, key=lambda name: leans[name])
            if leans[side] > LEANS_DEG:
                sides[side] = None
        mean_m = round(float(np.linalg.norm(part[:, :3, 3], axis=1).mean()), 1)
        groups.append((len(part), mean_m, common_third(view.model.lens, part[:, :3, 3]), tuple(sides)))
    return tuple(groups)


def common_third(lens: Intrinsics, centres: Array) -> str:
    """Name the outer third of the image that contains all boards; "" for none.

    Args:
        lens: intrinsics of the camera.
        centres: (N, 3) of the boards, camera frame, m.
    """
    pixels, _ = lens.project(centres)
    x, y = (pixels / [lens.width_px, lens.height_px]).T
    # The person faces the rig, so the image's right is on the person's left.
    for word, share in (("high", y), ("low", 1 - y), ("on your right", x), ("on your left", 1 - x)):
        if share.max() < 1 / 3:
            return word
    return ""
