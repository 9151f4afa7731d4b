"""Matching of LiDAR candidates and camera poses of each capture.

A scan may contain decoys of the board's size, and an image of a plane two poses. Wrong pairs agree with no
rigid transform, right ones all with the same. Distances and angles between two boards are the same in both
sensors (1), for any extrinsics, which already excludes most wrong pairs. The pairs that agree with each other
form a graph. The edges in the most triangles each propose extrinsics (Wahba on both normals and the line
between the centres), the proposals are scored by all captures, and the best is refined on the pairs that
agree with it.

The only assumption about the mounting is that both sensors see the same side of the board.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from lce_rig.calibrate.algorithm_1.registration import rotation_from_directions
from lce_rig.calibrate.findings import ELSEWHERE, FEW_AGREE, FEW_CAPTURES
from lce_rig.core.board import Board
from lce_rig.core.errors import NotEnoughDataError
from lce_rig.core.findings import Refusal
from lce_rig.core.geometry import Array, pose
from lce_rig.core.results import BoardPose, Observation

# Three planes determine six unknowns.
_MIN_CAPTURES = 3
NORMAL_TOLERANCE_RAD = np.radians(12.0)
CENTRE_TOLERANCE_M = 0.15
_N_PROPOSALS = 400
_N_REFINEMENTS = 10
_MOVED_M = 0.1
# Above this, the image alone excludes the second pose, whatever the error of the camera model.
_MAX_CHI2_GAP = 100.0


@dataclass(frozen=True, eq=False)
class Consensus:
    """The pairs that agree with one rigid transform.

    Attributes:
        T_cam_lidar: (4, 4) rough extrinsics from normals and centres.
        observations: one per agreeing capture, sorted by name.
        refused: why each other capture is rejected.
    """

    T_cam_lidar: Array
    observations: tuple[Observation, ...]
    refused: dict[str, Refusal]


@dataclass(frozen=True, eq=False)
class _Pairs:
    """Every combination of a camera pose and a LiDAR candidate of the same capture.

    Attributes:
        capture, pose, candidate: (P,) indices; pose 0 is the image's first choice.
        normal_cam, normal_lidar: (P, 3).
        centre_cam, centre_lidar: (P, 3) m.
    """

    capture: NDArray[np.intp]
    pose: NDArray[np.intp]
    candidate: NDArray[np.intp]
    normal_cam: Array
    normal_lidar: Array
    centre_cam: Array
    centre_lidar: Array


def find_consensus(candidates: Sequence[Observation], board: Board) -> Consensus:
    """Choose the pairs that agree with one rigid transform.

    Args:
        candidates: one per capture, in any order, with all places in the scan where the board may be.
        board: the board's size sets the scale at which an angle weighs as much as a distance.

    Raises:
        NotEnoughDataError: too few captures, or captures that agree with no extrinsics.
    """
    n_captures, needed = len(candidates), _MIN_CAPTURES
    if n_captures < needed:
        raise NotEnoughDataError.of(FEW_CAPTURES(n_captures=n_captures, n_needed=needed))
    candidates = sorted(candidates, key=lambda item: item.capture)
    pairs = _list_pairs(candidates)
    proposals = _propose(pairs, _agreement(pairs), scale_m=np.hypot(board.width_m, board.height_m) / 2)
    if proposals is None:
        raise NotEnoughDataError.of(FEW_AGREE(n_agreeing=0, n_captures=n_captures, n_needed=needed))
    R, t = proposals
    scores = np.concatenate([_score(pairs, R[i : i + 64], t[i : i + 64])[0] for i in range(0, len(R), 64)])
    best = int(np.argmax(scores))
    R_best, t_best, chosen = _refine(pairs, R[best], t[best], n_captures)
    n_agreeing = int(np.count_nonzero(chosen >= 0))
    if n_agreeing < needed:
        raise NotEnoughDataError.of(FEW_AGREE(n_agreeing=n_agreeing, n_captures=n_captures, n_needed=needed))

    observations, refused = [], {}
    angle, distance = (values[0] for values in _misfit(pairs, R_best[None], t_best[None]))
    r2 = (angle / NORMAL_TOLERANCE_RAD) ** 2 + (distance / CENTRE_TOLERANCE_M) ** 2
    for k, item in enumerate(candidates):
        if chosen[k] >= 0:
            is_alternative = pairs.pose[chosen[k]] == 1
            T_cam_board = open_poses(item.pose)[pairs.pose[chosen[k]]]
            board_pose = replace(item.pose, T_cam_board=T_cam_board) if is_alternative else item.pose
            surface = item.places[pairs.candidate[chosen[k]]]
            observations.append(replace(item, pose=board_pose, surface=surface, others=()))
        else:
            rows = np.flatnonzero(pairs.capture == k)
            nearest = rows[np.argmin(r2[rows])]
            refused[item.capture] = ELSEWHERE.refusal(
                n_candidates=len(item.places),
                candidate=int(pairs.candidate[nearest]),
                distance_m=float(distance[nearest]),
                rotation_deg=float(np.degrees(angle[nearest])),
                action="hold_still" if distance[nearest] > _MOVED_M else "",
            )
    return Consensus(pose(R_best, t_best), tuple(observations), refused)


def agrees_with(item: Observation, T_cam_lidar: Array) -> bool:
    """Check whether a camera pose and a candidate of one capture agree with extrinsics (4, 4)."""
    _, r2 = _score(_list_pairs([item]), T_cam_lidar[None, :3, :3], T_cam_lidar[None, :3, 3])
    return bool(r2.min() < 1)


def open_poses(seen: BoardPose) -> list[Array]:
    """List the poses (4, 4) of the board that the first sensor cannot distinguish."""
    if seen.T_cam_board_alternative is None or seen.chi2_gap > _MAX_CHI2_GAP:
        return [seen.T_cam_board]
    return [seen.T_cam_board, seen.T_cam_board_alternative]


def _list_pairs(candidates: Sequence[Observation]) -> _Pairs:
    index = [
        (k, p, c)
        for k, item in enumerate(candidates)
        for p in range(len(open_poses(item.pose)))
        for c in range(len(item.places))
    ]
    T_cam = np.array([open_poses(candidates[k].pose)[p] for k, p, _ in index])
    surfaces = [candidates[k].places[c] for k, _, c in index]
    columns = np.array(index, dtype=np.intp)
    return _Pairs(
        capture=columns[:, 0],
        pose=columns[:, 1],
        candidate=columns[:, 2],
        normal_cam=T_cam[:, :3, 2],
        normal_lidar=np.array([board.plane[:3] for board in surfaces]),
        centre_cam=T_cam[:, :3, 3],
        centre_lidar=np.array([board.T_lidar_board[:3, 3] for board in surfaces]),
    )


def _agreement(pairs: _Pairs) -> NDArray[np.float32]:
    """Return which pairs (P, P) preserve angles and distances between their boards, (1)."""
    angles, along, lengths = [], [], []
    for normals, centres in ((pairs.normal_cam, pairs.centre_cam), (pairs.normal_lidar, pairs.centre_lidar)):
        baseline = centres[None] - centres[:, None]
        angles.append(np.arccos(np.clip(normals @ normals.T, -1, 1)))
        lengths.append(np.linalg.norm(baseline, axis=-1))
        along.append(np.einsum("ijk,ik->ij", baseline, normals))
    agrees = np.abs(angles[0] - angles[1]) < NORMAL_TOLERANCE_RAD
    agrees &= np.abs(lengths[0] - lengths[1]) < CENTRE_TOLERANCE_M
    # The height of one board above the other's plane also depends on the error of the angle between the
    # planes.
    height_tolerance = CENTRE_TOLERANCE_M + np.maximum(*lengths) * np.sin(NORMAL_TOLERANCE_RAD)
    is_level = np.abs(along[0] - along[1]) < height_tolerance
    agrees &= is_level & is_level.T
    agrees &= pairs.capture[:, None] != pairs.capture[None]
    return np.asarray(agrees, dtype=np.float32)


def _propose(pairs: _Pairs, agreement: NDArray[np.float32], scale_m: float) -> tuple[Array, Array] | None:
    """Propose extrinsics R (H, 3, 3), t (H, 3) from the two-pair agreements in the most triangles."""
    triangles = np.triu((agreement @ agreement) * agreement)
    order = np.argsort(-triangles, axis=None, kind="stable")[:_N_PROPOSALS]
    i, j = np.unravel_index(order[triangles.ravel()[order] > 0], triangles.shape)
    if len(i) == 0:
        return None
    directions = [
        np.stack([normals[i], normals[j], (centres[j] - centres[i]) / scale_m], axis=1)
        for normals, centres in (
            (pairs.normal_cam, pairs.centre_cam),
            (pairs.normal_lidar, pairs.centre_lidar),
        )
    ]
    R = rotation_from_directions(directions[0], directions[1])
    middle_cam = (pairs.centre_cam[i] + pairs.centre_cam[j]) / 2
    middle_lidar = (pairs.centre_lidar[i] + pairs.centre_lidar[j]) / 2
    return R, middle_cam - (R @ middle_lidar[..., None])[..., 0]


def _misfit(pairs: _Pairs, R: Array, t: Array) -> tuple[Array, Array]:
    """Compute angles between normals in rad and distances of centres in m, (H, P) each."""
    normals = pairs.normal_lidar @ np.swapaxes(R, -1, -2)
    centres = pairs.centre_lidar @ np.swapaxes(R, -1, -2) + t[:, None]
    angle = np.arccos(np.clip(np.sum(normals * pairs.normal_cam, axis=-1), -1, 1))
    return angle, np.linalg.norm(centres - pairs.centre_cam, axis=-1)


def _score(pairs: _Pairs, R: Array, t: Array) -> tuple[Array, Array]:
    """Score hypotheses (H,) by the sum of max(0, 1 - r^2) of each capture's best pair.

    Returns:
        The scores (H,) and the squared normalised misfits r^2 of all pairs (H, P).
    """
    angle, distance = _misfit(pairs, R, t)
    r2 = (angle / NORMAL_TOLERANCE_RAD) ** 2 + (distance / CENTRE_TOLERANCE_M) ** 2
    first = np.flatnonzero(np.r_[True, np.diff(pairs.capture) > 0])
    best = np.minimum.reduceat(r2, first, axis=-1)
    return np.asarray(np.sum(np.maximum(1 - best, 0), axis=-1)), r2


def _refine(pairs: _Pairs, R: Array, t: Array, n_captures: int) -> tuple[Array, Array, NDArray[np.intp]]:
    """Fit R and t to the agreeing pairs until stable; return also the pair of each capture, or -1."""
    chosen = np.full(n_captures, -1, dtype=np.intp)
    for _ in range(_N_REFINEMENTS):
        _, r2 = _score(pairs, R[None], t[None])
        order = np.lexsort((r2[0], pairs.capture))
        captures, first = np.unique(pairs.capture[order], return_index=True)
        best = order[first]
        agreeing = r2[0, best] < 1
        before, chosen = chosen, np.full(n_captures, -1, dtype=np.intp)
        chosen[captures[agreeing]] = best[agreeing]
        used = chosen[chosen >= 0]
        if len(used) < 2 or np.array_equal(before, chosen):
            break
        mean_cam, mean_lidar = pairs.centre_cam[used].mean(axis=0), pairs.centre_lidar[used].mean(axis=0)
        ratio = NORMAL_TOLERANCE_RAD / CENTRE_TOLERANCE_M
        R = rotation_from_directions(
            np.concatenate([pairs.normal_cam[used], ratio * (pairs.centre_cam[used] - mean_cam)]),
            np.concatenate([pairs.normal_lidar[used], ratio * (pairs.centre_lidar[used] - mean_lidar)]),
        )
        t = mean_cam - R @ mean_lidar
    return R, t, chosen
