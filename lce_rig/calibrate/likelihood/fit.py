"""The optimum: extrinsics of cameras that share a LiDAR, board poses, constant errors, noise levels.

Fisher scoring: Gauss-Newton on ranges and images, mean information and score for the density of ring ends
(`end_density`). Noise levels are fitted in between, by the evidence: all unknowns are integrated out
(restricted maximum likelihood), so that residuals reduced by the fit are not mistaken for small noise.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from lce_rig.calibrate.likelihood.images import StackedImages, stack_images
from lce_rig.calibrate.likelihood.layout import Indices, Layout, State
from lce_rig.calibrate.likelihood.levels import EXACT, LOG_SIGMA, MOST_LOST, Levels, Priors
from lce_rig.calibrate.likelihood.model import Evidence, Reduced, Terms, assemble, linearise
from lce_rig.calibrate.likelihood.rays import StackedScans, interior, lens_fields, no_scans, stack_scans
from lce_rig.calibrate.observations import group_poses
from lce_rig.calibrate.quadratics import Quadratics, symmetric_inverse
from lce_rig.calibrate.session_lens import SessionLens
from lce_rig.core.board import Board
from lce_rig.core.geometry import HUBER, Array, invert, perturb
from lce_rig.core.results import BoardPose, LidarBoard, Observation, PatternBoard

# Maximum number of steps between two fits of the levels, and after the last one.
STEPS, _LAST_STEPS = 3, 20
# Step lengths below which these end, in standard deviations of all unknowns together.
NEAR, SETTLED = 0.1, 5e-3
# Rounds of the search for noise levels, each followed by a new linearisation.
_LEVEL_ROUNDS = (8, 4, 8)
# First blurs of ring ends, rad. Until the edge shift is known, all ends may lie outside their intervals,
# where a sharp density is flat.
BLURS_RAD = (4e-3, 1.5e-3)
# Levels lie within these factors of the typical value, e^-4.6 and e^3.
_BELOW, _ABOVE = -4.6, 3.0
# Largest influence of a placement, in standard deviations: its weight stays above 0.
_FARTHEST = 1e6
# Number of plain steps before Anderson mixing, and of steps that it combines.
_PLAIN, _MIXED = 3, 5
# Errors of lens and board that `Priors.held` fixes.
_HELD = ("pattern_offset", "intrinsics")
# Squared length of a step that counts as diverged, in standard deviations.
_DIVERGED = 1e12
# Largest ratio of a mixed step's length to the plain one's.
_LONGEST = 5.0

AnyTerms = TypeVar("AnyTerms")


class Optimum(ABC):
    """Covariance of the G unknowns z shared by all captures, by cause."""

    @property
    @abstractmethod
    def cost(self) -> Quadratics:
        """Quadratic cost of the F captures in z."""

    @property
    @abstractmethod
    def profiled(self) -> Mapping[str, tuple[Indices, float]]:
        """Index in z and standard deviation of each error of lens and board, by name."""

    @cached_property
    def covariances(self) -> tuple[Array, Array]:
        """Parts (G, G) of the covariance of z: noise of the session, and errors of the LiDARs.

        With information H = sum_k H_k + P, H^-1 = H^-1 (sum_k H_k) H^-1 + sum_i H^-1 P_i H^-1, with the
        priors P_i of each kind of constant error. `moves` holds those of lens and board.
        """
        inverse, prior = self.cost.covariance(), self.cost.prior.copy()
        for at, _ in self.profiled.values():
            prior[at] = 0.0
        return inverse @ self.cost.hessians.sum(axis=0) @ inverse, inverse @ prior @ inverse

    @cached_property
    def moves(self) -> dict[str, Array]:
        """Changes (G, n) of z by n independent errors of lens and board, of one standard deviation each.

        An error of the profile moves z by H^-1 P_i for each unit. Unknowns c that are held move the others by
        -H^-1 sum_k H_k,c.
        """
        inverse, data, found = self.cost.covariance(), self.cost.hessians.sum(axis=0), {}
        for name, (at, sigma) in self.profiled.items():
            if name in _HELD:
                moves = -inverse @ data[:, at]
                moves[at] = np.eye(len(at))
            else:
                moves = inverse @ self.cost.prior[:, at]
            found[name] = sigma * moves
        return found

    @cached_property
    def cov_z(self) -> Array:
        """(G, G) of z."""
        return np.asarray(sum(self.covariances) + sum(m @ m.T for m in self.moves.values()))


@dataclass(frozen=True, eq=False)
class JointEstimate(Optimum):
    """The optimum, with G unknowns z shared by all captures.

    Attributes:
        terms: terms linearised at the optimum.
        levels: noise levels.
        priors: prior standard deviations of the constant errors.
        placement: (F,) number of each capture's placement; without cameras, every capture has its own.
        captures: (F,) their names, sorted.
    """

    terms: Terms
    levels: Levels
    priors: Priors
    placement: NDArray[np.intp]
    captures: tuple[str, ...]

    @property
    def state(self) -> State:
        """All unknowns at the optimum."""
        return self.terms.state

    @cached_property
    def reduced(self) -> Reduced:
        """The normal equations."""
        return assemble(self.terms, self.levels, self.priors.held)

    @cached_property
    def cost(self) -> Quadratics:
        """Quadratic cost of the F captures in z."""
        return replace(self.reduced.cost, placement=self.placement)

    @property
    def profiled(self) -> Mapping[str, tuple[Indices, float]]:
        """Index in z and standard deviation of each error of lens and board, by name."""
        return profiled(self.state.layout, self.priors)

    @cached_property
    def to_extrinsics(self) -> Array:
        """(C, 6, G) derivative of each camera's extrinsics, as reported, by z."""
        return extrinsics_by_unknowns(self.terms)

    @property
    def T_cam_lidar(self) -> Array:
        """(C, 4, 4) as reported."""
        return perturb(self.state.T_cam_lidar, self.to_extrinsics @ self.state.z)

    def cov_with_lens(self, camera: int) -> Array:
        """Compute the cross-covariance (6, P) of a camera's extrinsics and its intrinsics."""
        optics, of_lens = self.state.layout.optics(camera), self.terms.images[camera].of_lens
        return np.asarray(self.to_extrinsics[camera] @ self.cov_z[:, optics] @ of_lens)

    @property
    def cov(self) -> Array:
        """Covariance (C, 6, 6) of the extrinsics, marginalised; tangent (translation m, rotation rad)."""
        J = self.to_extrinsics
        return np.asarray(J @ self.cov_z @ np.swapaxes(J, 1, 2))


