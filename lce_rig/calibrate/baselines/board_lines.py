"""The plate's four border lines as a LiDAR shows them, and as a camera does."""

from dataclasses import dataclass

import numpy as np

from lce_rig.core.board import Board
from lce_rig.core.geometry import Array, exp_so3, invert, pose, transform
from lce_rig.core.results import Observation

INLIER_M = 0.03
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
