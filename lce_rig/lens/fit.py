"""Intrinsics from the corners of many boards: least squares over the lens, the board's shape and every pose.

Lens and board are shared by all images, the pose is each one's own: the normal equations have an arrow's
shape, and eliminating the poses (Schur) leaves one small system however many images there are.

The board deviates from its nominal shape. A bow of half a millimetre, a pattern a thousandth too long in one
direction, corners displaced by a tenth of a millimetre: each moves the focal length or the principal point by
more than the noise of the corners does.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from lce_rig.core.board import Board
from lce_rig.core.geometry import Array, perturb, skew
from lce_rig.core.planar_pose import mirror_tilt
from lce_rig.lens.models import LensModel

# Prior deviations of boards from the nominal shape: bowed by millimetres, printed longer in one direction by
# a fraction, single corners displaced by a tenth of a millimetre.
BOW_SIGMA_M = 0.003
ASPECT_SIGMA = 0.002
PRINT_SIGMA_M = 1e-4
# Bow along width and height, aspect; then the corners' own offsets.
N_MODES = 3
_MAX_STEPS = 40
_POSE_STEPS = 15


@dataclass(frozen=True, eq=False)
class Setup:
    """Measurements and model of a fit.

    Attributes:
        corners_px: (K, N, 2) of K boards, in the order of `Board.corners()`.
        corners_board: (N, 3) nominal, m.
        shapes: (S, N, 3) displacement of the corners per unit of each shape parameter.
        shape_sigma: (S,) standard deviations of these a priori.
        model: of the lens.
        is_lens_free: whether the intrinsics are fitted; else only the board's shape and the poses are.
    """

    corners_px: Array
    corners_board: Array
    shapes: Array
    shape_sigma: Array
    model: LensModel
    is_lens_free: bool = True

    @classmethod
    def of(cls, corners_px: Array, board: Board, model: LensModel) -> "Setup":
        """Prepare boards (K, N, 2) for a fit.

        Shapes are two bows, the aspect, and x and y of each corner. A bow is a parabola along either side of
        the pattern, zero at its ends, positive towards the viewer; the aspect is the fraction by which the
        pattern is longer along its width than along its height.

        References:
            D. Kogan, mrcal: the deformed calibration object.
            K. Strobl, G. Hirzinger: More accurate pinhole camera calibration with imperfect planar target.
            ICCV Workshops 2011.
        """
        corners = board.corners()
        x, y = (corners[:, :2] - corners[:, :2].mean(axis=0)).T
        zero, n = np.zeros_like(x), len(x)
        bows = [np.stack([zero, zero, 1 - (side / np.abs(side).max()) ** 2], axis=1) for side in (x, y)]
        modes = np.stack([*bows, np.stack([x / 2, -y / 2, zero], axis=1)])
        offsets = np.zeros((n, 2, n, 3))
        offsets[np.arange(n), :, np.arange(n), :2] = np.eye(2)
        shapes = np.concatenate([modes, offsets.reshape(2 * n, n, 3)])
        sigma = np.concatenate([[BOW_SIGMA_M, BOW_SIGMA_M, ASPECT_SIGMA], np.full(2 * n, PRINT_SIGMA_M)])
        return cls(corners_px, corners, shapes, sigma, model)

    def select(self, keep: NDArray[np.bool_]) -> "Setup":
        """Keep some boards (K,)."""
        return replace(self, corners_px=self.corners_px[keep])

    @property
    def information(self) -> Array:
        """Information (P + S,) of the priors on intrinsics and shape, all about zero."""
        lens = np.concatenate([np.full(4, np.inf), self.model.prior_sigma])
        return np.asarray(1.0 / np.concatenate([lens, self.shape_sigma]) ** 2)


@dataclass(frozen=True, eq=False)
class LensState:
    """Values of every unknown.

    Attributes:
        lens: (P,) parameters of the lens model.
        shape: (S,) of the board.
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
    """Place the board's corners (N, 3) according to its shape (S,), frame board, m."""
    return np.asarray(setup.corners_board + np.tensordot(shape, setup.shapes, axes=1))


def residuals_px(setup: Setup, state: LensState) -> Array:
    """Compute predicted minus measured corners (K, N, 2)."""
    return _project(setup, state)[0]


def _project(setup: Setup, state: LensState) -> tuple[Array, Array, Array, Array]:
    """Compute residuals (K, N, 2), derivatives by point and lens, and the corners rotated into the camera."""
    turned, points = _in_camera(setup, state)
    pixels, by_point, by_lens = setup.model.project(state.lens, points)
    return pixels - setup.corners_px, by_point, by_lens, turned


