"""The optimum: extrinsics of cameras that share one LiDAR, board poses, constant errors, noise levels.

Fisher scoring: Gauss-Newton on ranges and images, mean information and score for the density of ring ends
(`end_density`). Noise levels are fitted in between, by the evidence: all unknowns are integrated out
(restricted maximum likelihood), so that residuals reduced by the fit are not mistaken for small noise.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from lce_rig.calibrate.likelihood.images import StackedImages, stack_images
from lce_rig.calibrate.likelihood.layout import Layout, State
from lce_rig.calibrate.likelihood.levels import LOG_SIGMA, MOST_LOST, NO_LASER_M, Levels, PoseLevels, Priors
from lce_rig.calibrate.likelihood.model import Assembly, Reduced, Terms, assemble, linearise
from lce_rig.calibrate.likelihood.rays import StackedScans, interior, lens_fields, stack_scans
from lce_rig.calibrate.observations import group_shared_placements
from lce_rig.calibrate.quadratics import Quadratics, symmetric_inverse
from lce_rig.core.board import Board
from lce_rig.core.geometry import Array, invert, perturb
from lce_rig.core.results import LidarBoard, Observation

# Steps between changes of the levels, and their maximum at the end.
_STEPS, _LAST_STEPS = 3, 20
# Steps end where the next one is shorter than this, in standard deviations of all unknowns together.
_NEAR, _SETTLED = 0.1, 5e-3
# Rounds of the search for noise levels, each followed by a new linearisation.
_LEVEL_ROUNDS = (8, 4, 8)
# First blurs of ring ends: as long as the edge shift is unknown, all of them may lie outside
# their intervals, where a sharp density is flat.
_BLURS_RAD = (4e-3, 1.5e-3)
# Levels lie within these factors of the typical value, e^-4.6 and e^3.
_BELOW, _ABOVE = -4.6, 3.0
# Moves beyond so many of their standard deviations count less than in full (Huber; 95 % efficient).
_HUBER, _FARTHEST = 1.5, 1e6
# Plain steps before any are mixed, and how many are.
_PLAIN, _MIXED = 3, 5
# A mixed step is at most so many times as long as the plain one.
_LONGEST = 5.0


@dataclass(frozen=True, eq=False)
class JointEstimate:
    """The optimum.

    Attributes:
        T_cam_lidar: (C, 4, 4) as reported, `to_extrinsic`.
        cov: (C, 6, 6) of each, everything else marginalised, tangent (translation m, rotation rad).
        cov_scatter, cov_constants: (G, G) of the unknowns z: the part that differs between sessions, and that
            of constant errors.
        to_extrinsics: (C, 6, G) derivative of each result's tangent by z.
        levels: of the noise.
        cost: of the F captures at the optimum, in z.
        terms: linearised there.
        priors: of the constants.
    """

    T_cam_lidar: Array
    cov: Array
    cov_scatter: Array
    cov_constants: Array
    to_extrinsics: Array
    levels: Levels
    cost: Quadratics
    terms: Terms
    priors: Priors

    @property
    def state(self) -> State:
        """All unknowns at the optimum."""
        return self.terms.state

    @property
    def layout(self) -> Layout:
        """Places of the unknowns."""
        return self.terms.state.layout

    @property
    def sigma(self) -> Array:
        """Standard deviations (G,) of z."""
        return np.sqrt(np.diag(self.cov_scatter + self.cov_constants))

    @property
    def trust(self) -> Array:
        """Weight (F,) of each capture, by name."""
        return self.terms.trust


def maximise_likelihood(
    cameras: Sequence[Sequence[Observation]],
    board: Board,
    T_cam_lidar: Sequence[Array],
    priors: Priors | None = None,
    usual: Levels | None = None,
    pose_ratios: Sequence[PoseLevels] | None = None,
) -> JointEstimate:
    """Estimate extrinsics of C cameras; captures of the same name share their scan and the board's pose.

    Args:
        cameras: observations of each.
        board: the board.
        T_cam_lidar: (4, 4) of each, accurate to some degrees and centimetres.
        priors: of the constant errors; a scale that contradicts its own is freed.
        usual: typical noise levels.
        pose_ratios: for each camera, ratio of its images' errors beyond corner noise; 1 if None.
    """
    priors, usual = priors or Priors(), usual or Levels()
    usual = replace(usual, laser_m=max(usual.laser_m, NO_LASER_M))
    by_name = {o.capture: (o, T) for camera, T in zip(cameras, T_cam_lidar, strict=True) for o in camera}
    order = {name: k for k, name in enumerate(sorted(by_name))}
    scans = stack_scans([interior(by_name[name][0].lidar, board) for name in order], board)
    images = tuple(stack_camera(camera, order) for camera in cameras)
    if pose_ratios is not None:
        images = tuple(p.with_larger_errors(r) for p, r in zip(images, pose_ratios, strict=True))
    T_lidar_board = np.array([invert(T) @ o.image.T_cam_board for o, T in (by_name[name] for name in order)])
    state = State.without_errors(np.array(T_cam_lidar), T_lidar_board, len(scans.rings))
    search = _Search(scans, images, board, priors)
    placement = group_shared_placements(cameras, order)
    now = usual
    terms = linearise(scans, images, board, state, _once(placement, images))
    for blur_rad in _BLURS_RAD:
        terms = search.settle(terms, now.blurred(blur_rad), _STEPS, _NEAR)
    for k, n_rounds in enumerate(_LEVEL_ROUNDS):
        terms = search.settle(terms, now, _STEPS, _NEAR)
        if k == len(_LEVEL_ROUNDS) - 1:
            priors = priors.freed(terms.state.scale)
            search = replace(search, priors=priors)
        now = fit_levels(terms, now, usual, priors, n_rounds)
        terms = replace(terms, trust=trust_captures(terms, now, priors, placement))
    terms = search.settle(terms, now, _LAST_STEPS, _SETTLED)
    return _summarise(terms, now, priors)


def stack_camera(observations: Sequence[Observation], order: Mapping[str, int]) -> StackedImages:
    """Stack one camera's images; `order` gives each capture's place by name."""
    capture = np.array([order[o.capture] for o in observations], dtype=np.intp)
    return stack_images(capture, [o.image for o in observations])


def fit_boards(
    lidars: Sequence[LidarBoard], board: Board, priors: Priors, usual: Levels
) -> tuple[Terms, Levels, Reduced]:
    """Estimate the pose of each board and the constant errors from the scans of one LiDAR alone.

    Args:
        lidars: the boards in F scans.
        board: the board.
        priors: of the constant errors.
        usual: typical noise levels.

    Returns:
        The terms, without cameras, and the levels at the optimum, and the normal equations there.
    """
    usual = replace(usual, laser_m=max(usual.laser_m, NO_LASER_M))
    scans = stack_scans([interior(lidar, board) for lidar in lidars], board)
    T_lidar_board = np.array([lidar.T_lidar_board for lidar in lidars])
    state = State.without_errors(np.zeros((0, 4, 4)), T_lidar_board, len(scans.rings))
    search, levels = _Search(scans, (), board, priors), usual
    terms = linearise(scans, (), board, state)
    for blur_rad in _BLURS_RAD:
        terms = search.settle(terms, levels.blurred(blur_rad), _STEPS, _NEAR)
    for n_rounds in _LEVEL_ROUNDS:
        terms = search.settle(terms, levels, _STEPS, _NEAR)
        levels = fit_levels(terms, levels, usual, priors, n_rounds)
    terms = search.settle(terms, levels, _LAST_STEPS, _SETTLED)
    return terms, levels, assemble(terms, levels, priors)


@dataclass(frozen=True, eq=False)
class _Search:
    """Steps of Fisher scoring towards the optimum at given levels of noise."""

    scans: StackedScans
    images: tuple[StackedImages, ...]
    board: Board
    priors: Priors

    def settle(self, terms: Terms, levels: Levels, n_steps: int, short: float) -> Terms:
        """Find the optimum in at most so many steps, until the next one is short."""
        mixing = _Mixing()
        for _ in range(n_steps):
            reduced = assemble(terms, levels, self.priors)
            if reduced.decrement < short**2:
                break
            state = terms.state.moved(*mixing.mix(reduced))
            terms = linearise(self.scans, self.images, self.board, state, terms.trust)
        return terms


class _Mixing:
    """Corrects steps by how earlier ones turned out (Anderson mixing).

    The mean information of ring ends is not the curvature of their cost: plain steps are a fifth of what
    they should be in some directions, and leap back and forth in others. From steps s_k and moves m_k,

        m = s - (dM + dS) gamma,    gamma = argmin |s - dS gamma|, in standard deviations of the unknowns

    References:
        Walker, Ni, "Anderson acceleration for fixed-point iterations", SIAM J. Numerical Analysis, 2011.
    """

    def __init__(self) -> None:
        self._steps: list[Array] = []
        self._moves: list[Array] = []

    def mix(self, reduced: Reduced) -> tuple[Array, Array]:
        """Return the move z (G,), y (F, 7) for the step of normal equations."""
        z, y = reduced.step
        step = np.append(z, y)
        move = step
        self._steps.append(step)
        if len(self._steps) > _PLAIN:
            of_own = np.diagonal(reduced.of_own, axis1=1, axis2=2)
            weight = np.sqrt(np.append(np.diag(reduced.cost.information), of_own))
            dS = np.diff(self._steps[-_MIXED - 1 :], axis=0).T
            dM = np.transpose(self._moves[-dS.shape[1] :])
            gamma = np.linalg.lstsq(weight[:, None] * dS, weight * step, rcond=1e-6)[0]
            move = step - (dM + dS) @ gamma
            length, plain = (float(np.linalg.norm(weight * each)) for each in (move, step))
            move = move * min(1.0, _LONGEST * plain / max(length, np.finfo(float).tiny))
        self._moves.append(move)
        return move[: len(z)], move[len(z) :].reshape(y.shape)


def fit_levels(terms: Terms, start: Levels, usual: Levels, priors: Priors, n_rounds: int) -> Levels:
    """Find the levels that minimise -2 ln p(data | levels) - 2 ln p(levels).

    Args:
        terms: linearised near the optimum.
        start: levels to start from.
        usual: centre of their prior; lasers without offsets there have none.
        priors: of the constants.
        n_rounds: of the search, at most.
    """
    from scipy.optimize import minimize

    names = [name for name in LOG_SIGMA if name != "laser_m" or usual.laser_m > NO_LASER_M]
    sigma = np.array([LOG_SIGMA[name] for name in names])
    middle = np.log([getattr(usual, name) for name in names])
    assembly = Assembly(terms, priors)
    # Thousands of ranges and a few captures determine one level each: without a scale, the search zigzags.
    n_measured = _count_measurements(terms, start)
    scale = np.sqrt(4 * np.array([n_measured[name] for name in names]) + 2 / sigma**2)

    def levels_at(x: Array) -> Levels:
        return replace(usual, **dict(zip(names, np.exp(x / scale).tolist(), strict=True)))

    def cost(x: Array) -> tuple[float, Array]:
        evidence, slopes = assembly.evidence(levels_at(x), names)
        off = (x / scale - middle) / sigma
        return evidence + float(off @ off), (slopes + 2 * off / sigma) / scale

    highest = np.where(np.array(names) == "lost_share", np.log(MOST_LOST), middle + _ABOVE)
    bounds = list(zip((middle + _BELOW) * scale, highest * scale, strict=True))
    options = {"maxiter": n_rounds, "ftol": 1e-6}
    first = np.log([getattr(start, name) for name in names]) * scale
    best = minimize(cost, first, jac=True, method="L-BFGS-B", bounds=bounds, options=options)
    return levels_at(best.x)


def _count_measurements(terms: Terms, levels: Levels) -> dict[str, float]:
    """Count, roughly, the measurements that tell of each level: n tell its logarithm to 1 / (2 n)^1/2."""
    n_returns = terms.ranges.n_returns
    n_ends, n_backed = len(terms.edges.rows), np.count_nonzero(terms.edges.is_backed)
    n_images = sum(len(images.capture) for images in terms.images)
    return {
        "range_m": float(n_returns.sum()),
        "ring_m": float(np.count_nonzero(n_returns)),
        # Only ring ends near the ends of their intervals show how blurred these are.
        "edge_rad": 0.3 * (n_ends - n_backed),
        "backed_rad": 0.3 * n_backed,
        "lost_share": 0.5 * levels.lost_share * n_ends,
        "own_shift_m": 0.3 * len(terms.trust),
        "tilt_rad": 2.0 * n_images,
        "spin_rad": 0.5 * n_images,
        "depth_m": float(n_images),
        "across_m": 2.0 * n_images,
        "laser_m": float(len(terms.rings)),
    }


def trust_captures(terms: Terms, levels: Levels, priors: Priors, placement: NDArray[np.intp]) -> Array:
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
    once = _once(placement, terms.images)
    cost = replace(assemble(replace(terms, trust=once), levels, priors).cost, placement=placement)
    J = np.concatenate(_to_extrinsics(terms.state))
    H, of_placement = cost.information, np.tensordot(cost.groups, cost.hessians, axes=1)
    without = symmetric_inverse(H - of_placement)
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
    for camera in images:
        numbers = placement[camera.capture]
        fewest[camera.capture] = np.minimum(fewest[camera.capture], np.bincount(numbers)[numbers])
    return 1 / fewest


def to_extrinsic(T_cam_lidar: Array, camera: int, layout: Layout) -> Array:
    """Differentiate a camera's reported extrinsics by the unknowns z.

    Straight ahead of the camera, a lens beside the axis equals a shift of the whole LiDAR. That shift is part
    of the extrinsics, which apply to points as the driver gives them.

    Args:
        T_cam_lidar: (4, 4) for points without that displacement.
        camera: its number.
        layout: of the G unknowns.

    Returns:
        (6, G).
    """
    J = np.zeros((6, layout.z.size))
    J[:, layout.camera(camera)] = np.eye(6)
    # The third row of R is the camera's line of sight in frame lidar.
    beside = lens_fields(T_cam_lidar[2:3, :3])[0, :, 0]
    J[:3, layout.z["lens"].start] = T_cam_lidar[:3, :3] @ beside
    return J


def _to_extrinsics(state: State) -> Array:
    """Stack `to_extrinsic` of all cameras: (C, 6, G)."""
    return np.array([to_extrinsic(T, c, state.layout) for c, T in enumerate(state.T_cam_lidar)])


def _summarise(terms: Terms, levels: Levels, priors: Priors) -> JointEstimate:
    """Split the covariance (G, G) by its causes: noise of the captures, and constant errors.

    With information H = sum_k H_k + P, H^-1 = H^-1 (sum_k H_k) H^-1 + H^-1 P H^-1.
    """
    state, cost = terms.state, assemble(terms, levels, priors).cost
    inverse, claimed = cost.covariance(), cost.prior
    if not priors.scale_is_claimed:
        claimed = claimed.copy()
        claimed[state.layout.scales, state.layout.scales] = 0.0
    scatter = inverse @ cost.hessians.sum(axis=0) @ inverse
    constants = inverse @ claimed @ inverse
    J = _to_extrinsics(state)
    return JointEstimate(
        T_cam_lidar=perturb(state.T_cam_lidar, J @ state.z),
        cov=J @ (scatter + constants) @ np.swapaxes(J, 1, 2),
        cov_scatter=scatter,
        cov_constants=constants,
        to_extrinsics=J,
        levels=levels,
        cost=cost,
        terms=terms,
        priors=priors,
    )
