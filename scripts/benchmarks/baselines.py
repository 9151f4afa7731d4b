"""Published methods to compare with, on the residuals and in the report of the package's own.

`zhou`: line and plane correspondences, closed form, then least squares. Each capture gives a plane (normal n,
a point g) and up to four border lines (direction d, a point a) in the camera, and in the LiDAR the same plane
(normal m, N points p) and lines (direction e, K points q). With A = I - d d^T the pose satisfies

    n = R m,    d = R e,    n . (R p + t - g) = 0,    A (R q + t - a) = 0                             (1)

R follows in closed form from the first two (Wahba's problem), t by linear least squares from the others with
the means of p and q. Both are refined together on

    sum_captures |n - R m|^2 + sum_lines |d - R e|^2 + mean_p (n . (R p + t - g))^2
                 + sum_lines mean_q |A (R q + t - a)|^2                                                (2)

in rad and m. The paper tells the plate's borders apart by how it is hung; here a first pose from the planes
alone tells which way up the LiDAR's rectangle is.

`corners`: corner to corner, the plate's four corners in both sensors, brought together by iterated closest
points. The LiDAR's corners are those of the outline registered with its returns, the camera's those of the
plate in the pose of the print. Pairs of nearest corners within each capture give the pose in closed form (4),
which may change the pairs (3), until they stay the same:

    j(i) = argmin_j |c_j - R l_i - t|                                                                  (3)
    R, t = argmin sum |c_j(i) - R l_i - t|^2                                                           (4)

References:
    Zhou, Li, Kaess, "Automatic Extrinsic Calibration of a Camera and a 3D LiDAR using Line and Plane
    Correspondences", IROS, 2018; Umeyama, "Least-squares estimation of transformation parameters between two
    point patterns", IEEE TPAMI, 1991; Jiao et al., "LCE-Calib", 2023, which takes corners checked by hand for
    its ground truth.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from lce_rig.calibrate import CalibrationEstimate, EstimateSettings
from lce_rig.calibrate.algorithm_1.algorithm import solve_planes
from lce_rig.calibrate.algorithm_1.moments import Problem, Weights
from lce_rig.calibrate.algorithm_1.registration import (
    N_ROTATION,
    eliminate_linear,
    linear_unknowns,
    minimise_on_so3,
    rotation_from_directions,
    tangent_basis,
    vec_rotation,
    with_one,
)
from lce_rig.calibrate.features import CaptureFeatures, extract_features
from lce_rig.calibrate.methods import METHODS
from lce_rig.calibrate.observability import require_observable
from lce_rig.calibrate.options import Estimator
from lce_rig.calibrate.placements import group_placements
from lce_rig.calibrate.plane_and_ends import residual_rows
from lce_rig.calibrate.quadratics import without_prior
from lce_rig.calibrate.report import report_estimate
from lce_rig.core.board import Board
from lce_rig.core.diagnostics import NO_DIAGNOSTICS
from lce_rig.core.geometry import Array, exp_so3, invert, pose, transform
from lce_rig.core.results import Observation

INLIER_M = 0.03
MAX_ROUNDS = 50
_HALF_TURN = pose(exp_so3(np.array([0.0, 0.0, np.pi])), np.zeros(3))


@dataclass(frozen=True, eq=False)
class LinePair:
    """One border line of the plate in both sensors.

    Attributes:
        points: (K, 3) of the LiDAR on the border, K >= 2, frame lidar, m.
        direction_lidar: (3,) unit, along the line through them.
        direction: (3,) unit, of the border, frame camera.
        anchor: (3,) a point of the border, frame camera, m.
    """

    points: Array
    direction_lidar: Array
    direction: Array
    anchor: Array


def resolve_half_turn(observation: Observation, T_cam_lidar: Array) -> Array:
    """Choose between the two ways in which a rectangle lies on itself.

    Args:
        observation: the LiDAR's pose of the board is known up to half a turn.
        T_cam_lidar: (4, 4) rough extrinsic.

    Returns:
        T_lidar_board (4, 4) with x and y as the camera has them.
    """
    T = observation.lidar.T_lidar_board
    across = T_cam_lidar[:3, :3] @ T[:3, 0]
    is_turned = across @ observation.image.T_cam_board[:3, 0] < 0
    return np.asarray(T @ _HALF_TURN if is_turned else T)


def pair_lines(observation: Observation, board: Board, T_cam_lidar: Array) -> list[LinePair]:
    """Fit lines to the ring ends on each border of the plate and pair them with the camera's.

    Ring ends are moved along the normal onto the LiDAR's plane and belong to the border that the registered
    outline has nearest to them.

    Args:
        observation: the boards of both sensors.
        board: its size.
        T_cam_lidar: (4, 4) rough extrinsic, which tells the outline's half turn.

    Returns:
        At most four; borders with fewer than two ring ends in one line are left out.
    """
    ends = onto_plane(observation.lidar.edge_points, observation.lidar.plane)
    T_lidar_board = resolve_half_turn(observation, T_cam_lidar)
    anchors, outward = board.edges()
    along = np.cross([0.0, 0.0, 1.0], outward)
    nearest = board.nearest_edge(transform(invert(T_lidar_board), ends))
    T_cam_board = observation.image.T_cam_board
    pairs = []
    for border in range(4):
        found = fit_line(ends[nearest == border])
        if found is None:
            continue
        points, direction = found
        sign = np.sign(direction @ T_lidar_board[:3, :3] @ along[border])
        pairs.append(
            LinePair(
                points,
                sign * direction,
                T_cam_board[:3, :3] @ along[border],
                transform(T_cam_board, anchors[border][None])[0],
            )
        )
    return pairs


def onto_plane(points: Array, plane: Array) -> Array:
    """Project points (N, 3) along the normal onto the plane n.p + d = 0."""
    return np.asarray(points - (points @ plane[:3] + plane[3])[:, None] * plane[:3])


def fit_line(points: Array) -> tuple[Array, Array] | None:
    """Fit a line to those of a few points (N, 3) that lie in one.

    Every pair of points proposes a line, the one with the most points within `INLIER_M` wins, and is fitted
    to these by least squares.

    Returns:
        The points (K, 3) in it and its unit direction (3,); None with fewer than two points.
    """
    if len(points) < 2:
        return None
    first, second = np.triu_indices(len(points), 1)
    directions = points[second] - points[first]
    directions /= np.maximum(np.linalg.norm(directions, axis=1, keepdims=True), 1e-9)
    away = np.linalg.norm(np.cross(points[None] - points[first, None], directions[:, None]), axis=-1)
    is_in = away < INLIER_M
    inliers = points[is_in[np.argmax(is_in.sum(axis=1))]]
    return inliers, np.linalg.svd(inliers - inliers.mean(axis=0))[2][0]


def point_rows(targets: Array, sources: Array) -> Array:
    """Write the residuals g - R p - t as rows of a . x, x = [vec R; t; 1].

    Args:
        targets: (N, 3) g, m, target frame.
        sources: (N, 3) p, m, source frame.

    Returns:
        (3 N, 13).
    """
    return residual_rows(np.eye(3)[None], targets[:, None], sources[:, None]).reshape(-1, 13)


def direction_rows(targets: Array, sources: Array) -> Array:
    """Write the residuals d - R s of unit vectors, which no translation moves, as rows of a . x.

    Args:
        targets: (N, 3) d, target frame.
        sources: (N, 3) s, source frame.

    Returns:
        (3 N, 13).
    """
    rows = point_rows(targets, sources)
    rows[:, N_ROTATION:12] = 0.0
    return rows


def refine(moments: Array, T_start: Array) -> Array:
    """Minimise x^T M x over poses, from a start, to the next minimum.

    Args:
        moments: (F, 13, 13) of each capture.
        T_start: (4, 4).

    Returns:
        (4, 4).
    """
    Q, L = eliminate_linear(moments.sum(axis=0)[None])
    R, _ = minimise_on_so3(Q, T_start[None, :3, :3])
    return np.asarray(pose(R[0], linear_unknowns(L, R)[0]))


def placement_covariance(moments: Array, T: Array, observations: Sequence[Observation]) -> Array:
    """Estimate the covariance (6, 6) of a minimum from how placements of the board disagree.

    Args:
        moments: (F, 13, 13) of each capture.
        T: (4, 4) the minimum.
        observations: of each capture.
    """
    x = with_one(np.concatenate([vec_rotation(T[:3, :3]), T[:3, 3]]))
    J = tangent_basis(T[:3, :3], 0)
    cost = without_prior(moments @ x @ J, J.T @ moments @ J, group_placements(observations))
    return cost.jackknife_covariance()


def start_from_planes(
    observations: Sequence[Observation], board: Board
) -> tuple[list[CaptureFeatures], Array]:
    """Solve point-to-plane, which needs no lines or corners to be told apart.

    Args:
        observations: one a capture.
        board: its specification.

    Returns:
        The captures' features and T_cam_lidar (4, 4).

    Raises:
        NotEnoughDataError: the captures leave a direction undetermined, which is named.
    """
    features = [extract_features(observation, board) for observation in observations]
    problem = Problem(features, board, Weights(1.0, 0.0, None))
    T_planes = solve_planes(features, problem)
    require_observable(features, problem, T_planes)
    return features, T_planes


def calibrate_by_lines_and_planes(
    observations: Sequence[Observation],
    board: Board,
    settings: EstimateSettings,
    progress: Callable[[int, int], None] | None = None,
) -> CalibrationEstimate:
    """Estimate T_cam_lidar as Zhou, Li and Kaess do.

    Args:
        observations: one a capture.
        board: its specification.
        settings: the method has none of its own.
        progress: not called: there is one solution.

    Raises:
        NotEnoughDataError: the captures leave a direction undetermined, which is named.
    """
    features, T_planes = start_from_planes(observations, board)
    lines = [pair_lines(observation, board, T_planes) for observation in observations]
    T_start = solve_closed_form(observations, lines)
    moments = np.stack([_moments(o, own) for o, own in zip(observations, lines, strict=True)])
    T = refine(moments, T_start)
    return report_estimate(
        T,
        placement_covariance(moments, T, observations),
        observations,
        features,
        board,
        refused={},
        diagnostics=NO_DIAGNOSTICS,
    )


def solve_closed_form(observations: Sequence[Observation], lines: Sequence[Sequence[LinePair]]) -> Array:
    """Solve (1) for R, then for t: T_cam_lidar (4, 4).

    Args:
        observations: of the captures.
        lines: the line pairs of each.
    """
    every = [line for own in lines for line in own]
    targets = [o.image.T_cam_board[:3, 2] for o in observations] + [line.direction for line in every]
    sources = [o.lidar.plane[:3] for o in observations] + [line.direction_lidar for line in every]
    R = rotation_from_directions(np.array(targets), np.array(sources))
    A, b = [], []
    for observation in observations:
        n, anchor = observation.image.T_cam_board[:3, 2], observation.image.T_cam_board[:3, 3]
        A.append(n[None])
        b.append(n[None] @ (anchor - R @ observation.lidar.points.mean(axis=0)))
    for line in every:
        across = _across(line.direction)
        A.append(across)
        b.append(across @ (line.anchor - R @ line.points.mean(axis=0)))
    return np.asarray(pose(R, np.linalg.lstsq(np.concatenate(A), np.concatenate(b))[0]))


def _moments(observation: Observation, lines: Sequence[LinePair]) -> Array:
    """Sum one capture's part of (2) as x^T M x, M (13, 13)."""
    T_cam_board, lidar = observation.image.T_cam_board, observation.lidar
    planar = residual_rows(T_cam_board[:3, 2], T_cam_board[:3, 3], lidar.points)
    directions = direction_rows(
        np.array([T_cam_board[:3, 2], *(line.direction for line in lines)]),
        np.array([lidar.plane[:3], *(line.direction_lidar for line in lines)]),
    )
    M = directions.T @ directions + planar.T @ planar / len(planar)
    for line in lines:
        rows = residual_rows(_across(line.direction)[:, None], line.anchor, line.points[None]).reshape(-1, 13)
        M += rows.T @ rows / len(line.points)
    return np.asarray(M)


