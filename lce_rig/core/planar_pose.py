"""Pose of a planar board from its corners in one image: both local minima, with covariance."""

from collections.abc import Callable, Sequence
from typing import NamedTuple, TypeAlias

import numpy as np

from lce_rig.core.camera import Intrinsics
from lce_rig.core.geometry import (
    Array,
    invert,
    perturb,
    pose,
    project_to_so3,
    rotation_angle,
    skew,
    transform,
)

_MAX_STEPS = 30
Project: TypeAlias = Callable[[Array], tuple[Array, Array]]
"""From points (..., 3) in the camera to pixels (..., 2) and their derivative (..., 2, 3)."""


class PlanarPose(NamedTuple):
    """The minima of the reprojection cost f = sum |project(T p_i) - u_i|^2 of one board.

    Attributes:
        T_cam_board: (4, 4) the lower minimum.
        cov: (6, 6) of T_cam_board, sigma^2 (J^T J)^-1, tangent (translation m, rotation rad).
        T_cam_board_alternative: (4, 4) the other minimum; None if both starts reach the same one.
        chi2_gap: (f_alternative - f) / sigma^2; infinite without an alternative.
        reprojection_px: rms distance of a corner from its prediction.
        sigma_px: noise per coordinate, sqrt(f / (2 n - 6)).
    """

    T_cam_board: Array
    cov: Array
    T_cam_board_alternative: Array | None
    chi2_gap: float
    reprojection_px: float
    sigma_px: float


def solve_planar_pose(
    corners_px: Array, corners_board: Array, intrinsics: Intrinsics, starts: Sequence[Array] = ()
) -> PlanarPose | None:
    """Find T_cam_board and the second local minimum of the reprojection error.

    A homography gives the first start. Mirroring the board's tilt in the line of sight gives the second:
    under weak perspective both give the same image, so the cost of a plane has two minima. Either
    start is refined by Levenberg-Marquardt in distorted pixels, so that any camera model is treated alike.

    Args:
        corners_px: (N, 2) four or more measured corners; NaN where hidden.
        corners_board: (N, 3) with z = 0, frame board, m.
        intrinsics: the camera.
        starts: T_cam_board (4, 4) near one or both minima, from an image shortly before; then no homography
            and fewer steps are needed.

    Returns:
        The minima, or None if the corners fit no pose in front of the camera.

    References:
        T. Collins, A. Bartoli: Infinitesimal plane-based pose estimation. IJCV 109 (2014).
    """
    is_seen = np.isfinite(corners_px).all(axis=1)
    corners_px, corners_board = corners_px[is_seen], corners_board[is_seen]
    start = starts[0] if starts else _pose_from_homography(corners_board, intrinsics.unproject(corners_px))
    if start is None:
        return None
    first = refine_pose(start, corners_px, corners_board, intrinsics)
    centre_board = corners_board.mean(axis=0)
    other = starts[1] if len(starts) > 1 else mirror_tilt(first[0], centre_board)
    second = refine_pose(other, corners_px, corners_board, intrinsics)
    # A poor homography may lead to neither minimum; mirror the second one back to find out.
    back = mirror_tilt(second[0], centre_board)
    if second[1] < first[1] and rotation_angle(back[:3, :3], first[0][:3, :3]) > 0.2:
        third = refine_pose(back, corners_px, corners_board, intrinsics)
        first = third if third[1] < first[1] else first
    (T, cost), (T_other, cost_other) = sorted((first, second), key=lambda minimum: minimum[1])
    if not np.isfinite(cost):
        return None

    n = len(corners_px)
    variance = max(cost / max(2 * n - 6, 1), 1e-12)
    sigma_px = float(np.sqrt(variance))
    # Both starts may converge to one pose; distinct poses differ by far more.
    is_same = bool(rotation_angle(T[:3, :3], T_other[:3, :3]) < 1e-3)
    has_other = np.isfinite(cost_other) and not is_same
    return PlanarPose(
        T_cam_board=T,
        cov=pose_covariance(T, corners_board, intrinsics, sigma_px),
        T_cam_board_alternative=T_other if has_other else None,
        chi2_gap=float((cost_other - cost) / variance) if has_other else float("inf"),
        reprojection_px=float(np.sqrt(cost / n)),
        sigma_px=sigma_px,
    )


