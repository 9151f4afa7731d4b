"""Two LiDARs that saw the same boards: agreeing captures, and the initial guess of the relative pose.

    place_boards      maximum-likelihood poses of the boards from each LiDAR alone, with its constant errors
    find_consensus    the captures that agree on one rigid transform
    solve             Algorithm 1: the outliers, and where the estimate (`rig_estimate`) starts

The boards' poses by the first LiDAR are compared with the second one's points and ring ends.

A plate without a pattern looks the same rotated by 180 deg, a square one by 90 deg. Normals and middles of
several boards determine T_12 despite this ambiguity, which is then resolved for each capture.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from lce_rig.calibrate.algorithm_1.algorithm import solve
from lce_rig.calibrate.consensus import find_consensus
from lce_rig.calibrate.findings import FEW_AGREE, TURNED
from lce_rig.calibrate.likelihood.fit import JointEstimate, fit_boards, maximise_likelihood
from lce_rig.calibrate.likelihood.layout import OWN
from lce_rig.calibrate.likelihood.levels import what_is_known
from lce_rig.calibrate.likelihood.rays import lens_fields
from lce_rig.calibrate.options import EstimateSettings
from lce_rig.calibrate.result import Start
from lce_rig.core.board import Board
from lce_rig.core.errors import NotEnoughDataError
from lce_rig.core.geometry import (
    Array,
    difference,
    exp_so3,
    pose,
    rotation_angle,
)
from lce_rig.core.results import BoardPose, LidarBoard, Observation

# Largest relative difference of a plate's sides at which a rotation by 90 deg is ambiguous.
_NEARLY_SQUARE = 0.1
# Largest rotation of the board about its normal between the scans, rad; above it, one shows another object.
_MOST_TURN_RAD = np.radians(15.0)


@dataclass(frozen=True, eq=False)
class PlacedBoards:
    """Poses of F boards estimated from the scans of one LiDAR alone.

    Attributes:
        T: (F, 4, 4) T_lidar_board.
        cov: (F, 6, 6) of each pose by errors that differ between captures, tangent (translation m, rotation
            rad).
        joint: the estimate that contains them.
    """

    T: Array
    cov: Array
    joint: JointEstimate


class LidarPair(NamedTuple):
    """Two LiDARs, relative to an optical frame of the first.

    Attributes:
        start: pose of the second by Algorithm 1, with the captures that agree.
        boards: boards in both scans, by capture.
        alone: estimate of the boards by each LiDAR alone.
        joint: the same from the first LiDAR's poses, only to judge whether mountings changed.
        rejected: the other captures in which both see a plate.
        T_view: (4, 4) T_optical_first.
    """

    start: Start
    boards: Mapping[str, tuple[LidarBoard, LidarBoard]]
    alone: tuple[JointEstimate, JointEstimate]
    joint: JointEstimate
    rejected: Sequence[Observation]
    T_view: Array


def place_boards(lidars: Sequence[LidarBoard], board: Board, settings: EstimateSettings) -> PlacedBoards:
    """Estimate the poses of the boards relative to the points that one LiDAR's driver reports.

    Args:
        lidars: the board in the scans of F captures.
        board: the plate.
        settings: the profile's settings of this LiDAR.
    """
    joint = fit_boards(lidars, board, *what_is_known(settings))
    state, pose_of = joint.state, OWN["pose"]
    # The points lie where the driver puts them, displaced by the lens (`likelihood.rays`).
    T = state.T_lidar_board.copy()
    T[:, :3, 3] += lens_fields(T[:, :3, 3]) @ state.z[state.layout.z["lens"]]
    of_own = np.asarray(np.linalg.inv(joint.reduced.of_own), dtype=np.float64)
    return PlacedBoards(T, of_own[:, pose_of, pose_of], joint)


def match_lidars(
    candidates: Sequence[Observation],
    first: Mapping[str, Sequence[LidarBoard]],
    board: Board,
    settings: tuple[EstimateSettings, EstimateSettings],
) -> LidarPair:
    """Find the captures that agree on the pose of the second LiDAR in an optical frame of the first.

    The optical frame has the first LiDAR's origin, z level towards the boards and y down.

    Args:
        candidates: one per capture with the board in both scans; the first LiDAR's poses in its own frame.
        first: places in its scan where the board may be, by capture.
        board: the plate.
        settings: the profile's settings of each LiDAR.

    Raises:
        NotEnoughDataError: too few captures, captures that agree with no extrinsics, or captures that leave a
            direction undetermined, which is named.
    """
    consensus = find_consensus(candidates, board)
    agreed = consensus.observations
    one = place_boards([_board_of(o, first[o.capture]) for o in agreed], board, settings[0])
    T_view = optical_frame(one.T[:, :3, 3])
    R = np.kron(np.eye(2), T_view[:3, :3])
    one = replace(one, T=T_view @ one.T, cov=R @ one.cov @ R.T)
    seen, refused, observations = {}, dict(consensus.refused), []
    for o in candidates:
        if o.capture in refused:
            # Estimate this LiDAR alone: another plate would distort the errors that all captures share.
            alone = place_boards([_board_of(o, first[o.capture])], board, settings[0])
            seen[o.capture] = _with_pose(o, T_view @ alone.T[0], R @ alone.cov[0] @ R.T)
    for o, T, cov in zip(agreed, one.T, one.cov, strict=True):
        seen[o.capture] = o = _with_pose(o, T, cov)
        turn, spin_rad = _turn_alike(T, T_view @ consensus.T_cam_lidar @ o.lidar.T_lidar_board, board)
        if spin_rad > _MOST_TURN_RAD:
            refused[o.capture] = TURNED.refusal(rotation_deg=float(np.degrees(spin_rad)))
            continue
        lidar = replace(o.lidar, T_lidar_board=o.lidar.T_lidar_board @ turn)
        observations.append(replace(o, surface=lidar))
    if len(observations) < len(agreed) / 2:
        raise NotEnoughDataError.of(
            FEW_AGREE(n_agreeing=len(observations), n_captures=len(candidates), n_needed=len(agreed))
        )
    start = solve(observations, board)
    start = replace(start, refused=refused | dict(start.refused))
    used = {o.capture: o.lidar for o in start.observations}
    other = place_boards(list(used.values()), board, settings[1])
    boards = {
        o.capture: (_board_of(o, first[o.capture]), used[o.capture]) for o in agreed if o.capture in used
    }
    joint = maximise_likelihood(
        [start.observations], board, [start.T_cam_lidar], other.joint.priors, other.joint.levels
    )
    rejected = [seen[name] for name in sorted(seen.keys() - used.keys())]
    return LidarPair(start, boards, (one.joint, other.joint), joint, rejected, T_view)


def optical_frame(middles: Array) -> Array:
    """Rotate the axes of a LiDAR (x forward, z up) to a camera's (z forward, y down) facing the boards.

    Args:
        middles: (F, 3) middles of the boards, frame of the LiDAR.

    Returns:
        T_optical_lidar (4, 4).
    """
    towards = np.append(middles[:, :2].sum(axis=0), 0.0)
    length = float(np.linalg.norm(towards))
    forward = towards / length if length > 0 else np.array([1.0, 0.0, 0.0])
    down = np.array([0.0, 0.0, -1.0])
    return pose(np.stack([np.cross(down, forward), down, forward]), np.zeros(3))


def _board_of(observation: Observation, places: Sequence[LidarBoard]) -> LidarBoard:
    """Choose the candidate in the first LiDAR's scan that an observation is based on."""
    middle = observation.pose.T_cam_board[:3, 3]
    return min(places, key=lambda each: float(np.linalg.norm(each.T_lidar_board[:3, 3] - middle)))


def _with_pose(observation: Observation, T: Array, cov: Array) -> Observation:
    return replace(observation, pose=BoardPose(T, cov, None, np.inf))


def _turn_alike(T: Array, other: Array, board: Board) -> tuple[Array, float]:
    """Choose the rotation (4, 4) about the plate's normal that brings pose `other` closest to T (4, 4).

    Returns:
        The rotation, and the remaining angle about the normal, rad.
    """
    sides = board.width_m, board.height_m
    n_fold = 4 if max(sides) < (1 + _NEARLY_SQUARE) * min(sides) else 2
    steps = 2 * np.pi / n_fold * np.arange(n_fold)
    turns = pose(exp_so3(steps[:, None] * np.array([0.0, 0.0, 1.0])), np.zeros((n_fold, 3)))
    turn = turns[int(np.argmin(rotation_angle(T[:3, :3], (other @ turns)[:, :3, :3])))]
    return turn, abs(float(difference(other @ turn, T)[3:] @ T[:3, 2]))
