"""Intrinsics from the corners of many boards: least squares over lens, board shape and all poses.

All images share lens and board, each has its own pose: the normal equations have arrowhead structure, and
eliminating the poses (Schur) leaves one small system for any number of images.

The board deviates from its nominal shape. A bow of half a millimetre, a twist, a pattern a thousandth too
long in one direction, corners displaced by a tenth of a millimetre: each moves the focal length or the
principal point by more than the noise of the corners does, and alike in every image. On a recording with a
plate bent by 6 mm, a fit of two bows alone puts the principal point 20 px off.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from lce_rig.core.board import Board
from lce_rig.core.geometry import Array, chance_of, perturb, skew
from lce_rig.core.planar_pose import linearise_poses, mirror_tilt, refine_poses
from lce_rig.lens.lens_estimate import IntrinsicsEstimate
from lce_rig.lens.models import LensModel, LensPrior

# Prior deviations of boards from the nominal shape: bowed by millimetres, bent otherwise by less, printed
# longer in one direction by a fraction, the pattern and single corners displaced by a tenth of a millimetre.
BOW_SIGMA_M = 0.003
BEND_SIGMA_M = 0.001
ASPECT_SIGMA = 0.002
PRINT_SIGMA_M = 1e-4
# A board stated as exact in the profile.
_EXACT_M = 1e-7
# Bow along width and height, aspect, five further bends, seven smooth displacements of the pattern; then the
# corners' own offsets.
N_MODES = 15
_MAX_STEPS = 40
# Share of the prior's variance that boards must remove from a direction of the lens to be compared in it.
_TOLD = 0.1


@dataclass(frozen=True, eq=False)
class Setup:
    """Measurements and model of a fit.

    Attributes:
        corners_px: (K, N, 2) of K boards, in the order of `Board.corners()`; NaN where hidden, which gives
            residuals and derivatives of zero.
        corners_board: (N, 3) nominal, m.
        shapes: (S, N, 3) displacement of the corners per unit of each shape parameter.
        mean: (P + S,) prior mean of lens and shape.
        information: (P + S, P + S) information of the prior.
        model: model of the lens.
        is_lens_free: whether the intrinsics are fitted; else only the board's shape and the poses are.
    """

    corners_px: Array
    corners_board: Array
    shapes: Array
    mean: Array
    information: Array
    model: LensModel
    is_lens_free: bool = True

    @classmethod
    def of(cls, corners_px: Array, board: Board, model: LensModel, prior: LensPrior | None = None) -> "Setup":
        """Prepare boards (K, N, 2) for a fit.

        Shapes are `board_shapes`, and x and y of each corner.

        Args:
            corners_px: measured corners.
            board: the board.
            model: model of the lens.
            prior: prior information of lens and board; None without one of the lens.

        References:
            D. Kogan, mrcal: the deformed calibration object.
            K. Strobl, G. Hirzinger: More accurate pinhole camera calibration with imperfect planar target.
            ICCV Workshops 2011.
        """
        corners = board.corners()
        n, P = len(corners), model.size
        modes, sigma = board_shapes(board)
        offsets = np.zeros((n, 2, n, 3))
        offsets[np.arange(n), :, np.arange(n), :2] = np.eye(2)
        shapes = np.concatenate([modes, offsets.reshape(2 * n, n, 3)])
        shape_sigma = np.concatenate([sigma, np.full(2 * n, PRINT_SIGMA_M)])
        mean, information = np.zeros(P + len(shapes)), np.zeros((P + len(shapes),) * 2)
        coefficients = np.arange(4, P)
        information[coefficients, coefficients] = np.array(model.prior_sigma) ** -2
        if prior is not None:
            mean[:P], information[:P, :P] = prior.of(model)
            shape_sigma = np.full(len(shapes), _EXACT_M) if prior.is_board_exact else shape_sigma
        information[P:, P:] = np.diag(shape_sigma**-2)
        return cls(corners_px, corners, shapes, mean, information, model)

    @property
    def dof(self) -> Array:
        """Coordinates of each board's corners less its pose's (K,)."""
        return np.asarray(np.isfinite(self.corners_px).sum(axis=(1, 2)) - 6)

    def select(self, keep: NDArray[np.bool_]) -> "Setup":
        """Keep some boards (K,)."""
        return replace(self, corners_px=self.corners_px[keep])

    def surprise(self, lens: Array) -> float:
        """Compute the squared distance of a lens (P,) from the prior's, in standard deviations."""
        off = lens - self.mean[: len(lens)]
        return float(off @ self.information[: len(lens), : len(lens)] @ off)

    def contradicted(self, lens: Array, cov: Array, chance: float) -> list[tuple[slice, float]]:
        """Compare the boards with the prior of focal lengths, principal point and distortion separately.

        A fitted lens (P,) is a compromise between boards and prior. Its distance d from the prior's has the
        covariance C_0 - C, with the prior's C_0 and the fitted lens's C: d^T (C_0 - C)^-1 d is chi-squared if
        both are right. In units of C_0, the eigenvalues w of C_0 - C are the boards' shares of the
        information; directions of small shares are left to the prior. The boards' own distance is d / w, of
        which (1 - w) / w is the variance of their errors.

        Args:
            lens: the fitted one.
            cov: (P, P) its covariance.
            chance: significance level of a part's contradiction.

        Returns:
            The parts of the lens's parameters that contradict, each with the ratio of variances that explains
            the distance.
        """
        P = len(lens)
        of_prior, found = np.linalg.inv(self.information[:P, :P]), []
        for part in (slice(0, 2), slice(2, 4), slice(4, P)):
            variances, axes = np.linalg.eigh(of_prior[part, part])
            units = (axes / np.sqrt(variances)).T
            left, axes = np.linalg.eigh(units @ cov[part, part] @ units.T)
            along, share = axes.T @ units @ (lens - self.mean[:P])[part], 1 - left
            told = share > _TOLD
            w, squares = share[told], along[told] ** 2
            if told.any() and chance_of(float(np.sum(squares / w)), len(w)) < chance:
                found.append((part, max(float(np.mean(squares / w**2 - (1 - w) / w)), 1.0)))
        return found

    def doubting(self, parts: Sequence[tuple[slice, float]]) -> "Setup":
        """Widen parts of the prior by ratios of variances."""
        information = self.information.copy()
        for part, ratio in parts:
            information[part, part] /= ratio
        return replace(self, information=information)