def profiled(layout: Layout, priors: Priors) -> dict[str, tuple[Indices, float]]:
    """List index in z and standard deviation of each error of lens and board, by name."""
    found = {
        "plate_size": (layout.plate, priors.plate_m),
        "board_bow": (layout.z.of(["bow"]), priors.bow_m),
    }
    if layout.n_cameras:
        optics = np.concatenate([layout.optics(c) for c in range(layout.n_cameras)])
        found["square_size"] = layout.z.of(["squares"]), priors.squares
        found["pattern_offset"] = layout.z.of(["pattern"]), priors.pattern_m
        found["intrinsics"] = optics, priors.optics
    return found


def maximise_likelihood(
    cameras: Sequence[Sequence[Observation]],
    board: Board,
    T_cam_lidar: Sequence[Array],
    priors: Priors | None = None,
    usual: Levels | None = None,
    pose_ratios: Sequence[Mapping[str, float]] | None = None,
    lenses: Sequence[SessionLens | None] | None = None,
) -> JointEstimate:
    """Estimate extrinsics of C cameras; captures with the same name share scan and board pose.

    The second of two cameras (`PatternBoard`) is the last one, and the base.

    Args:
        cameras: observations of each.
        board: the board.
        T_cam_lidar: (4, 4) of each, accurate to some degrees and centimetres.
        priors: prior standard deviations of the constant errors.
        usual: typical noise levels.
        pose_ratios: for each camera, ratios of its images' errors beyond corner noise, by level; 1 if None.
        lenses: lenses of each camera, with errors as unknowns, the base last; None for exact lenses.
    """
    names, scans, images = stack_captures(cameras, board, lenses or [None] * len(cameras), pose_ratios)
    base = None if len(images) == len(cameras) else len(cameras)
    by_name = {
        o.capture: invert(T) @ o.pose.T_cam_board
        for camera, T in zip(cameras, T_cam_lidar, strict=True)
        for o in camera
    }
    T_lidar_board = np.array([by_name[name] for name in names])
    n_optics = [each.turns.shape[1] for each in images]
    T_cameras = np.array([*T_cam_lidar, *([] if base is None else [np.eye(4)])])
    state = State.without_errors(T_cameras, T_lidar_board, len(scans.rings), n_optics, base)
    placement = group_poses(T_lidar_board)
    terms = linearise(scans, images, board, state, weigh_placements(placement, images))
    return _maximise(terms, priors or Priors(), usual or Levels(), placement, names)