def _across(direction: Array) -> Array:
    """Complete a unit vector (3,) by two more (2, 3): A = sum of their outer products."""
    return np.linalg.svd(direction[None])[2][1:]


def calibrate_by_corners(
    observations: Sequence[Observation],
    board: Board,
    settings: EstimateSettings,
    progress: Callable[[int, int], None] | None = None,
) -> CalibrationEstimate:
    """Estimate T_cam_lidar from the plate's corners.

    Args:
        observations: one a capture.
        board: its specification.
        settings: the method has none of its own.
        progress: not called: there is one solution.

    Raises:
        NotEnoughDataError: the captures leave a direction undetermined, which is named.
    """
    features, T_planes = start_from_planes(observations, board)
    outline = board.outline()
    corners_lidar = np.stack([transform(o.lidar.T_lidar_board, outline) for o in observations])
    corners_cam = np.stack([transform(o.image.T_cam_board, outline) for o in observations])
    T, paired = align_corners(corners_lidar, corners_cam, T_planes)
    rows = np.stack([point_rows(c, p) for c, p in zip(paired, corners_lidar, strict=True)])
    moments = np.swapaxes(rows, -1, -2) @ rows
    return report_estimate(
        T,
        placement_covariance(moments, T, observations),
        observations,
        features,
        board,
        refused={},
        diagnostics=NO_DIAGNOSTICS,
    )