def board_shapes(board: Board) -> tuple[Array, Array]:
    """Return the 15 basis functions of a board's deviation from its nominal shape.

    With u and v from -1 to 1 along the plate's width and height, there are

    - 7 bends, heights towards the viewer: two bows 1/3 - u^2 and 1/3 - v^2 (unit: height of the middle over
      the ends), the twist u v, and four of third order. Mean and slope over the plate are zero, so that the
      board's frame stays in its middle;
    - the pattern's aspect: the fraction by which its width is stretched relative to its height;
    - 6 displacements of the pattern in x and in y, of second order, and its shear.

    Returns:
        (15, N, 3) displacement of the corners per unit, and (15,) prior standard deviations.
    """
    corners = board.corners()
    u, v = 2 * corners[:, 0] / board.width_m, 2 * corners[:, 1] / board.height_m
    about = (corners - corners.mean(axis=0))[:, :2]
    x, y = (about / np.abs(about).max(axis=0)).T
    zero = np.zeros_like(x)
    bows = [1 / 3 - u**2, 1 / 3 - v**2]
    bends = [u * v, u**3 - 0.6 * u, v**3 - 0.6 * v, (u**2 - 1 / 3) * v, u * (v**2 - 1 / 3)]
    seconds = [x**2 - 1 / 3, y**2 - 1 / 3, x * y]
    rows = [[zero, zero, bow] for bow in bows]
    rows.append([about[:, 0] / 2, -about[:, 1] / 2, zero])
    rows += [[zero, zero, bend] for bend in bends]
    rows += [row for second in seconds for row in ([second, zero, zero], [zero, second, zero])]
    rows.append([y, x, zero])
    sigma = [BOW_SIGMA_M] * len(bows) + [ASPECT_SIGMA] + [BEND_SIGMA_M] * len(bends)
    sigma += [PRINT_SIGMA_M] * (len(rows) - len(sigma))
    return np.moveaxis(np.array(rows), 1, 2), np.array(sigma)