def stack_captures(
    cameras: Sequence[Sequence[Observation]],
    board: Board,
    lenses: Sequence[SessionLens | None],
    pose_ratios: Sequence[Mapping[str, float]] | None,
) -> tuple[tuple[str, ...], StackedScans, list[StackedImages]]:
    """Stack the captures of all cameras, sorted by name; arguments as in `maximise_likelihood`."""
    surfaces = {o.capture: o.surface for camera in cameras for o in camera}
    order = {name: k for k, name in enumerate(sorted(surfaces))}
    by_base = {name: each.image for name, each in surfaces.items() if isinstance(each, PatternBoard)}
    if by_base:
        scans = no_scans(len(order))
    else:
        lidars = {o.capture: o.lidar for camera in cameras for o in camera}
        scans = stack_scans([interior(lidars[name], board) for name in order], board)
    seen: list[Mapping[str, BoardPose]] = [{o.capture: o.pose for o in camera} for camera in cameras]
    if by_base:
        seen.append(by_base)
    images = [
        stack_images(
            np.array([order[name] for name in of_camera]),
            list(of_camera.values()),
            board.pattern_offset_m,
            lens,
        )
        for of_camera, lens in zip(seen, lenses, strict=True)
    ]
    if pose_ratios is not None:
        images = [each.with_larger_errors(ratios) for each, ratios in zip(images, pose_ratios, strict=True)]
    return tuple(order), scans, images


def fit_boards(lidars: Sequence[LidarBoard], board: Board, priors: Priors, usual: Levels) -> JointEstimate:
    """Estimate the pose of each board and the constant errors from F scans of one LiDAR alone.

    Args:
        lidars: the boards.
        board: the board.
        priors: prior standard deviations of the constant errors.
        usual: typical noise levels.
    """
    scans = stack_scans([interior(lidar, board) for lidar in lidars], board)
    T_lidar_board = np.array([lidar.T_lidar_board for lidar in lidars])
    state = State.without_errors(np.zeros((0, 4, 4)), T_lidar_board, len(scans.rings), ())
    return _maximise(linearise(scans, (), board, state), priors, usual, np.arange(len(lidars)), ())


def _maximise(
    terms: Terms, priors: Priors, usual: Levels, placement: NDArray[np.intp], captures: tuple[str, ...]
) -> JointEstimate:
    """Alternate between steps towards the optimum and fits of the noise levels.

    Captures are weighted by their disagreement on the extrinsics; those of one placement (F,) share a weight.
    """
    held = priors.held
    now = usual = replace(usual, laser_m=max(usual.laser_m, EXACT))
    terms = approach(terms, now, held)
    for n_rounds in _LEVEL_ROUNDS:
        terms = settle(terms, now, held, STEPS, NEAR)
        now = fit_levels(terms, now, usual, held, n_rounds)
        if terms.images:
            terms = replace(terms, trust=trust_captures(terms, now, held, placement))
    return JointEstimate(settle(terms, now, held, _LAST_STEPS, SETTLED), now, priors, placement, captures)


def approach(terms: Terms, levels: Levels, priors: Priors) -> Terms:
    """Approach the optimum from a distant start, with blurred ring ends."""
    for blur_rad in BLURS_RAD:
        terms = settle(terms, levels.blurred(blur_rad), priors, STEPS, NEAR)
    return terms


def settle(terms: Terms, levels: Levels, priors: Priors, n_steps: int, short: float) -> Terms:
    """Find the optimum at given levels in at most `n_steps` steps; stop at the first short step."""

    def reduce(here: Terms) -> Reduced:
        return assemble(here, levels, priors)

    def move(here: Terms, z: Array, y: Array) -> Terms:
        return linearise(here.scans, here.images, here.board, here.state.moved(z, y), here.trust)

    return descend(terms, reduce, move, n_steps, short)