def _in_camera(setup: Setup, state: LensState) -> tuple[Array, Array]:
    """Rotate the corners (K, N, 3) into the camera, and place them before it."""
    T = state.T_cam_board
    turned = corners_of(setup, state.shape) @ np.swapaxes(T[:, :3, :3], 1, 2)
    return turned, turned + T[:, None, :3, 3]


def _by_pose(setup: Setup, state: LensState) -> tuple[Array, Array]:
    """Compute residuals (K, 2 N) and their derivative (K, 2 N, 6) by the tangent of each pose."""
    turned, points = _in_camera(setup, state)
    pixels, by_point = setup.model.project_points(state.lens, points)
    J = np.concatenate([by_point, -by_point @ skew(turned)], axis=-1)
    return (pixels - setup.corners_px).reshape(len(J), -1), J.reshape(len(J), -1, 6)


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


def refine_poses(setup: Setup, state: LensState, *, tries_mirror: bool = True) -> LensState:
    """Fit every board's pose to a given lens and shape.

    This is `core.planar_pose.solve_planar_pose` for all boards at once, with a known start.

    Args:
        setup: K boards.
        state: with the poses to start from.
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


def _descend(setup: Setup, state: LensState) -> tuple[Array, Array]:
    """Levenberg-Marquardt on each pose separately; poses (K, 4, 4) and costs (K,) px^2."""
    damping = np.full(len(state.T_cam_board), 1e-4)
    T = state.T_cam_board
    residuals, J = _by_pose(setup, state)
    cost = _finite(np.sum(residuals**2, axis=1))
    for _ in range(_POSE_STEPS):
        Jt = np.swapaxes(J, 1, 2)
        step = -np.linalg.solve(_damped(Jt @ J, damping), Jt @ residuals[..., None])[..., 0]
        candidate = perturb(T, np.asarray(step))
        new_residuals, new_J = _by_pose(setup, state.with_poses(candidate))
        new_cost = _finite(np.sum(new_residuals**2, axis=1))
        is_better = new_cost < cost
        gain = np.where(is_better, cost - new_cost, 0.0)
        T = np.where(is_better[:, None, None], candidate, T)
        residuals = np.where(is_better[:, None], new_residuals, residuals)
        J = np.where(is_better[:, None, None], new_J, J)
        cost = np.where(is_better, new_cost, cost)
        damping = np.where(is_better, damping / 10, damping * 10)
        if np.all(gain <= 1e-9 * cost):
            break
    return T, cost


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
    H_pose = _damped(Jt @ J, np.full(len(J), damping))
    coupling, g_pose = Jt @ G, Jt @ residuals[..., None]
    eliminated = np.linalg.solve(H_pose, np.concatenate([coupling, g_pose], axis=-1))
    tall = (root * G).reshape(-1, G.shape[-1])
    H = tall.T @ tall + np.diag(setup.information)
    H += damping * np.diag(np.diag(H))
    right = np.concatenate([tall.T @ (root[..., 0] * residuals).ravel(), setup.information * state.shared])
    right = right.reshape(2, -1).sum(axis=0)
    lost = np.einsum("k,kpq,kpr->qr", weights, coupling, eliminated, optimize=True)
    first = 0 if setup.is_lens_free else setup.model.size
    step = np.zeros(len(H))
    H, right = H - lost[:, :-1], right - lost[:, -1]
    step[first:] = -solve_scaled(H[first:, first:], right[first:])
    return step, -eliminated[..., -1] - eliminated[..., :-1] @ step


def solve_scaled(H: Array, right: Array) -> Array:
    """Solve H x = right for unknowns of very different units."""
    scale = 1.0 / np.sqrt(np.diag(H))
    scaled = H * np.outer(scale, scale)
    return np.asarray((np.linalg.solve(scaled, (right.T * scale).T).T * scale).T)


def _cost(setup: Setup, state: LensState, residuals: Array, weights: Array) -> float:
    squares = np.sum(residuals.reshape(len(weights), -1) ** 2, axis=1)
    return float(_finite(weights @ squares + setup.information @ state.shared**2))


def _finite(cost: Array) -> Array:
    return np.where(np.isfinite(cost), cost, np.inf)


def _damped(H: Array, damping: Array) -> Array:
    diagonal = np.einsum("kii->ki", H)
    return np.asarray(H + np.eye(H.shape[1]) * ((damping[:, None] + 1e-12) * diagonal)[:, None, :])
