"""Points, planes and lines of a pair of detected boards."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from lce_rig.core.board import Board
from lce_rig.core.geometry import Array, invert, skew, transform
from lce_rig.core.results import LidarBoard, Observation

_GRAZING_COSINE = 0.2


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


def extract_features(observation: Observation, board: Board, *, half_step: bool = True) -> CaptureFeatures:
    """Build one capture's contribution to the cost.

    Args:
        observation: the boards of both sensors.
        board: its size.
        half_step: move ring ends outwards by half an azimuth step, to where the edge is expected: the edge
            lies between the last ray that met the board and the next one. Without it, they are as measured.
    """
    return CaptureFeatures(
        capture=observation.capture,
        **features_of_lidar(observation.lidar, half_step=half_step),
        **features_of_camera(observation.image.T_cam_board, observation.image.cov, board),
    )


def features_of_lidar(lidar: LidarBoard, *, half_step: bool = True) -> dict[str, Any]:
    """Compute the features of the LiDAR's side, by the names of `CaptureFeatures`; as `extract_features`."""
    ends = np.asarray(lidar.edge_points, dtype=np.float64)
    if half_step:
        ends = turn_about_z(ends, lidar.edge_side * lidar.azimuth_step_rad / 2)
    return {
        "plane_points": _meet_plane(np.asarray(lidar.points, dtype=np.float64), lidar.plane),
        "edge_points": _meet_plane(ends, lidar.plane),
        "lidar_normal": lidar.plane[:3],
    }


def features_of_camera(T_cam_board: Array, cov: Array, board: Board) -> dict[str, Any]:
    """Compute the features of the camera's side from a pose and its covariance (6, 6).

    With R = exp(phi^) R0 the normal moves by phi x n = -n^ phi, hence cov_n = n^ cov_phi n^T (the paper's
    equation for the left perturbation).
    """
    normal, cross = T_cam_board[:3, 2], skew(T_cam_board[:3, 2])
    anchors_board, normals_board = board.edges()
    return {
        "normal": normal,
        "centre": T_cam_board[:3, 3],
        "edge_normals": normals_board @ T_cam_board[:3, :3].T,
        "edge_anchors": transform(T_cam_board, anchors_board),
        "T_board_cam": invert(T_cam_board),
        "cov_normal": cross @ cov[3:, 3:] @ cross.T,
    }


def _meet_plane(points: Array, plane: Array) -> Array:
    """Intersect the ray of each point (N, 3) with the plane n.p + d = 0.

    A LiDAR errs along its rays, so that the ray's intersection with the plane is the point it measured; along
    the normal an error of range also moves the point sideways, by its size times the sine of the incidence.
    Where rays graze the plane, points are projected along its normal.
    """
    along = points @ plane[:3]
    is_grazing = -along < _GRAZING_COSINE * np.linalg.norm(points, axis=1)
    scale = -plane[3] / np.where(is_grazing, -1.0, along)
    straight = points - (along + plane[3])[:, None] * plane[:3]
    return np.asarray(np.where(is_grazing[:, None], straight, points * scale[:, None]))


def turn_about_z(vectors: Array, angle_rad: Array) -> Array:
    """Turn vectors (M, 3) about the z axis by angles (M,)."""
    cosine, sine = np.cos(angle_rad), np.sin(angle_rad)
    x = cosine * vectors[:, 0] - sine * vectors[:, 1]
    y = sine * vectors[:, 0] + cosine * vectors[:, 1]
    return np.stack([x, y, vectors[:, 2]], axis=1)