def descend(
    terms: AnyTerms,
    reduce: Callable[[AnyTerms], Reduced],
    move: Callable[[AnyTerms, Array, Array], AnyTerms],
    n_steps: int,
    short: float,
) -> AnyTerms:
    """Find the optimum of linearised terms in at most `n_steps` steps; stop at the first short step.

    The mean information of ring ends is not the curvature of their cost: plain steps are five times too short
    in some directions and oscillate in others. Anderson mixing corrects them by the effect of earlier steps.
    From steps s_k and moves m_k,

        m = s - (dM + dS) gamma,    gamma = argmin |s - dS gamma|, in standard deviations of the unknowns

    Args:
        terms: terms to start from.
        reduce: returns the normal equations of terms.
        move: linearises terms again after a step z (G,) and y (F, n).
        n_steps, short: maximum number of steps; length of the next one that ends them, in standard
            deviations of all unknowns.

    References:
        Walker, Ni, "Anderson acceleration for fixed-point iterations", SIAM J. Numerical Analysis, 2011.
    """
    steps: list[Array] = []
    moves: list[Array] = []
    finite = terms
    for _ in range(n_steps):
        reduced = reduce(terms)
        # Far from any optimum steps may diverge: keep the last finite terms.
        if not reduced.decrement < _DIVERGED:
            return finite
        finite = terms
        if reduced.decrement < short**2:
            break
        z, y = reduced.step
        step = np.append(z, y)
        steps.append(step)
        mixed = step
        if len(steps) > _PLAIN:
            of_own = np.diagonal(reduced.of_own, axis1=1, axis2=2)
            weight = np.sqrt(np.append(np.diag(reduced.cost.information), of_own))
            dS = np.diff(steps[-_MIXED - 1 :], axis=0).T
            dM = np.transpose(moves[-dS.shape[1] :])
            gamma = np.linalg.lstsq(weight[:, None] * dS, weight * step, rcond=1e-6)[0]
            mixed = step - (dM + dS) @ gamma
            length, plain = (float(np.linalg.norm(weight * each)) for each in (mixed, step))
            mixed = mixed * min(1.0, _LONGEST * plain / max(length, np.finfo(float).tiny))
        moves.append(mixed)
        terms = move(terms, mixed[: len(z)], mixed[len(z) :].reshape(y.shape))
    return terms


def fit_levels(
    terms: Terms,
    start: Levels,
    usual: Levels,
    priors: Priors,
    n_rounds: int,
    names: Sequence[str] = tuple(LOG_SIGMA),
) -> Levels:
    """Find the levels that minimise -2 ln p(data | levels) - 2 ln p(levels).

    Args:
        terms: linearised near the optimum.
        start: initial levels.
        usual: centre of their prior; lasers without offsets there have none.
        priors: prior standard deviations of the constant errors.
        n_rounds: number of rounds of the search, at most.
        names: names of the levels to find; others are the usual ones.
    """
    from scipy.optimize import minimize

    names = [name for name in names if name != "laser_m" or usual.laser_m > EXACT]
    sigma = np.array([LOG_SIGMA[name] for name in names])
    middle = np.log([getattr(usual, name) for name in names])
    # Thousands of ranges but few captures determine a level: without scaling, the search zigzags.
    n_measured = _count_measurements(terms, start)
    scale = np.sqrt(4 * np.array([n_measured[name] for name in names]) + 2 / sigma**2)

    def levels_at(x: Array) -> Levels:
        return replace(usual, **dict(zip(names, np.exp(x / scale).tolist(), strict=True)))

    evidence = Evidence.of(terms, usual, priors, names)

    def cost(x: Array) -> tuple[float, Array]:
        value, slopes = evidence(levels_at(x))
        off = (x / scale - middle) / sigma
        return value + float(off @ off), (slopes + 2 * off / sigma) / scale

    highest = np.where(np.array(names) == "lost_share", np.log(MOST_LOST), middle + _ABOVE)
    bounds = list(zip((middle + _BELOW) * scale, highest * scale, strict=True))
    options = {"maxiter": n_rounds, "ftol": 1e-6}
    first = np.log([getattr(start, name) for name in names]) * scale
    best = minimize(cost, first, jac=True, method="L-BFGS-B", bounds=bounds, options=options)
    return levels_at(best.x)


