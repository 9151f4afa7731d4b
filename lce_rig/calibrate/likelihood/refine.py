"""Joint refinement: extrinsics of cameras that share one LiDAR, board poses, constant errors, noise levels.

Fisher scoring: Gauss-Newton on ranges and images, mean information and score for the density of ring ends
(`end_density`); noise levels are fitted in between.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from lce_rig.calibrate.covariance import symmetric_inverse
from lce_rig.calibrate.likelihood.along_rays import (
    N_BOW,
    N_FIELDS,
    N_OF_LASER,
    N_SHIFTS,
    interior,
    lens_fields,
    stack_scans,
)
from lce_rig.calibrate.likelihood.fit_levels import fit_levels
from lce_rig.calibrate.likelihood.image_terms import StackedImages, stack_images
from lce_rig.calibrate.likelihood.levels import NO_LASER_M, Levels, PoseLevels, Priors
from lce_rig.calibrate.likelihood.settle import JointProblem, Point
from lce_rig.calibrate.likelihood.system import (
    PER_CAMERA,
    State,
    Terms,
    assemble,
    of_the_lidar,
    scale_places,
)
from lce_rig.calibrate.observations import group_shared_placements
from lce_rig.calibrate.quadratics import Quadratics
from lce_rig.core.board import Board
from lce_rig.core.geometry import Array, invert, perturb
from lce_rig.core.results import Observation

# Steps between changes of the levels, and their maximum at the end.
_STEPS, _LAST_STEPS = 3, 20
# Steps end where the next one is shorter than this, in standard deviations of all unknowns together.
_NEAR, _SETTLED = 0.1, 5e-3
# Rounds of the search for noise levels, each followed by a new linearisation.
_LEVEL_ROUNDS = (8, 4, 8)
# First blurs of ring ends: as long as the edge shift is unknown, all of them may lie outside
# their intervals, where a sharp density is flat.
_BLURS_RAD = (4e-3, 1.5e-3)


@dataclass(frozen=True, eq=False)
class JointEstimate:
    """The optimum.

    Attributes:
        T_cam_lidar: (C, 4, 4).
        T_lidar_board: (F, 4, 4).
        cov: (C, 6, 6) of each result, everything else marginalised, tangent (translation m, rotation rad).
        cov_scatter, cov_constants: (G, G) of the unknowns z of `system`: the part that differs between
            sessions, and that of constant errors.
        to_extrinsics: (C, 6, G) derivative of each result's tangent by the unknowns z of `system`.
        lasers: (3, L) errors of each ring, `along_rays.ERRORS_OF_LASER`; positive for ranges too long.
        fields: (4,) `along_rays.FIELDS`, the displacement of the LiDAR's lens first.
        shifts: (8,) of ring ends, `along_rays.SHIFTS`.
        scale: (C,) relative error of each camera's distances, positive for too short.
        constants_sigma: (3 L + 12,) standard deviations of the lasers' errors, fields and shifts.
        levels: of the noise.
        cost: of the F captures at the optimum, in the unknowns z of `system`.
        state: all unknowns at the optimum.
        terms: linearised there.
        priors: of the constants.
    """

    T_cam_lidar: Array
    T_lidar_board: Array
    cov: Array
    cov_scatter: Array
    cov_constants: Array
    to_extrinsics: Array
    lasers: Array
    fields: Array
    shifts: Array
    scale: Array
    constants_sigma: Array
    levels: Levels
    cost: Quadratics
    state: State
    terms: Terms
    priors: Priors

    @property
    def rings(self) -> NDArray[np.int16]:
        """Numbers (L,) of the rings."""
        return self.terms.rings

    @property
    def trust(self) -> Array:
        """Weight (F,) of each capture, by name."""
        return self.terms.trust


def refine(
    cameras: Sequence[Sequence[Observation]],
    board: Board,
    T_cam_lidar: Sequence[Array],
    priors: Priors | None = None,
    usual: Levels | None = None,
    levels: Levels | None = None,
    pose_ratios: Sequence[PoseLevels] | None = None,
) -> JointEstimate:
    """Refine extrinsics of C cameras; captures of the same name share their scan and the board's pose.

    Args:
        cameras: observations of each.
        board: the board.
        T_cam_lidar: (4, 4) of each, accurate to some degrees and centimetres.
        priors: of the constant errors.
        usual: typical noise levels.
        levels: of the noise, if known; else estimated.
        pose_ratios: for each camera, ratio of its images' errors beyond corner noise to `levels`; 1 if None.
    """
    priors, usual = priors or Priors(), usual or Levels()
    usual = replace(usual, laser_m=max(usual.laser_m, NO_LASER_M))
    seen = {o.capture: (o, T) for own, T in zip(cameras, T_cam_lidar, strict=True) for o in own}
    order = {name: k for k, name in enumerate(sorted(seen))}
    scans = stack_scans([interior(seen[name][0].lidar, board) for name in order], board)
    images = tuple(stack_camera(own, order, board) for own in cameras)
    if pose_ratios is not None:
        images = tuple(p.with_larger_errors(r) for p, r in zip(images, pose_ratios, strict=True))
    state = State(
        np.array(T_cam_lidar),
        np.array([invert(T) @ o.image.T_cam_board for o, T in (seen[name] for name in order)]),
        np.zeros(len(order)),
        np.zeros(PER_CAMERA * len(cameras) + N_OF_LASER * len(scans.rings) + N_FIELDS + N_SHIFTS),
    )
    problem = JointProblem(scans, images, board, priors)
    placement = group_shared_placements(cameras, order)
    now, here = levels or usual, problem.at(state, _once(placement, images))
    for blur_rad in _BLURS_RAD:
        here = problem.settle(here, now.blurred(blur_rad), _STEPS, _NEAR)
    for n_rounds in _LEVEL_ROUNDS if levels is None else ():
        here = problem.settle(here, now, _STEPS, _NEAR)
        now = fit_levels(here.terms, now, usual, priors, n_rounds)
        here = here.trusting(trust_captures(here, now, priors, placement))
    here = problem.settle(here, now, _LAST_STEPS, _SETTLED)
    return _summarise(here, now, priors)


# Moves beyond so many of their standard deviations count less than in full (Huber; 95 % efficient).
_HUBER, _FARTHEST = 1.5, 1e6


def trust_captures(here: Point, levels: Levels, priors: Priors, placement: NDArray[np.intp]) -> Array:
    """Weigh captures (F,) by how far the extrinsics move without them, compared with what noise explains.

    Without placement k the unknowns move by m_k = (H - H_k)^-1 g_k, with the covariance (H - H_k)^-1 - H^-1.
    With C the covariance of the extrinsics and J their derivative,

        z^2 = m_k^T J^T C^-1 J m_k / tr(C^-1 J ((H - H_k)^-1 - H^-1) J^T),    weight min(1, 1.5 / z)

    shared by the captures of the placement.

    Pose errors of recorded images have longer tails than normal ones: on two recordings, one capture of 18
    and one of 27 moved the result by three and five times what noise explains, the next one by less than two.

    References:
        Huber, "Robust Statistics", 1981.
    """
    once = _once(placement, here.terms.images)
    terms = here.trusting(once).terms
    cost = replace(assemble(terms, levels, priors).cost, placement=placement)
    J = _to_extrinsics(here.state)
    H, own = cost.information, np.tensordot(cost.groups, cost.hessians, axes=1)
    without = symmetric_inverse(H - own)
    moves = (without @ (cost.groups @ cost.gradients)[..., None])[..., 0] @ J.T
    spread = J @ (without - symmetric_inverse(H)) @ J.T
    precision = symmetric_inverse(J @ symmetric_inverse(H) @ J.T)
    squares = np.einsum("gi,ij,gj->g", moves, precision, moves)
    expected = np.einsum("ij,gji->g", precision, spread)
    z = np.sqrt(squares / np.maximum(expected, np.finfo(float).tiny))
    return np.asarray(once * (_HUBER / np.clip(z, _HUBER, _FARTHEST))[placement])


def _once(placement: NDArray[np.intp], images: Sequence[StackedImages]) -> Array:
    """Weigh captures (F,) so that those of one placement, whose errors are the same, count as one.

    Where cameras saw a placement in different numbers of captures, those that few of them saw count more.
    """
    fewest = np.full(len(placement), np.inf)
    for own in images:
        seen = placement[own.capture]
        fewest[own.capture] = np.minimum(fewest[own.capture], np.bincount(seen)[seen])
    return 1 / fewest


def stack_camera(observations: Sequence[Observation], order: dict[str, int], board: Board) -> StackedImages:
    """Stack one camera's images; `order` gives each capture's place by name."""
    capture = np.array([order[o.capture] for o in observations], dtype=np.intp)
    return stack_images(capture, [o.image for o in observations], board)


def to_extrinsic(T_cam_lidar: Array, camera: int, n_unknowns: int) -> Array:
    """Differentiate a camera's reported extrinsics by the unknowns z.

    Straight ahead of the camera, a lens beside the axis equals a shift of the whole LiDAR. That shift is part
    of the extrinsics, which apply to points as the driver gives them.

    Args:
        T_cam_lidar: (4, 4) for points without that displacement.
        camera: its number.
        n_unknowns: G.

    Returns:
        (6, G).
    """
    J = np.zeros((6, n_unknowns))
    J[:, PER_CAMERA * camera : PER_CAMERA * camera + 6] = np.eye(6)
    # The third row of R is the camera's line of sight in frame lidar.
    J[:3, -N_SHIFTS - N_FIELDS] = T_cam_lidar[:3, :3] @ lens_fields(T_cam_lidar[2:3, :3])[0, :, 0]
    return J


def _to_extrinsics(state: State) -> Array:
    """Stack `to_extrinsic` of all cameras: (6 C, G)."""
    T = state.T_cam_lidar
    return np.concatenate([to_extrinsic(T[c], c, len(state.constants)) for c in range(len(T))])


def _summarise(here: Point, levels: Levels, priors: Priors) -> JointEstimate:
    state, cost = here.state, assemble(here.terms, levels, priors).cost
    C, constants = len(state.T_cam_lidar), state.constants
    scatter, of_constants = _covariance_parts(cost, priors, C)
    cov = scatter + of_constants
    J = _to_extrinsics(state).reshape(C, 6, -1)
    lasers, fields, shifts = of_the_lidar(constants[PER_CAMERA * C :])
    return JointEstimate(
        T_cam_lidar=perturb(state.T_cam_lidar, J @ constants),
        T_lidar_board=state.T_lidar_board,
        cov=J @ cov @ np.swapaxes(J, 1, 2),
        cov_scatter=scatter,
        cov_constants=of_constants,
        to_extrinsics=J,
        lasers=lasers,
        fields=fields,
        shifts=shifts,
        scale=constants[scale_places(C)],
        constants_sigma=np.sqrt(np.diag(cov))[PER_CAMERA * C :],
        levels=levels,
        cost=cost,
        state=state,
        terms=here.terms,
        priors=priors,
    )


def _covariance_parts(cost: Quadratics, priors: Priors, n_cameras: int) -> tuple[Array, Array]:
    """Split the covariance (G, G) by its causes: noise of the captures, and constant errors.

    With information H = sum_k H_k + P, H^-1 = H^-1 (sum_k H_k) H^-1 + H^-1 P H^-1.
    """
    inverse, claimed = cost.covariance(), cost.prior
    if not priors.profile_is_claimed:
        bows = len(claimed) - N_SHIFTS - N_BOW + np.arange(N_BOW)
        claimed, of_profile = claimed.copy(), np.append(scale_places(n_cameras), bows)
        claimed[of_profile, of_profile] = 0.0
    return inverse @ cost.hessians.sum(axis=0) @ inverse, inverse @ claimed @ inverse
