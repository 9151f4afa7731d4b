"""The information of a board placement on the extrinsics, before it is captured; placements just add.

The estimate minimises sum_k f_k (residuals/moments.py). With half Hessians H_k, half gradients whose noise
has covariance B_k, and half gradients that move by D_k b when the L lasers measure b too long, the estimate
errs by -H^-1 sum_k (noise + D_k b), H = sum_k H_k + prior, hence

    cov = H^-1 (sum_k B_k) H^-1 + systematic(S),    S = -H^-1 sum_k D_k                                  (1)

with the systematic part of `calibrate.uncertainty`. All are first built in the board's frame, in which a
plane's residual depends on three freedoms b(u, v) = (1, u, v) only, and then moved to the camera's.
"""

from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from lce_rig.calibrate.plane_and_ends import PLANE_FREEDOMS, differentiate, freedoms_of_plane
from lce_rig.calibrate.quadratics import symmetric_inverse
from lce_rig.calibrate.uncertainty import systematic_covariances
from lce_rig.collect.guidance.sensor_model import ErrorModel, SensorModel
from lce_rig.core.geometry import Array, invert, skew

# The detector does not use shorter rings as lines.
FEWEST_POINTS = 6
_SAMPLES = 48
#: Extrinsic tangent (translation m, rotation rad, axes of the camera) and the edge shift.
N_UNKNOWNS = 7
# Ring ends of a usual capture: what weighs edges against planes.
_USUAL_ENDS = 14
# A ring is represented by its ends and its middle, with Simpson's weights: exact for second moments.
_NODES = np.array([0.0, 0.5, 1.0])
_SHARES = np.array([1.0, 4.0, 1.0]) / 6
# The prior of a rough extrinsic, so that no direction is ever infinitely uncertain.
_PRIOR_SIGMA_M, _PRIOR_SIGMA_RAD = 1.0, 0.5


@dataclass(frozen=True, eq=False)
class Rings:
    """The rings of L lasers on N boards.

    Attributes:
        n_points: (N, L) points of each ring on the board; 0 where the ring is too short to be used.
        ends: (N, L, 2, 2) where it enters and leaves the board, x and y of frame board, m.
        spacing_m: (N, L) distance of neighbouring points on the board.
        edge: (N, L, 2) the edge nearest to each end: 0 bottom, 1 right, 2 top, 3 left.
    """

    n_points: Array
    ends: Array
    spacing_m: Array
    edge: NDArray[np.intp]

    @property
    def n_rings(self) -> NDArray[np.intp]:
        """Rings on each board (N,)."""
        return np.asarray(np.count_nonzero(self.n_points, axis=1))


def cross_board(model: SensorModel, T_lidar_board: Array) -> Rings:
    """Find where the rings cross boards.

    A laser at elevation a sees at azimuth h the point s u of the plane n . p = n . c, with
    u = (cos a cos h, cos a sin h, sin a) and s = n . c / n . u. Samples over the board's azimuths show where
    it lies within the plate.

    Args:
        model: the sensors.
        T_lidar_board: (N, 4, 4).
    """
    board, axes, centre = model.board, T_lidar_board[:, :3, :3], T_lidar_board[:, :3, 3]
    azimuth, span = _azimuths(model, T_lidar_board)
    level, rise = np.cos(model.elevations_rad), np.sin(model.elevations_rad)
    # Dot products of each ray with the three axes of each board, (N, 3, L, K).
    around = np.cos(azimuth)[:, None] * axes[:, 0, :, None] + np.sin(azimuth)[:, None] * axes[:, 1, :, None]
    along = level[:, None] * around[:, :, None, :] + (rise[:, None] * axes[:, 2, :, None, None])
    to_centre = np.einsum("nji,nj->ni", axes, centre)
    with np.errstate(divide="ignore", invalid="ignore"):
        range_m = to_centre[:, 2, None, None] / along[:, 2]
        xy = range_m[:, None] * along[:, :2] - to_centre[:, :2, None, None]
    half = np.array([board.width_m, board.height_m]) / 2
    is_hit = (range_m > 0) & np.all(np.abs(xy) <= half[:, None, None], axis=1)

    n_hit = is_hit.sum(axis=-1)
    first = is_hit.argmax(axis=-1)
    last = is_hit.shape[-1] - 1 - is_hit[..., ::-1].argmax(axis=-1)
    n_points = n_hit * (span / _SAMPLES)[:, None] / model.azimuth_step_rad
    n_points = np.where(n_points >= FEWEST_POINTS, n_points, 0.0)
    outer = np.stack([first, last], axis=-1)
    ends = np.take_along_axis(xy, outer[:, None], axis=-1).transpose(0, 2, 3, 1)
    # A sample stands for what lies half a sample to either side of it.
    chord = ends[:, :, 1] - ends[:, :, 0]
    beyond = chord / np.maximum(n_hit - 1, 1)[..., None] / 2
    ends = np.stack([ends[:, :, 0] - beyond, ends[:, :, 1] + beyond], axis=2)
    ends = np.where((n_points > 0)[..., None, None], ends, 0.0)
    length_m = np.linalg.norm(ends[:, :, 1] - ends[:, :, 0], axis=-1)
    spacing_m = length_m / np.maximum(n_points, 1)
    return Rings(n_points, ends, spacing_m, board.nearest_edge(ends))


