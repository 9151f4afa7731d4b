"""The pose of two LiDARs to each other, from boards that both see; no camera takes part.

    place_boards      the boards' poses by each LiDAR alone, of maximum likelihood, with its constant errors
    find_consensus    the captures that agree on one rigid transform
    solve             Algorithm 1: the outliers, and where the estimate starts
    below             poses of both LiDARs of maximum likelihood

The first LiDAR takes the camera's place: the boards' poses in its scans are what the poses in images are to
a camera. Its points keep their errors common to all captures, which the extrinsics share. With T_1 and T_2 a
board's poses, x the tangent of T_12, e their errors and d the constant errors of unit variance that both
LiDARs have in all captures,

    log(T_12 T_2 T_1^-1) = A x + B (S_2 d_2 + e_2) - (S_1 d_1 + e_1)                                     (1)

whose squares in units of cov(e_1) + B cov(e_2) B^T are least, with d^2 added.

A plate without print looks the same turned by 180 deg, a square one by 90 deg. Normals and middles of several
boards decide T_12 without that turn, which then follows by capture.
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
from lce_rig.calibrate.observations import group_placements
from lce_rig.calibrate.options import EstimateSettings
from lce_rig.calibrate.quadratics import Quadratics, jackknife_scatter
from lce_rig.calibrate.result import CalibrationEstimate, Start, report, with_parts
from lce_rig.calibrate.uncertainty import widen
from lce_rig.core.board import Board
from lce_rig.core.errors import NotEnoughDataError
from lce_rig.core.geometry import (
    Array,
    composition_slopes,
    difference,
    exp_so3,
    perturb,
    pose,
    rotation_angle,
    skew,
)
from lce_rig.core.results import LidarBoard, Observation

# Plates whose sides differ by less than this share look the same turned by 90 deg.
_NEARLY_SQUARE = 0.1
# A board in the two scans may differ by so much about its normal; more is another thing of its size.
_MOST_TURN_RAD = np.radians(15.0)
_STEPS = 5
# Captures farther off than this many standard deviations, or medians of all, count less than in full (Huber).
_HUBER = 1.5
# A lens, lateral and vertical, follows from how ring ends shear an oblique plate. Errors of their model that
# all boards share, and that no scatter shows, displaced it by so much in simulated sessions of an OS1-64.
_LENS_ERROR_M = np.array([0.0025, 0.0015])
# Conditions of loops that follow from the other loops.
_REDUNDANT = 1e-9
# Constant errors that move no pose by more than this share of the largest are left out.
_NEGLIGIBLE = 1e-3


@dataclass(frozen=True, eq=False)
class PlacedBoards:
    """Poses of F boards by one LiDAR alone.

    Attributes:
        T: (F, 4, 4) T_lidar_board.
        cov: (F, 6, 6) of each, tangent (translation m, rotation rad): of errors that differ between captures.
        shared: (F, 6, m) tangents by m independent errors of unit variance, common to all captures.
        joint: the estimate they are of.
    """

    T: Array
    cov: Array
    shared: Array
    joint: JointEstimate


class PairEstimate(NamedTuple):
    """Two LiDARs' pose to each other, in an optical frame of the first.

    Attributes:
        estimate: of T_optical_second.
        rejected: the other captures in which both see a plate.
        T_view: (4, 4) T_optical_first.
    """

    estimate: CalibrationEstimate
    rejected: Sequence[Observation]
    T_view: Array


def place_boards(lidars: Sequence[LidarBoard], board: Board, settings: EstimateSettings) -> PlacedBoards:
    """Estimate the poses of the boards in the scans of one LiDAR, for points as its driver gives them.

    Args:
        lidars: of F captures.
        board: the plate.
        settings: what the profile says of this LiDAR.
    """
    joint = fit_boards(lidars, board, *what_is_known(settings))
    state, reduced, pose_of = joint.state, joint.reduced, OWN["pose"]
    by_errors = -reduced.own_steps[:, pose_of, :-1]
    # The points lie where the driver puts them, displaced by the lens (`likelihood.rays`).
    T, lens = state.T_lidar_board.copy(), state.layout.z["lens"]
    fields = lens_fields(T[:, :3, 3])
    T[:, :3, 3] += fields @ state.z[lens]
    by_errors[:, :3, lens] += fields
    shared = by_errors @ np.linalg.cholesky(reduced.cost.covariance())
    shared = np.concatenate([shared, by_errors[:, :, lens] * _LENS_ERROR_M], axis=2)
    values, vectors = np.linalg.eigh(np.einsum("fij,fik->jk", shared, shared))
    kept = vectors[:, values > _NEGLIGIBLE**2 * values[-1]]
    of_own = np.asarray(np.linalg.inv(reduced.of_own), dtype=np.float64)
    return PlacedBoards(T, of_own[:, pose_of, pose_of], np.asarray(shared @ kept), joint)


def estimate_between_lidars(
    candidates: Sequence[Observation],
    first: Mapping[str, Sequence[LidarBoard]],
    board: Board,
    settings: tuple[EstimateSettings, EstimateSettings],
) -> PairEstimate:
    """Estimate the pose of the second LiDAR in an optical frame of the first.

    The optical frame has the first LiDAR's origin, z level towards the boards and y down: for all checks,
    the first LiDAR is a camera.

    Args:
        candidates: of each capture with the board in both scans; the first LiDAR's are the images' poses, in
            its own frame.
        first: by capture the places in its scan where the board may be.
        board: the plate.
        settings: what the profile says of each LiDAR.

    Raises:
        NotEnoughDataError: too few captures, captures that agree with no extrinsics, or captures that leave a
            direction undetermined, which is named.
    """
    consensus = find_consensus(candidates, board)
    agreed = consensus.observations
    one = place_boards([_board_of(o, first[o.capture]) for o in agreed], board, settings[0])
    T_view = optical_frame(one.T[:, :3, 3])
    R = np.kron(np.eye(2), T_view[:3, :3])
    one = replace(one, T=T_view @ one.T, cov=R @ one.cov @ R.T, shared=R @ one.shared)
    seen, refused, observations = {}, dict(consensus.refused), []
    for o in candidates:
        if o.capture in refused:
            # Alone: another plate would bend the errors that all captures share.
            alone = place_boards([_board_of(o, first[o.capture])], board, settings[0])
            seen[o.capture] = _with_pose(o, T_view @ alone.T[0], R @ alone.cov[0] @ R.T)
    for o, T, cov in zip(agreed, one.T, one.cov, strict=True):
        seen[o.capture] = o = _with_pose(o, T, cov)
        turn, spin_rad = _turn_alike(T, T_view @ consensus.T_cam_lidar @ o.lidar.T_lidar_board, board)
        if spin_rad > _MOST_TURN_RAD:
            refused[o.capture] = TURNED.refusal(rotation_deg=float(np.degrees(spin_rad)))
            continue
        lidar = replace(o.lidar, T_lidar_board=o.lidar.T_lidar_board @ turn)
        observations.append(replace(o, lidar=lidar))
    if len(observations) < len(agreed) / 2:
        raise NotEnoughDataError.of(
            FEW_AGREE(n_agreeing=len(observations), n_captures=len(candidates), n_needed=len(agreed))
        )
    start = solve(observations, board)
    start = replace(start, refused=refused | dict(start.refused))
    used = {o.capture for o in start.observations}
    is_used = [o.capture in used for o in agreed]
    one = replace(one, T=one.T[is_used], cov=one.cov[is_used], shared=one.shared[is_used])
    other = place_boards([o.lidar for o in start.observations], board, settings[1])
    estimate = _fit_poses(start, one, other, board)
    return PairEstimate(estimate, [seen[name] for name in sorted(seen.keys() - used)], T_view)


def close_loops(edges: Mapping[tuple[str, str], tuple[Array, Array]]) -> dict[tuple[str, str], Array]:
    """Adjust poses by least squares so that every loop of three sensors closes: T_ab T_bc = T_ac.

        v = -C A^T (A C A^T)^+ r                                                                         (2)

    with r the tangents by which the loops are open, A their derivatives and C the poses' covariances. The
    estimates share boards. If their errors were those of the boards' poses alone, the loops would be closed
    and nothing would move; correlation makes r smaller, so that (2) never moves a pose too far.

    Args:
        edges: T_ab (4, 4) and its covariance (6, 6), by the names of a and b.

    Returns:
        T_ab of each edge that is part of a loop.
    """
    names = sorted(edges)
    loops = [((a, b), (b, c), (a, c)) for a, b in names for d, c in names if d == b and (a, c) in edges]
    poses = {name: T for name, (T, _) in edges.items()}
    start, C = dict(poses), np.zeros((6 * len(names), 6 * len(names)))
    for k, name in enumerate(names):
        C[6 * k : 6 * k + 6, 6 * k : 6 * k + 6] = edges[name][1]
    for _ in range(_STEPS if loops else 0):
        A, r = np.zeros((6 * len(loops), len(C))), np.zeros(6 * len(loops))
        for k, (ab, bc, ac) in enumerate(loops):
            rows = slice(6 * k, 6 * k + 6)
            r[rows] = difference(poses[ab] @ poses[bc], poses[ac])
            slopes = (*composition_slopes(poses[ab], poses[bc]), -np.eye(6))
            for name, J in zip((ab, bc, ac), slopes, strict=True):
                place = 6 * names.index(name)
                A[rows, place : place + 6] += J
        # The linearised conditions hold for the distance from the estimates, not from the last step.
        moved = np.concatenate([difference(poses[name], start[name]) for name in names])
        v = -C @ A.T @ np.linalg.pinv(A @ C @ A.T, rcond=_REDUNDANT, hermitian=True) @ (r - A @ moved)
        poses = {name: perturb(start[name], v[6 * k : 6 * k + 6]) for k, name in enumerate(names)}
    return {name: poses[name] for loop in loops for name in loop}


def optical_frame(middles: Array) -> Array:
    """Turn the axes of a LiDAR (x forward, z up) into a camera's (z forward, y down) that looks at boards.

    Args:
        middles: (F, 3) of the boards, frame of the LiDAR.

    Returns:
        T_optical_lidar (4, 4).
    """
    towards = np.append(middles[:, :2].sum(axis=0), 0.0)
    length = float(np.linalg.norm(towards))
    forward = towards / length if length > 0 else np.array([1.0, 0.0, 0.0])
    down = np.array([0.0, 0.0, -1.0])
    return pose(np.stack([np.cross(down, forward), down, forward]), np.zeros(3))


def _board_of(observation: Observation, places: Sequence[LidarBoard]) -> LidarBoard:
    """Choose the place in the first LiDAR's scan whose pose an observation has as the image's."""
    middle = observation.image.T_cam_board[:3, 3]
    return min(places, key=lambda each: float(np.linalg.norm(each.T_lidar_board[:3, 3] - middle)))


def _with_pose(observation: Observation, T: Array, cov: Array) -> Observation:
    image = replace(observation.image, T_cam_board=T, cov=cov, T_cam_board_alternative=None)
    return replace(observation, image=image)


def _turn_alike(T: Array, other: Array, board: Board) -> tuple[Array, float]:
    """Choose the turn (4, 4) about the plate's normal that brings a pose `other` next to T (4, 4).

    Returns:
        The turn, and the angle about the normal that is left, rad.
    """
    sides = board.width_m, board.height_m
    n_fold = 4 if max(sides) < (1 + _NEARLY_SQUARE) * min(sides) else 2
    steps = 2 * np.pi / n_fold * np.arange(n_fold)
    turns = pose(exp_so3(steps[:, None] * np.array([0.0, 0.0, 1.0])), np.zeros((n_fold, 3)))
    turn = turns[int(np.argmin(rotation_angle(T[:3, :3], (other @ turns)[:, :3, :3])))]
    return turn, abs(float(difference(other @ turn, T)[3:] @ T[:3, 2]))


def _fit_poses(start: Start, one: PlacedBoards, other: PlacedBoards, board: Board) -> CalibrationEstimate:
    """Minimise (1) from Algorithm 1's solution.

    Args:
        start: with the F captures used.
        one, other: their boards in both LiDARs.
        board: the plate.
    """
    placement = group_placements(start.observations)
    once = 1 / np.bincount(placement)[placement]
    T = start.T_cam_lidar
    n_one, n_other = one.shared.shape[2], other.shared.shape[2]
    prior = np.diag(np.r_[np.zeros(6), np.ones(n_one + n_other)])
    errors = np.zeros(n_one + n_other)
    for _ in range(_STEPS):
        R = np.kron(np.eye(2), T[:3, :3])
        J = np.concatenate([np.zeros((len(one.T), 6, 6)), -one.shared, R @ other.shared], axis=2)
        J[:, :, :6] = np.eye(6)
        J[:, :3, 3:6] = -skew(other.T[:, :3, 3] @ T[:3, :3].T)
        residual = difference(T @ other.T, one.T) + J[:, :, 6:] @ errors
        information = np.linalg.inv(one.cov + R @ other.cov @ R.T)
        chi2 = np.einsum("fi,fij,fj->f", residual, information, residual)
        off = np.sqrt(np.maximum(chi2 / 6, 1e-12))
        off /= max(float(np.median(off)), 1.0)
        weighted = (once * np.minimum(1, _HUBER / off))[:, None, None] * np.swapaxes(J, 1, 2) @ information
        cost = Quadratics(
            (weighted @ residual[..., None])[..., 0],
            weighted @ J,
            prior,
            prior @ np.r_[np.zeros(6), errors],
            placement,
        )
        step = cost.optimum()
        T, errors = perturb(T, step[:6]), errors + step[6:]
    inverse = cost.covariance()
    scatter = (inverse @ cost.hessians.sum(axis=0) @ inverse)[:6, :6]
    constants = (inverse @ prior @ inverse)[:6, :6]
    left_out = jackknife_scatter(cost.moves()[:, :6])
    cov, inflation = widen(scatter + constants, left_out, len(cost.groups))
    figures = replace(with_parts(start.diagnostics, scatter, constants), covariance_inflation=inflation)
    estimate = report(start, T, cov, board, figures)
    # The same boards as if the first LiDAR's poses were images: only to judge whether mountings changed.
    joint = maximise_likelihood([start.observations], board, [T], other.joint.priors, other.joint.levels)
    return replace(estimate, method="ml", joint=(joint, 0))
