"""Ring ends where something stands close behind the board, and by how much the board seems to end sooner.

A beam that the board fills in part comes back as a blend of both surfaces, off the board's plane, and is lost
to the board: it ends sooner by 2 to 4 mm on recordings, by up to 10 mm in simulation with a person behind it
(docs/method.md).
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from lce_rig.calibrate.expansion import FIRST_RING, SHIFT, end_rows, nearest_edge
from lce_rig.calibrate.features import CaptureFeatures
from lce_rig.core.board import Board
from lce_rig.core.geometry import Array, transform
from lce_rig.core.results import LidarBoard, Observation

BLENDS_M = 0.35
"""Echoes from surfaces nearer to each other than this blend into one."""
# A smaller share of all ring ends does less harm than an uncertain correction.
_HARMFUL_SHARE = 0.25
# What is believed before any ring end is seen: of the extrinsic, of the beam's width, of the change of it.
_SIGMA_TRANSLATION_M, _SIGMA_ROTATION_RAD, _SIGMA_SHIFT_M, _SIGMA_SOONER_M = 0.02, 0.01, 0.015, 0.006
# Noise of a ring end, and beyond how many sigmas one counts less.
_END_SIGMA_M, _HUBER = 0.003, 1.5
_ROUNDS = 5
# A difference counts from so many of its standard deviations on.
_SURE = 3.0


def is_blended(lidar: LidarBoard) -> NDArray[np.bool_]:
    """Tell of each ring end (M,) whether something stands close behind the board."""
    return np.asarray(lidar.edge_behind_m < BLENDS_M)


def estimate_sooner(
    observations: Sequence[Observation], features: Sequence[CaptureFeatures], T_cam_lidar: Array, board: Board
) -> float:
    """Estimate by how much the board seems to end sooner at blended ring ends, m.

    0 where they are few, or the difference is not certain.

    Robust least squares over all ring ends, with the extrinsic, the beam's width and the difference unknown.

    Args:
        observations: F captures.
        features: of each.
        T_cam_lidar: (4, 4) near the truth.
        board: the board.
    """
    blended = np.concatenate([is_blended(observation.lidar) for observation in observations])
    if len(blended) == 0 or blended.mean() < _HARMFUL_SHARE:
        return 0.0
    parts = [end_rows(f, T_cam_lidar, board, FIRST_RING) for f in features]
    inside = np.concatenate([r for r, _ in parts])
    # Inside distance = - (change of the extrinsic) - beam's width + difference where blended.
    A = np.column_stack([-np.concatenate([J[:, : SHIFT + 1] for _, J in parts]), blended])
    sigmas = [_SIGMA_TRANSLATION_M] * 3 + [_SIGMA_ROTATION_RAD] * 3 + [_SIGMA_SHIFT_M, _SIGMA_SOONER_M]
    prior, x = np.diag(np.square(_END_SIGMA_M / np.array(sigmas))), np.zeros(len(sigmas))
    for _ in range(_ROUNDS):
        scaled = np.abs(inside - A @ x) / (_HUBER * _END_SIGMA_M)
        weights = 1 / np.maximum(scaled, 1.0)
        information = A.T @ (weights[:, None] * A) + prior
        x = np.linalg.solve(information, A.T @ (weights * inside))
    sigma_m = _END_SIGMA_M * float(np.sqrt(np.linalg.inv(information)[-1, -1]))
    return float(x[-1]) if x[-1] > _SURE * sigma_m else 0.0


def move_blended_ends(
    observations: Sequence[Observation],
    features: Sequence[CaptureFeatures],
    T_cam_lidar: Array,
    board: Board,
    sooner_m: float,
) -> list[Observation]:
    """Move blended ring ends outwards by what the board ends sooner there."""
    moved = []
    for observation, f in zip(observations, features, strict=True):
        edge = nearest_edge(transform(f.T_board_cam @ T_cam_lidar, f.edge_points), board)
        outwards = f.edge_normals[edge] @ T_cam_lidar[:3, :3]
        shift = sooner_m * is_blended(observation.lidar)[:, None] * outwards
        lidar = replace(observation.lidar, edge_points=observation.lidar.edge_points + shift)
        moved.append(replace(observation, lidar=lidar))
    return moved