def _azimuths(model: SensorModel, T_lidar_board: Array) -> tuple[Array, Array]:
    """Spread samples (N, K) over the azimuths of each plate; also their span (N,)."""
    outline = np.einsum("nij,kj->nki", T_lidar_board[:, :3, :3], model.board.outline())
    outline += T_lidar_board[:, None, :3, 3]
    middle = np.arctan2(T_lidar_board[:, 1, 3], T_lidar_board[:, 0, 3])
    turned = np.arctan2(outline[..., 1], outline[..., 0]) - middle[:, None]
    turned = np.angle(np.exp(1j * turned))
    low, span = turned.min(axis=1), np.ptp(turned, axis=1)
    share = (np.arange(_SAMPLES) + 0.5) / _SAMPLES
    return (middle + low)[:, None] + span[:, None] * share, span


@dataclass(frozen=True, eq=False)
class Evidence:
    """The terms of (1) by each of N placements.

    Attributes:
        hessian: (N, 7, 7) H_k.
        noise: (N, 7, 7) B_k.
        drift: (N, 7, L) D_k.
        n_rings: (N,) rings on the board.
        n_points: (N,) points on the board.
    """

    hessian: Array
    noise: Array
    drift: Array
    n_rings: NDArray[np.intp]
    n_points: Array

    def of(self, chosen: NDArray[np.intp] | NDArray[np.bool_]) -> "Evidence":
        """Take some of the placements."""
        return Evidence(*(getattr(self, field.name)[chosen] for field in fields(self)))


def weigh_placements(model: SensorModel, T_cam_board: Array, T_cam_lidar: Array) -> Evidence:
    """Compute the terms of (1) for boards at these poses.

    Args:
        model: the sensors.
        T_cam_board: (N, 4, 4).
        T_cam_lidar: (4, 4) rough extrinsic: the profile's nominal, or an estimate.
    """
    rings = cross_board(model, invert(T_cam_lidar) @ T_cam_board)
    moments, fit, by_laser = _plane_fit(model, rings, T_cam_board, T_cam_lidar)
    hessian, by_plane, edge_noise = _in_board_frame(model, rings, moments, T_cam_board, T_cam_lidar)
    pose_cov = _pose_covariance(model, T_cam_board)
    of_pose = hessian[:, :, :6]
    noise = edge_noise + of_pose @ pose_cov @ np.swapaxes(of_pose, 1, 2)
    noise += by_plane @ fit @ np.swapaxes(by_plane, 1, 2)
    # A (N, 7, 7) maps the extrinsic's tangent to motions of the LiDAR's points on the board. A point x moves
    # by tau + phi x (x - t): by R^T (tau + phi x (c - t)) at the board's centre c, and turns by R^T phi.
    R_T = np.swapaxes(T_cam_board[:, :3, :3], 1, 2)
    A = np.zeros((len(R_T), N_UNKNOWNS, N_UNKNOWNS))
    A[:, :3, :3] = A[:, 3:6, 3:6] = R_T
    A[:, :3, 3:6] = -R_T @ skew(T_cam_board[:, :3, 3] - T_cam_lidar[:3, 3])
    A[:, 6, 6] = 1.0
    A_T = np.swapaxes(A, 1, 2)
    return Evidence(
        hessian=A_T @ hessian @ A,
        noise=A_T @ noise @ A,
        drift=A_T @ by_plane @ by_laser,
        n_rings=rings.n_rings,
        n_points=rings.n_points.sum(axis=1),
    )


