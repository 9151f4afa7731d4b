"""Distances of the LiDAR's points and ring ends from the camera's board: residuals and their derivatives.

With T_cam_lidar = (R, t), a point p and a ring end q of the LiDAR have the residuals

    plane     n . (g - R p - t)                                                                          (1)
    ring end  m . (h - R q - t) + d                                                                      (2)

where n is the board's normal and g its middle as the camera sees them, m the outward normal of the edge
nearest to the ring end and h a point on that edge. Ring ends lie beyond the plate's edge by the edge shift d.

Both are distances along a normal. `CaptureFeatures.board_rows` writes them linear in vec R and t, for moments
of many points; `differentiate` gives their derivatives by the tangent of (R, t). Algorithm 1, the likelihood,
the validation, the time offsets and the guidance use these functions.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lce_rig.core.board import Board
from lce_rig.core.geometry import Array, invert, skew, transform
from lce_rig.core.results import LidarBoard, Observation

PLANE_FREEDOMS = 3
"""Two planes differ by an offset and two tilts, for any number of points."""
EDGE_SHIFT_SIGMA_M = 0.015
"""Prior standard deviation of the distance of ring ends beyond an edge: about a beam's width."""
BLENDS_M = 0.35
"""Echoes from surfaces nearer to each other than this blend into one."""
_HALF_BEAM_M = 0.008  # half width of the beams behind the priors of the background's shifts
BLENDS = 1
"""Column of `describe_background`: whether the background's echo blends into the board's."""
# Smallest cosine of incidence (78 deg) for projection along rays, which divides errors by it.
_GRAZING_COSINE = 0.2


@dataclass(frozen=True, eq=False)
class CaptureFeatures:
    """The fitted features of one capture.

    Attributes:
        capture: the capture's name.
        board: the board's size.
        plane_points: (N, 3) frame lidar, m.
        edge_points: (M, 3) ring ends, frame lidar, m.
        lidar_normal: (3,) normal of the board, towards the LiDAR, frame lidar.
        T_cam_board: (4, 4).
        cov: (6, 6) of T_cam_board, tangent (translation m, rotation rad).
    """

    capture: str
    board: Board
    plane_points: Array
    edge_points: Array
    lidar_normal: Array
    T_cam_board: Array
    cov: Array

    @property
    def normal(self) -> Array:
        """Normal (3,) of the board, towards the camera, frame camera."""
        return self.T_cam_board[:3, 2]

    @property
    def centre(self) -> Array:
        """Centre (3,) of the plate, frame camera, m."""
        return self.T_cam_board[:3, 3]

    @property
    def cov_normal(self) -> Array:
        """Covariance (3, 3) of `normal`.

        With R = exp(phi^) R0 it moves by phi x n = -n^ phi, hence cov_n = n^ cov_phi n^T (the paper's
        equation for the left perturbation).
        """
        cross = skew(self.normal)
        return np.asarray(cross @ self.cov[3:, 3:] @ cross.T)

    @property
    def edge_normals(self) -> Array:
        """Edge normals (4, 3), outwards in the board's plane, frame camera."""
        return np.asarray(self.board.edges()[1] @ self.T_cam_board[:3, :3].T)

    def board_rows(self, points: Array) -> Array:
        """Write the board coordinates of points (N, 3) of the LiDAR as rows that multiply [vec R; t; d; 1].

        Returns:
            (N, 3, 14); the edge shift is not included, its column is zero.
        """
        T_board_cam = invert(self.T_cam_board)
        R = T_board_cam[:3, :3]
        rows = np.zeros((len(points), 3, 14))
        rows[:, :, :9] = (points[:, None, :, None] * R[:, None]).reshape(-1, 3, 9)
        rows[:, :, 9:12], rows[:, :, 13] = R, T_board_cam[:3, 3]
        return rows


def extract_features(observation: Observation, board: Board, *, half_step: bool = True) -> CaptureFeatures:
    """Build one capture's contribution to the cost.

    Args:
        observation: the boards of both sensors.
        board: the board's size.
        half_step: move ring ends outwards by half an azimuth step, to where the edge is expected: the edge
            lies between the last ray that hit the board and the next one. Otherwise they stay as measured.
    """
    surface, ends = observation.surface, np.zeros((0, 3))
    if isinstance(surface, LidarBoard):
        ends = np.asarray(surface.edge_points, dtype=np.float64)
        if half_step:
            ends = turn_about_z(ends, surface.edge_side * surface.azimuth_step_rad / 2)
    return CaptureFeatures(
        capture=observation.capture,
        board=board,
        plane_points=_meet_plane(np.asarray(surface.points, dtype=np.float64), surface.plane),
        edge_points=_meet_plane(ends, surface.plane),
        lidar_normal=surface.plane[:3],
        T_cam_board=observation.pose.T_cam_board,
        cov=observation.pose.cov,
    )