@dataclass(frozen=True, eq=False)
class LensState:
    """Values of all unknowns.

    Attributes:
        lens: (P,) parameters of the lens model.
        shape: (S,) shape parameters of the board.
        T_cam_board: (K, 4, 4).
    """

    lens: Array
    shape: Array
    T_cam_board: Array

    def with_poses(self, T_cam_board: Array) -> "LensState":
        """Replace the poses."""
        return replace(self, T_cam_board=T_cam_board)

    def select(self, keep: NDArray[np.bool_]) -> "LensState":
        """Keep some boards (K,)."""
        return self.with_poses(self.T_cam_board[keep])

    @property
    def shared(self) -> Array:
        """Lens and shape as one vector (P + S,)."""
        return np.concatenate([self.lens, self.shape])


def corners_of(setup: Setup, shape: Array) -> Array:
    """Return the board's corners (N, 3) deformed by its shape (S,), frame board, m."""
    return np.asarray(setup.corners_board + np.tensordot(shape, setup.shapes, axes=1))


def residuals_px(setup: Setup, state: LensState) -> Array:
    """Compute predicted minus measured corners (K, N, 2)."""
    return _project(setup, state)[0]


def _project(setup: Setup, state: LensState) -> tuple[Array, Array, Array, Array]:
    """Compute residuals (K, N, 2), derivatives by point and lens, and the corners rotated into the camera."""
    T = state.T_cam_board
    turned = corners_of(setup, state.shape) @ np.swapaxes(T[:, :3, :3], 1, 2)
    pixels, by_point, by_lens = setup.model.project(state.lens, turned + T[:, None, :3, 3])
    is_seen = ~np.isnan(setup.corners_px)
    if not is_seen.all():
        by_point, by_lens = (np.where(is_seen[..., None], each, 0.0) for each in (by_point, by_lens))
    return np.where(is_seen, pixels - setup.corners_px, 0.0), by_point, by_lens, turned


def linearise(setup: Setup, state: LensState) -> tuple[Array, Array, Array]:
    """Compute residuals and derivatives.

    Returns:
        Residuals (K, 2 N) px, predicted minus measured; their derivative by lens and shape
        (K, 2 N, P + S), and by the tangent of each board's own pose (K, 2 N, 6).
    """
    residuals, by_point, by_lens, turned = _project(setup, state)
    by_corner = by_point @ state.T_cam_board[:, None, :3, :3]
    by_shape = by_corner @ np.moveaxis(setup.shapes, 0, -1)
    G = np.concatenate([by_lens, by_shape], axis=-1)
    J = np.concatenate([by_point, -by_point @ skew(turned)], axis=-1)
    K = len(J)
    return residuals.reshape(K, -1), G.reshape(K, -1, G.shape[-1]), J.reshape(K, -1, 6)


def refit_poses(setup: Setup, state: LensState, *, tries_mirror: bool = True) -> LensState:
    """Fit every board's pose to a given lens and shape.

    Args:
        setup: K boards.
        state: lens, board shape, and initial poses.
        tries_mirror: also start from the mirrored tilt, and keep the better result.
    """
    if not tries_mirror:
        return state.with_poses(_descend(setup, state)[0])
    centre = setup.corners_board.mean(axis=0)
    mirrored = np.array([mirror_tilt(T, centre) for T in state.T_cam_board])
    first, cost = _descend(setup, state)
    second, other_cost = _descend(setup, state.with_poses(mirrored))
    is_better = other_cost < cost * (1 - 1e-6)
    return state.with_poses(np.where(is_better[:, None, None], second, first))