def _in_board_frame(
    model: SensorModel, rings: Rings, moments: Array, T_cam_board: Array, T_cam_lidar: Array
) -> tuple[Array, Array, Array]:
    """Build half Hessians, half gradients by errors of the LiDAR's plane, and the noise of ring ends.

    Returns:
        (N, 7, 7), (N, 7, 3) by b of an error along the board's normal, (N, 7, 7).
    """
    errors = model.errors
    n, n_lasers = rings.n_points.shape
    n_ends = 2 * n_lasers
    total = np.maximum(rings.n_points.sum(axis=1), 1.0)[:, None, None]
    rows = np.zeros((N_UNKNOWNS, PLANE_FREEDOMS))
    rows[:6] = -freedoms_of_plane().T
    w_plane = PLANE_FREEDOMS / errors.plane_m**2
    hessian = w_plane * rows @ (moments / total) @ rows.T
    by_plane = -w_plane * rows @ (moments / total)

    is_seen = (rings.n_points > 0)[..., None]
    ends, edge_normals = rings.ends, model.board.edges()[1]
    normal = edge_normals[rings.edge]
    levers = np.concatenate([ends, np.zeros_like(ends[..., :1])], axis=-1)
    by_shift = np.ones_like(ends[..., :1])
    edge_rows = np.concatenate([differentiate(normal, levers), by_shift], axis=-1)
    edge_rows, normal = (edge_rows * is_seen[..., None]).reshape(n, n_ends, N_UNKNOWNS), normal[..., :2]
    n_seen = np.maximum(2 * rings.n_rings, 1)[:, None, None]
    w_edge = _USUAL_ENDS / errors.edge_m**2 / n_seen
    edge_T = np.swapaxes(edge_rows, 1, 2)
    hessian += w_edge * (edge_T @ edge_rows)

    eye = _lidar_in_board(T_cam_board, T_cam_lidar)[:, None, None, :]
    # A plane too far along the normal moves its ring ends sideways, along their rays.
    sideways = np.sum(normal * (ends - eye[..., :2]), axis=-1) / -eye[..., 2]
    basis = np.concatenate([np.ones((*ends.shape[:-1], 1)), ends], axis=-1)
    by_plane -= w_edge * edge_T @ (sideways[..., None] * basis).reshape(n, n_ends, PLANE_FREEDOMS)

    chord = ends[:, :, 1] - ends[:, :, 0]
    direction = chord / np.maximum(np.linalg.norm(chord, axis=-1, keepdims=True), 1e-9)
    across = np.abs(np.sum(direction[:, :, None] * normal, axis=-1))
    # Edges lie anywhere between a ring's last point and the next one.
    variance = (across * rings.spacing_m[..., None]) ** 2 / 12 + errors.ring_end_m**2
    edge_noise = w_edge**2 * ((edge_T * variance.reshape(n, 1, n_ends)) @ edge_rows)
    by_side = w_edge * edge_T @ np.eye(len(edge_normals))[rings.edge.reshape(n, n_ends)]
    edge_noise += errors.side_m**2 * by_side @ np.swapaxes(by_side, 1, 2)
    return hessian, by_plane, edge_noise


def _plane_fit(
    model: SensorModel, rings: Rings, T_cam_board: Array, T_cam_lidar: Array
) -> tuple[Array, Array, Array]:
    """Propagate range errors to the LiDAR's plane, which is fitted by least squares along its normal.

    Returns:
        The sum of b b^T over each board's points (N, 3, 3), the covariance (N, 3, 3) that range noise leaves,
        and the plane's move (N, 3, L) by m of each laser.
    """
    nodes = rings.ends[:, :, :1] + _NODES[:, None] * (rings.ends[:, :, 1:] - rings.ends[:, :, :1])
    basis = np.concatenate([np.ones((*nodes.shape[:-1], 1)), nodes], axis=-1)
    weights = rings.n_points[..., None] * _SHARES
    moments = np.einsum("nlk,nlki,nlkj->nij", weights, basis, basis, optimize=True)
    eye = _lidar_in_board(T_cam_board, T_cam_lidar)[:, None, None, :]
    range_m = np.sqrt(np.sum((nodes - eye[..., :2]) ** 2, axis=-1) + eye[..., 2] ** 2)
    incidence = -eye[..., 2] / range_m
    inverse = symmetric_inverse(moments + 1e-9 * np.eye(3))
    mean_square = np.sum(weights * incidence**2, axis=(1, 2)) / np.maximum(weights.sum(axis=(1, 2)), 1e-9)
    fit = (model.errors.range_m**2 * mean_square)[:, None, None] * inverse
    pull = np.einsum("nlk,nlki->nil", weights * incidence, basis)
    return moments, fit, inverse @ pull


