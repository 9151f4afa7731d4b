"""Points, planes and lines of a pair of detected boards."""

from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np

from lce_rig.core.board import Board
from lce_rig.core.geometry import Array, invert, skew, transform
from lce_rig.core.results import LidarBoard, Observation

_GRAZING_COSINE = 0.2


@dataclass(frozen=True)
class FeatureSettings:
    """How the LiDAR's points are projected onto the board's plane; benchmarks compare the choices.

    Attributes:
        point_projection: along the rays ("ray"), along the plane's normal ("normal"), or not at all ("none").
        half_step: move ring ends outwards by half an azimuth step, to where the edge is expected.
    """

    point_projection: Literal["ray", "normal", "none"] = "ray"
    half_step: bool = True


AS_FITTED = FeatureSettings()
AS_MEASURED = FeatureSettings(half_step=False)
"""Ring ends as measured, for reported residuals."""


@dataclass(frozen=True, eq=False)
class CaptureFeatures:
    """The fitted features of one capture.

    Attributes:
        capture: its name.
        plane_points: (N, 3) frame lidar, m.
        edge_points: (M, 3) ring ends, frame lidar, m.
        lidar_normal: (3,) of the board, towards the LiDAR, frame lidar.
        normal: (3,) of the board, towards the camera, frame camera.
        centre: (3,) of the plate, frame camera, m.
        edge_normals: (4, 3) outwards in the board's plane, frame camera.
        edge_anchors: (4, 3) a point on each edge, frame camera, m.
        T_board_cam: (4, 4).
        cov_normal: (3, 3) of `normal`.
    """

    capture: str
    plane_points: Array
    edge_points: Array
    lidar_normal: Array
    normal: Array
    centre: Array
    edge_normals: Array
    edge_anchors: Array
    T_board_cam: Array
    cov_normal: Array


def extract_features(
    observation: Observation, board: Board, settings: FeatureSettings = AS_FITTED
) -> CaptureFeatures:
    """Build one capture's contribution to the cost."""
    return CaptureFeatures(
        capture=observation.capture,
        **_scanned(observation.lidar, settings),
        **_seen_at(observation.image.T_cam_board, observation.image.cov, board),
    )


def see_lidar(features: CaptureFeatures, lidar: LidarBoard, settings: FeatureSettings) -> CaptureFeatures:
    """Build the features of another scan of the board that the camera sees."""
    return replace(features, **_scanned(lidar, settings))


def place_features(
    features: CaptureFeatures, T_cam_board: Array, cov: Array, board: Board
) -> CaptureFeatures:
    """Build the features of the same LiDAR's board, seen by the camera elsewhere.

    Args:
        features: of a capture.
        T_cam_board: (4, 4).
        cov: (6, 6) of that pose.
        board: its size.
    """
    return replace(features, **_seen_at(T_cam_board, cov, board))


def _scanned(lidar: LidarBoard, settings: FeatureSettings) -> dict[str, Any]:
    """Compute the features of the LiDAR's side, by the names of `CaptureFeatures`."""
    return {
        "plane_points": _onto_plane(lidar.points, lidar.plane, settings),
        "edge_points": _ring_ends(lidar, settings),
        "lidar_normal": lidar.plane[:3],
    }


def _seen_at(T_cam_board: Array, cov: Array, board: Board) -> dict[str, Any]:
    """Compute the features of the camera's side, by the names of `CaptureFeatures`."""
    R = T_cam_board[:3, :3]
    anchors_board, normals_board = board.edges()
    return {
        "normal": R[:, 2],
        "centre": T_cam_board[:3, 3],
        "edge_normals": normals_board @ R.T,
        "edge_anchors": transform(T_cam_board, anchors_board),
        "T_board_cam": invert(T_cam_board),
        "cov_normal": normal_covariance(R[:, 2], cov),
    }


def normal_covariance(normal: Array, cov_pose: Array) -> Array:
    """Propagate the covariance of a board's pose to its normal.

    With R = exp(phi^) R0 the normal moves by phi x n = -n^ phi, hence cov_n = n^ cov_phi n^T (the paper's
    equation for the left perturbation).

    Args:
        normal: (3,) frame camera.
        cov_pose: (6, 6) tangent (translation, rotation), axes of the camera.
    """
    cross = skew(normal)
    return np.asarray(cross @ cov_pose[3:, 3:] @ cross.T)


def _onto_plane(points: Array, plane: Array, settings: FeatureSettings) -> Array:
    """Project points (N, 3) onto the plane n.p + d = 0.

    A LiDAR errs along its rays, so that the ray's intersection with the plane is the point it measured; along
    the normal an error of range also moves the point sideways, by its size times the sine of the incidence.
    """
    points = np.asarray(points, dtype=np.float64)
    if settings.point_projection == "none":
        return points
    if settings.point_projection == "normal":
        return np.asarray(points - (points @ plane[:3] + plane[3])[:, None] * plane[:3])
    return _meet_plane(points, plane)


def _meet_plane(points: Array, plane: Array) -> Array:
    """Intersect the ray of each point (N, 3) with the plane; project along the normal where it grazes."""
    along = points @ plane[:3]
    is_grazing = -along < _GRAZING_COSINE * np.linalg.norm(points, axis=1)
    scale = -plane[3] / np.where(is_grazing, -1.0, along)
    straight = points - (along + plane[3])[:, None] * plane[:3]
    return np.asarray(np.where(is_grazing[:, None], straight, points * scale[:, None]))


def _ring_ends(lidar: LidarBoard, settings: FeatureSettings) -> Array:
    """Place the ring ends (M, 3) on the plane.

    The edge lies between the last ray that met the board and the next one, which did not: on average half a
    step beyond the end, along the ring.
    """
    ends = np.asarray(lidar.edge_points, dtype=np.float64)
    angle = lidar.edge_side * lidar.azimuth_step_rad / 2
    turned = np.stack(
        [
            np.cos(angle) * ends[:, 0] - np.sin(angle) * ends[:, 1],
            np.sin(angle) * ends[:, 0] + np.cos(angle) * ends[:, 1],
            ends[:, 2],
        ],
        axis=1,
    )
    half_steps = _meet_plane(turned, lidar.plane) - _meet_plane(ends, lidar.plane)
    placed = _onto_plane(ends, lidar.plane, settings)
    return placed + half_steps if settings.half_step else placed