def fit_poses(estimate: IntrinsicsEstimate, corners_px: Array, starts: Array) -> tuple[Array, Array, Array]:
    """Fit poses of boards (K, N, 2) to an estimated lens and board, each separately.

    Returns:
        T_cam_board (K, 4, 4), costs (K,) px^2 and information (K, 6, 6) for corners of 1 px.
    """
    setup, state = _of_estimate(estimate, corners_px, starts)
    T, cost = _descend(setup, state)
    project = partial(setup.model.project_points, state.lens)
    _, J = linearise_poses(T, corners_px, corners_of(setup, state.shape), project)
    return T, cost, np.asarray(np.swapaxes(J, 1, 2) @ J)


def pose_moves(estimate: IntrinsicsEstimate, corners_px: Array, T_cam_board: Array, errors: Array) -> Array:
    """Compute how fitted poses change with lens and board.

    Args:
        estimate: estimate of both.
        corners_px: (K, N, 2) corners of K boards.
        T_cam_board: (K, 4, 4) poses of these boards.
        errors: (n, P + 15) errors added to lens and shape.

    Returns:
        (n, K, 6) tangents -(sum J^T J)^-1 sum J^T G error, with J and G the derivatives of the corners.
    """
    setup, state = _of_estimate(estimate, corners_px, T_cam_board)
    _, G, J = linearise(setup, state)
    Jt = np.swapaxes(J, 1, 2)
    return np.asarray(np.moveaxis(-np.linalg.solve(Jt @ J, Jt @ (G @ errors.T)), -1, 0))


def fit_readout(estimate: IntrinsicsEstimate) -> tuple[Array, Array]:
    """Fit a rolling shutter, rows exposed in turn while the board moved, to each view of an estimate.

    Corners are displaced by the board's motion since the middle row, in proportion to their row. A pose
    absorbs most of that; the rest shears the board, which no pose does.

    Returns:
        (K, 2) displacement in x and y per row, and (K,) fall of the sum of squared residuals, px^2.
    """
    corners_px = np.array([view.board.corners_px for view in estimate.views])
    setup, state = _of_estimate(estimate, corners_px, estimate.T_cam_board)
    residuals, _, J = linearise(setup, state)
    is_seen = np.isfinite(corners_px)
    rows = np.where(is_seen[..., 1], corners_px[..., 1], 0.0)
    rows = rows - is_seen[..., 1] * (rows.sum(axis=1) / is_seen[..., 1].sum(axis=1))[:, None]
    shears = rows[:, :, None, None] * np.eye(2)
    shears = shears.reshape(len(rows), -1, 2)
    Jt = np.swapaxes(J, 1, 2)
    shears = shears - J @ np.linalg.solve(Jt @ J, Jt @ shears)
    St = np.swapaxes(shears, 1, 2)
    H, g = St @ shears, St @ residuals[..., None]
    speed = np.linalg.solve(H, g)
    return np.asarray(speed[..., 0]), np.asarray(np.sum(g * speed, axis=(1, 2)))


def _of_estimate(
    estimate: IntrinsicsEstimate, corners_px: Array, T_cam_board: Array
) -> tuple[Setup, LensState]:
    """Set up boards for an estimated lens and board."""
    model, lens = estimate.model, estimate.model.vector(estimate.intrinsics)
    unknown = np.zeros(model.size + len(estimate.shapes))
    setup = Setup(corners_px, estimate.corners_board, estimate.shapes, unknown, np.diag(unknown), model)
    return setup, LensState(lens, np.zeros(len(estimate.shapes)), T_cam_board)


def _descend(setup: Setup, state: LensState) -> tuple[Array, Array]:
    """Fit each pose alone to lens and shape; poses (K, 4, 4) and costs (K,) px^2."""
    corners_board, project = corners_of(setup, state.shape), partial(setup.model.project_points, state.lens)
    return refine_poses(state.T_cam_board, setup.corners_px, corners_board, project)