def _count_measurements(terms: Terms, levels: Levels) -> dict[str, float]:
    """Estimate how many measurements n determine each level; its logarithm has sigma 1 / (2 n)^1/2."""
    n_returns = terms.ranges.n_returns
    n_ends, n_backed = len(terms.edges.rows), np.count_nonzero(terms.edges.is_backed)
    n_images = sum(len(images.capture) for images in terms.images)
    return {
        "range_m": float(n_returns.sum()),
        "ring_m": float(np.count_nonzero(n_returns)),
        # Only ring ends near the limits of their intervals determine the blur.
        "edge_rad": 0.3 * (n_ends - n_backed),
        "backed_rad": 0.3 * n_backed,
        "lost_share": 0.5 * levels.lost_share * n_ends,
        "own_shift_m": 0.3 * len(terms.trust),
        "tilt_rad": 2.0 * n_images,
        "spin_rad": 0.5 * n_images,
        "depth_m": float(n_images),
        "across_m": 2.0 * n_images,
        "laser_m": float(len(terms.scans.rings)),
    }


def trust_captures(terms: Terms, levels: Levels, priors: Priors, placement: NDArray[np.intp]) -> Array:
    """Weight captures (F,) by their influence on the extrinsics; captures of one placement count as one."""
    once = weigh_placements(placement, terms.images)
    cost = replace(assemble(replace(terms, trust=once), levels, priors).cost, placement=placement)
    return once * by_influence(cost, np.concatenate(extrinsics_by_unknowns(terms)))


def by_influence(cost: Quadratics, J: Array) -> Array:
    """Weight captures (F,) by the shift of the extrinsics without them, relative to that expected from noise.

    Without placement k the unknowns move by m_k = (H - H_k)^-1 g_k, with the covariance (H - H_k)^-1 - H^-1.
    With C the covariance of the extrinsics and J their derivative,

        z^2 = m_k^T J^T C^-1 J m_k / tr(C^-1 J ((H - H_k)^-1 - H^-1) J^T),    weight min(1, 1.5 / z)

    shared by the captures of the placement.

    Pose errors of recorded images have longer tails than normal ones: on two recordings, one capture of 18
    and one of 27 moved the result three and five times as far as expected from noise, the next one less than
    twice.

    Args:
        cost: quadratic cost of the captures at the optimum, those of a placement with the weight of one.
        J: (e, G) derivative of the extrinsics.

    References:
        Huber, "Robust Statistics", 1981.
    """
    H, of_placement = cost.information, np.tensordot(cost.groups, cost.hessians, axes=1)
    without = symmetric_inverse(H - of_placement)
    moves = (without @ (cost.groups @ cost.gradients)[..., None])[..., 0] @ J.T
    spread = J @ (without - symmetric_inverse(H)) @ J.T
    precision = symmetric_inverse(J @ symmetric_inverse(H) @ J.T)
    squares = np.einsum("gi,ij,gj->g", moves, precision, moves)
    expected = np.einsum("ij,gji->g", precision, spread)
    z = np.sqrt(squares / np.maximum(expected, np.finfo(float).tiny))
    return np.asarray((HUBER / np.clip(z, HUBER, _FARTHEST))[cost.placement])


def weigh_placements(placement: NDArray[np.intp], images: Sequence[StackedImages]) -> Array:
    """Weight captures (F,) so that those of one placement, which share its errors, count as one.

    If cameras saw a placement in different numbers of captures, the smallest number counts.
    """
    every = np.bincount(placement)[placement].astype(np.float64)
    fewest = np.full(len(placement), np.inf)
    for camera in images:
        numbers = placement[camera.capture]
        fewest[camera.capture] = np.minimum(fewest[camera.capture], np.bincount(numbers)[numbers])
    return 1 / np.where(np.isinf(fewest), every, fewest)


def extrinsics_by_unknowns(terms: Terms) -> Array:
    """Differentiate the cameras' reported extrinsics by the unknowns z: (C, 6, G).

    Straight ahead of the camera, a lens beside the axis equals a shift of the whole LiDAR. That shift is part
    of the extrinsics, which apply to points from the driver. They are used with the intrinsics of
    the same result: an error of these that projects like a rotation of the camera is part of them, too.
    """
    state, layout = terms.state, terms.state.layout
    J = np.zeros((layout.n_cameras, 6, layout.z.size))
    for c, (T_cam_lidar, images) in enumerate(zip(state.T_cam_lidar, terms.images, strict=True)):
        J[c][:, layout.camera(c)] = np.eye(6)
        J[c, 3:, layout.optics(c)] = images.turns.T
        if layout.base is not None:
            continue
        # The third row of R is the camera's line of sight in frame lidar.
        beside = lens_fields(T_cam_lidar[2:3, :3])[0, :, 0]
        J[c, :3, layout.z["lens"].start] = T_cam_lidar[:3, :3] @ beside
    return J