def _meet_plane(points: Array, plane: Array) -> Array:
    """Intersect the ray of each point (N, 3) with the plane n.p + d = 0.

    A LiDAR errs along its rays, so the ray's intersection with the plane is the point it measured. A
    projection along the normal would move the point sideways, by the range error times the sine of the
    incidence. Where rays graze the plane, points are projected along its normal.
    """
    along = points @ plane[:3]
    is_grazing = -along < _GRAZING_COSINE * np.linalg.norm(points, axis=1)
    scale = -plane[3] / np.where(is_grazing, -1.0, along)
    straight = points - (along + plane[3])[:, None] * plane[:3]
    return np.asarray(np.where(is_grazing[:, None], straight, points * scale[:, None]))


def turn_about_z(vectors: Array, angle_rad: Array) -> Array:
    """Rotate vectors (M, 3) about the z axis by angles (M,)."""
    cosine, sine = np.cos(angle_rad), np.sin(angle_rad)
    x = cosine * vectors[:, 0] - sine * vectors[:, 1]
    y = sine * vectors[:, 0] + cosine * vectors[:, 1]
    return np.stack([x, y, vectors[:, 2]], axis=1)


def differentiate(normals: Array, levers: Array) -> Array:
    """Differentiate n . (g - R p - t) by the tangent of (R, t), translation before rotation.

    Args:
        normals: (..., 3) n.
        levers: (..., 3) R p, the points rotated but not translated.

    Returns:
        (..., 6).
    """
    normals, levers = np.broadcast_arrays(normals, levers)
    return -np.concatenate([normals, np.cross(levers, normals)], axis=-1)


def plane_residuals(f: CaptureFeatures, T_cam_lidar: Array, points: Array | None = None) -> Array:
    """Evaluate (1) for the points (N, 3) of a capture, by default its plane points: (..., N).

    Args:
        f: index of the capture.
        T_cam_lidar: (..., 4, 4).
        points: other points of the board, frame lidar.
    """
    moved = transform(T_cam_lidar, f.plane_points if points is None else points)
    return np.asarray((f.centre - moved) @ f.normal)


def end_residuals(f: CaptureFeatures, T_cam_lidar: Array) -> tuple[Array, NDArray[np.intp]]:
    """Evaluate (2) without shift for a capture's ring ends and their nearest edges.

    Args:
        f: index of the capture.
        T_cam_lidar: (..., 4, 4).

    Returns:
        Distances inside the edge (..., M), and the edges' numbers.
    """
    ends = ends_on_board(f, T_cam_lidar)
    edge = f.board.nearest_edge(ends)
    return distance_inside(f.board, ends, edge), edge


def distance_inside(board: Board, xy_m: Array, edge: NDArray[np.intp]) -> Array:
    """Compute the distance of points (..., 2 or 3) in the board's plane inside given edges: (...)."""
    anchors, normals = (of_edges[edge, :2] for of_edges in board.edges())
    return np.asarray(np.sum((anchors - xy_m[..., :2]) * normals, axis=-1))


def ends_on_board(f: CaptureFeatures, T_cam_lidar: Array) -> Array:
    """Transform a capture's ring ends to the frame of the camera's board: (..., M, 3)."""
    return transform(invert(f.T_cam_board) @ T_cam_lidar, f.edge_points)


def end_rows(f: CaptureFeatures, T_cam_lidar: Array) -> tuple[Array, Array, NDArray[np.intp]]:
    """Linearise (2) for a capture's ring ends.

    Returns:
        Values (M,), derivatives (M, 7) by tangent (6) and shift d, and the edges' numbers (M,).
    """
    inside_m, edge = end_residuals(f, T_cam_lidar)
    normals = f.edge_normals[edge]
    by_tangent = differentiate(normals, f.edge_points @ T_cam_lidar[:3, :3].T)
    return inside_m, np.column_stack([by_tangent, np.ones(len(edge))]), edge


def describe_background(lidar: LidarBoard) -> Array:
    """Describe the background of each ring end (M, 3).

    Columns are the share of the power of a background far behind, whether it blends, and the share of one
    that blends. The share acts in proportion to the beam's width: without rings, it is multiplied by that.
    """
    cosine = np.abs(lidar.edge_points @ lidar.plane[:3]) / np.linalg.norm(lidar.edge_points, axis=1)
    blends, echo = lidar.edge_behind_m < BLENDS_M * cosine, lidar.edge_echo
    if lidar.edge_beam_m is not None:
        echo = echo * lidar.edge_beam_m.sum(axis=1) / _HALF_BEAM_M
    return np.stack([echo * ~blends, blends, echo * blends], axis=1)