def fit(setup: Setup, start: LensState, weights: Array) -> LensState:
    """Minimise sum_k w_k |r_k|^2 + priors over lens, shape and poses, by Levenberg-Marquardt.

    Args:
        setup: K boards.
        start: an initial guess; intrinsics wrong by a third are sufficient.
        weights: (K,) 1 / px^2.
    """
    state, damping = start, 1e-4
    linear = linearise(setup, state)
    cost = _cost(setup, state, linear[0], weights)
    P = setup.model.size
    for _ in range(_MAX_STEPS):
        step, pose_steps = _step(setup, state, weights, damping, linear)
        candidate = LensState(
            state.lens + step[:P], state.shape + step[P:], perturb(state.T_cam_board, pose_steps)
        )
        new_cost = _cost(setup, candidate, residuals_px(setup, candidate), weights)
        if not new_cost < cost:
            if damping > 1e8:
                break
            damping *= 10
            continue
        gain = cost - new_cost
        state, cost, damping = candidate, new_cost, max(damping / 10, 1e-12)
        if gain < 1e-7 * cost:
            break
        linear = linearise(setup, state)
    return state


def reduced(setup: Setup, state: LensState, weights: Array) -> tuple[Array, Array]:
    """Compute each board's gradient and information of intrinsics and shape, with its pose eliminated.

    Returns:
        Gradients (K, Q) and information (K, Q, Q) with Q = P + S, without the priors.
    """
    residuals, G, J = linearise(setup, state)
    Jt = np.swapaxes(J, 1, 2)
    free = np.swapaxes(G - J @ np.linalg.solve(Jt @ J, Jt @ G), 1, 2)
    return weights[:, None] * (free @ residuals[..., None])[..., 0], weights[:, None, None] * (
        free @ np.swapaxes(free, 1, 2)
    )


def _step(
    setup: Setup, state: LensState, weights: Array, damping: float, linear: tuple[Array, Array, Array]
) -> tuple[Array, Array]:
    """Solve the damped normal equations by the Schur complement of the poses.

    Returns:
        Steps of lens and shape (P + S,), and of each pose (K, 6).
    """
    residuals, G, J = linear
    Jt, root = np.swapaxes(J, 1, 2), np.sqrt(weights)[:, None, None]
    H_pose = Jt @ J
    H_pose += np.eye(6) * ((damping + 1e-12) * np.einsum("kii->ki", H_pose))[:, None]
    coupling, g_pose = Jt @ G, Jt @ residuals[..., None]
    eliminated = np.linalg.solve(H_pose, np.concatenate([coupling, g_pose], axis=-1))
    tall = (root * G).reshape(-1, G.shape[-1])
    H = tall.T @ tall + setup.information
    H += damping * np.diag(np.diag(H))
    right = tall.T @ (root[..., 0] * residuals).ravel()
    right += setup.information @ (state.shared - setup.mean)
    lost = np.einsum("k,kpq,kpr->qr", weights, coupling, eliminated, optimize=True)
    first = 0 if setup.is_lens_free else setup.model.size
    step = np.zeros(len(H))
    H, right = H - lost[:, :-1], right - lost[:, -1]
    step[first:] = -solve_scaled(H[first:, first:], right[first:])
    return step, -eliminated[..., -1] - eliminated[..., :-1] @ step


def solve_scaled(H: Array, right: Array) -> Array:
    """Solve H x = right for unknowns of very different units, by scaling."""
    scale = 1.0 / np.sqrt(np.diag(H))
    scaled = H * np.outer(scale, scale)
    return np.asarray((np.linalg.solve(scaled, (right.T * scale).T).T * scale).T)


def _cost(setup: Setup, state: LensState, residuals: Array, weights: Array) -> float:
    squares = np.sum(residuals.reshape(len(weights), -1) ** 2, axis=1)
    off = state.shared - setup.mean
    cost = float(weights @ squares + off @ setup.information @ off)
    return cost if np.isfinite(cost) else np.inf