def _pose_covariance(model: SensorModel, T_cam_board: Array) -> Array:
    """Predict the covariance (N, 6, 6) of the camera's pose of boards, axes of the board, about its centre.

    Corners give sigma^2 (J^T J)^-1, as `pose_covariance` has it; what is common to a capture is added.
    """
    corners, errors = model.board.corners(), model.errors
    R, lens = T_cam_board[:, :3, :3], model.lens
    points = np.einsum("nij,kj->nki", R, corners) + T_cam_board[:, None, :3, 3]
    by_point = lens.differentiate(points)
    by_shift = by_point @ R[:, None]
    by_turn = -by_shift @ skew(corners)
    J = np.concatenate([by_shift, by_turn], axis=-1).reshape(len(R), 2 * len(corners), 6)
    cov = errors.corner_px**2 * symmetric_inverse(np.swapaxes(J, 1, 2) @ J)
    common = np.array([0.0, 0.0, errors.depth_m, errors.tilt_rad, errors.tilt_rad, errors.tilt_rad])
    return np.asarray(cov + np.diag(common**2))


def _lidar_in_board(T_cam_board: Array, T_cam_lidar: Array) -> Array:
    """Find the LiDAR's origin (N, 3) in the frame of each board."""
    to_lidar = T_cam_lidar[:3, 3] - T_cam_board[:, :3, 3]
    return np.asarray(np.einsum("nji,nj->ni", T_cam_board[:, :3, :3], to_lidar))


@dataclass(frozen=True, eq=False)
class Precision:
    """Covariances to expect of extrinsics, tangent (translation m, rotation rad), axes of the camera.

    Attributes:
        scatter: (..., 6, 6) what differs from capture to capture.
        lasers: (..., 6, 6) what the lasers' constant errors about their mean add.
        offset: (..., 6, 6) what that mean adds.
    """

    scatter: Array
    lasers: Array
    offset: Array

    @property
    def cov(self) -> Array:
        """All of it (..., 6, 6)."""
        return self.scatter + self.lasers + self.offset

    @property
    def improvable(self) -> Array:
        """What further placements can shrink (..., 6, 6).

        An offset common to all ranges moves the extrinsic along the line of sight wherever boards stand.
        """
        return self.scatter + self.lasers

    def claimed(self, n_captures: int) -> Array:
        """Predict the covariance (..., 6, 6) that the calibration will state after so many captures.

        It estimates the scatter from the captures themselves, and makes up for how few they are (as
        `Quadratics.jackknife_covariance` does).
        """
        return np.asarray(few_captures_factor(n_captures) * self.scatter + self.lasers + self.offset)


def few_captures_factor(n_captures: int) -> float:
    """Compute by what a calibration multiplies the covariance of scatter because captures are few.

    The factor has no limit at `N_UNKNOWNS` + 2 captures, as fewer hardly tell their own scatter; from one
    more on downwards it grows with the inverse of their number.
    """
    fewest = N_UNKNOWNS + 3
    if n_captures < fewest:
        return (fewest - 1) * fewest / max(n_captures, 1)
    return (n_captures - 1) / (n_captures - N_UNKNOWNS - 2)


def combine(held: Evidence, errors: ErrorModel, more: Evidence | None = None) -> Precision:
    """Predict (6, 6) from all placements together, equation (1) of `evidence`.

    Args:
        held: the placements.
        errors: of the sensors.
        more: N further placements: each in turn beside those held gives (N, 6, 6).
    """
    hessian, noise, drift = held.hessian.sum(axis=0), held.noise.sum(axis=0), held.drift.sum(axis=0)
    if more is not None:
        hessian, noise, drift = hessian + more.hessian, noise + more.noise, drift + more.drift
    prior = np.diag(np.repeat([_PRIOR_SIGMA_M, _PRIOR_SIGMA_RAD, errors.edge_shift_m], [3, 3, 1]) ** -2.0)
    inverse = symmetric_inverse(hessian + prior)
    # The prior's own error counts where captures leave a direction open.
    scatter = inverse @ (noise + prior) @ inverse
    lasers, offset = systematic_covariances(inverse @ drift, errors.laser_bias_m, errors.range_offset_m)
    return Precision(scatter[..., :6, :6], lasers[..., :6, :6], offset[..., :6, :6])


def sigmas(cov: Array) -> tuple[Array, Array]:
    """Summarise covariances (..., 6, 6) as results do: root of the summed variances.

    Returns:
        Of the rotation in rad and of the translation in m, (...).
    """
    variances = np.diagonal(cov, axis1=-2, axis2=-1)
    return np.sqrt(variances[..., 3:].sum(axis=-1)), np.sqrt(variances[..., :3].sum(axis=-1))


def shortfall(model: SensorModel, cov: Array) -> Array:
    """Measure how far covariances (..., 6, 6) are from the profile's target, (...).

    It is the root of the summed squares of the rotation's and the translation's deviation, each in units of
    its target: the worse of the two rules, and of two placements that help it alike the one that also helps
    the other is better.
    """
    rotation, translation = sigmas(cov)
    return np.asarray(np.hypot(rotation / model.target_sigma_rad, translation / model.target_sigma_m))