def align_corners(corners_lidar: Array, corners_cam: Array, T_start: Array) -> tuple[Array, Array]:
    """Iterate (3) and (4).

    Args:
        corners_lidar: (F, 4, 3) by capture, m.
        corners_cam: (F, 4, 3) by capture, m.
        T_start: (4, 4) T_cam_lidar.

    Returns:
        T_cam_lidar (4, 4), and the camera's corner (F, 4, 3) of each of the LiDAR's.
    """
    T, pairs = T_start, np.full(corners_lidar.shape[:2], -1)
    for _ in range(MAX_ROUNDS):
        moved = corners_lidar @ T[:3, :3].T + T[:3, 3]
        nearest = np.argmin(np.linalg.norm(moved[:, :, None] - corners_cam[:, None], axis=-1), axis=2)
        if np.array_equal(nearest, pairs):
            break
        pairs = nearest
        T = align_points(_chosen(corners_cam, pairs).reshape(-1, 3), corners_lidar.reshape(-1, 3))
    return T, _chosen(corners_cam, pairs)


def _chosen(corners: Array, pairs: NDArray[np.intp]) -> Array:
    return np.take_along_axis(corners, pairs[..., None], axis=1)


def align_points(targets: Array, sources: Array) -> Array:
    """Find the pose (4, 4) that takes points (N, 3) nearest to others (N, 3) in the mean square."""
    centre, centre_source = targets.mean(axis=0), sources.mean(axis=0)
    R = rotation_from_directions(targets - centre, sources - centre_source)
    return np.asarray(pose(R, centre - R @ centre_source))


BASELINES: Mapping[str, Estimator] = {
    "zhou": calibrate_by_lines_and_planes,
    "corners": calibrate_by_corners,
}
COMPARED = (*METHODS, *BASELINES)
"""Names of all methods."""


def settings_of(method: str, settings: EstimateSettings | None = None) -> EstimateSettings:
    """Choose a method of the package or a baseline by name."""
    settings = settings or EstimateSettings()
    for name in METHODS:
        if name == method:
            return replace(settings, method=name)
    return replace(settings, estimator=BASELINES[method])