def pose_covariance(
    T_cam_board: Array, corners_board: Array, intrinsics: Intrinsics, sigma_px: float
) -> Array:
    """Compute the covariance (6, 6) of a pose, sigma^2 (J^T J)^-1, tangent (translation m, rotation rad).

    Args:
        T_cam_board: (4, 4).
        corners_board: (N, 3) frame board, m.
        intrinsics: the camera.
        sigma_px: noise of a corner per coordinate.
    """
    none = np.zeros((1, len(corners_board), 2))
    _, (J,) = linearise_poses(T_cam_board[None], none, corners_board, _checked(intrinsics))
    return np.asarray(sigma_px**2 * np.linalg.inv(J.T @ J))


def refine_pose(
    T_cam_board: Array, corners_px: Array, corners_board: Array, intrinsics: Intrinsics
) -> tuple[Array, float]:
    """Minimise the reprojection error of one board; see `refine_poses`.

    Returns:
        T_cam_board (4, 4) at the minimum and its cost in px^2, infinite if the start cannot be projected.
    """
    T, cost = refine_poses(T_cam_board[None], corners_px[None], corners_board, _checked(intrinsics))
    return T[0], float(cost[0])


def refine_poses(
    T_cam_board: Array, corners_px: Array, corners_board: Array, project: Project
) -> tuple[Array, Array]:
    """Minimise the reprojection errors of K independent boards by Levenberg-Marquardt.

    Args:
        T_cam_board: (K, 4, 4) initial poses.
        corners_px: (K, N, 2) measured corners; NaN where hidden.
        corners_board: (N, 3) frame board, m.
        project: pixels of points, and their derivative.

    Returns:
        T_cam_board (K, 4, 4) at the minima and costs (K,) in px^2, infinite if a start cannot be projected.
    """
    T, damping = T_cam_board, np.full(len(T_cam_board), 1e-4)
    residuals, J = linearise_poses(T, corners_px, corners_board, project)
    cost = _finite(np.sum(residuals**2, axis=1))
    for _ in range(_MAX_STEPS):
        Jt = np.swapaxes(J, 1, 2)
        H, gradient = Jt @ J, (Jt @ residuals[..., None])[..., 0]
        H_damped = H + np.eye(6) * (damping[:, None] * np.einsum("kii->ki", H))[:, None]
        step = -np.linalg.solve(H_damped, gradient[..., None])[..., 0]
        moved = perturb(T, step)
        new_residuals, new_J = linearise_poses(moved, corners_px, corners_board, project)
        new_cost = _finite(np.sum(new_residuals**2, axis=1))
        is_better = new_cost < cost
        # Rejected at machine precision: this is the minimum, not a step that was too long.
        is_precise = (-np.sum(gradient * step, axis=1) < 1e-12 * cost) | (damping > 1e8)
        is_done = np.where(is_better, cost - new_cost < 1e-9 * new_cost + 1e-20, is_precise)
        T = np.where(is_better[:, None, None], moved, T)
        residuals = np.where(is_better[:, None], new_residuals, residuals)
        J = np.where(is_better[:, None, None], new_J, J)
        cost = np.where(is_better, new_cost, cost)
        damping = damping * np.where(is_better, 0.1, 10.0)
        if np.all(is_done | ~np.isfinite(cost)):
            break
    return T, cost


def mirror_tilt(T_cam_board: Array, centre_board: Array) -> Array:
    """Mirror the board's tilt in its line of sight, keeping its centre.

    With S = diag(1, 1, -1) along the line of sight, R' = S R S mirrors the depth of every board point
    about the centre's depth. Under weak perspective the image is the same.

    Args:
        T_cam_board: (4, 4).
        centre_board: (3,) the point that stays, frame board, m.
    """
    centre_camera = transform(T_cam_board, centre_board[None])[0]
    sight = centre_camera / np.linalg.norm(centre_camera)
    S_camera = np.eye(3) - 2.0 * np.outer(sight, sight)
    R = S_camera @ T_cam_board[:3, :3] @ np.diag([1.0, 1.0, -1.0])
    return pose(R, centre_camera - R @ centre_board)


def _pose_from_homography(corners_board: Array, rays: Array) -> Array | None:
    """Decompose the homography board plane -> rays, H ~ [r1 r2 t]; None if the corners have no rays.

    Rays beyond 90 deg from the axis have no x/z; rotating all rays so that their mean is the axis keeps the
    homography finite for wide fisheye images too.
    """
    if not np.all(np.isfinite(rays)):
        return None
    # Build a rotation (3, 3) that takes `direction` to the z axis.
    direction = rays.mean(axis=0)
    z = direction / np.linalg.norm(direction)
    x = np.cross([0.0, 1.0, 0.0] if abs(z[1]) < 0.9 else [1.0, 0.0, 0.0], z)
    x /= np.linalg.norm(x)
    R_view = np.stack([x, np.cross(z, x), z])
    view = rays @ R_view.T
    if np.any(view[:, 2] < 1e-3):
        return None
    target = view[:, :2] / view[:, 2:]
    centre, size = corners_board.mean(axis=0), np.abs(corners_board - corners_board.mean(axis=0)).max()
    plane = np.concatenate([(corners_board - centre)[:, :2] / size, np.ones((len(rays), 1))], axis=1)
    # Normalising the target as well keeps the null vector of the DLT well conditioned (Hartley 1997).
    shift, scale = target.mean(axis=0), np.abs(target - target.mean(axis=0)).max()
    u, v = ((target - shift) / scale).T
    zeros = np.zeros_like(plane)
    A = np.concatenate(
        [
            np.concatenate([plane, zeros, -u[:, None] * plane], axis=1),
            np.concatenate([zeros, plane, -v[:, None] * plane], axis=1),
        ]
    )
    _, _, Vt = np.linalg.svd(A.T @ A)
    H = np.array([[scale, 0, shift[0]], [0, scale, shift[1]], [0, 0, 1]]) @ Vt[-1].reshape(3, 3)
    H *= np.sign(H[2, 2]) / np.sqrt(np.linalg.norm(H[:, 0]) * np.linalg.norm(H[:, 1]))
    R = project_to_so3(np.stack([H[:, 0], H[:, 1], np.cross(H[:, 0], H[:, 1])], axis=1))
    t = H[:, 2] * size
    return invert(pose(R_view, np.zeros(3))) @ pose(R, t - R @ centre)


def linearise_poses(
    T_cam_board: Array, corners_px: Array, corners_board: Array, project: Project
) -> tuple[Array, Array]:
    """Compute residuals (K, 2 N), predicted minus measured, and derivatives (K, 2 N, 6) by each tangent.

    The derivative of a point by the tangent is [I, -(R p)^]. Both are zero for hidden corners.

    Args:
        T_cam_board, corners_px, corners_board, project: see `refine_poses`.
    """
    turned = corners_board @ np.swapaxes(T_cam_board[:, :3, :3], 1, 2)
    pixels, by_point = project(turned + T_cam_board[:, None, :3, 3])
    is_seen = ~np.isnan(corners_px)
    residuals = np.where(is_seen, pixels - corners_px, 0.0)
    J = np.where(is_seen[..., None], np.concatenate([by_point, -by_point @ skew(turned)], axis=-1), 0.0)
    return residuals.reshape(len(J), -1), J.reshape(len(J), -1, 6)


def _checked(intrinsics: Intrinsics) -> Project:
    """Project points; NaN outside the camera model's range of validity."""
    return lambda points: (intrinsics.project(points)[0], intrinsics.differentiate(points))


def _finite(cost: Array) -> Array:
    return np.where(np.isfinite(cost), cost, np.inf)
