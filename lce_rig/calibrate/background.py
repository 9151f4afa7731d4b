"""Ring ends and what is behind them: by how much the board seems to end sooner there.

A beam that meets both board and background reports the stronger echo: the brighter and nearer the background,
the sooner the board is lost. Where the background is so near that both echoes blend into one, its range lies
off the board's plane. Recordings show 1.5 cm times the background's share of the power (docs/method.md).
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
# What is believed before any ring end is seen: of the extrinsic, of the beam's width, and of the background's
# effect: by its share of the power, where it blends, and by its share where it blends.
_SIGMA_TRANSLATION_M, _SIGMA_ROTATION_RAD, _SIGMA_SHIFT_M = 0.02, 0.01, 0.015
_SIGMAS_EFFECT_M = (0.015, 0.006, 0.015)
_N_EFFECTS = len(_SIGMAS_EFFECT_M)
# Noise of a ring end, and beyond how many sigmas one counts less.
_END_SIGMA_M, _HUBER = 0.003, 1.5
_ROUNDS = 5
# Effects count if they would come about by chance in one session of a thousand.
_SURE_CHI2 = 16.3


def is_blended(lidar: LidarBoard) -> NDArray[np.bool_]:
    """Tell of each ring end (M,) whether something stands close behind the board."""
    return np.asarray(lidar.edge_behind_m < BLENDS_M)


def describe_background(lidar: LidarBoard) -> Array:
    """Tell what takes edges from each ring end: (M, 3), the background's share of the power where it is far
    behind, whether it blends, and its share where it does.
    """
    blends = is_blended(lidar)
    return np.stack([lidar.edge_echo * ~blends, blends, lidar.edge_echo * blends], axis=1)


def estimate_effects(
    observations: Sequence[Observation], features: Sequence[CaptureFeatures], T_cam_lidar: Array, board: Board
) -> Array:
    """Estimate by how much the board ends sooner for each column of `describe_background`: (3,) m.

    Zeros where that is not certain. Robust least squares over all ring ends, with the extrinsic, the beam's
    width and the effects unknown.

    Args:
        observations: F captures.
        features: of each.
        T_cam_lidar: (4, 4) near the truth.
        board: the board.
    """
    background = np.concatenate([describe_background(observation.lidar) for observation in observations])
    parts = [end_rows(f, T_cam_lidar, board, FIRST_RING) for f in features]
    inside = np.concatenate([r for r, _ in parts])
    # Inside distance = - (change of the extrinsic) - beam's width + effects.
    A = np.column_stack([-np.concatenate([J[:, : SHIFT + 1] for _, J in parts]), background])
    sigmas = [_SIGMA_TRANSLATION_M] * 3 + [_SIGMA_ROTATION_RAD] * 3 + [_SIGMA_SHIFT_M, *_SIGMAS_EFFECT_M]
    prior, x = np.diag(np.square(_END_SIGMA_M / np.array(sigmas))), np.zeros(len(sigmas))
    for _ in range(_ROUNDS):
        scaled = np.abs(inside - A @ x) / (_HUBER * _END_SIGMA_M)
        weights = 1 / np.maximum(scaled, 1.0)
        information = A.T @ (weights[:, None] * A) + prior
        x = np.linalg.solve(information, A.T @ (weights * inside))
    effects = x[-_N_EFFECTS:]
    cov = _END_SIGMA_M**2 * np.linalg.inv(information)[-_N_EFFECTS:, -_N_EFFECTS:]
    is_sure = float(effects @ np.linalg.solve(cov, effects)) > _SURE_CHI2
    return np.asarray(effects if is_sure else np.zeros(_N_EFFECTS))


def move_ends(
    observations: Sequence[Observation],
    features: Sequence[CaptureFeatures],
    T_cam_lidar: Array,
    board: Board,
    effects_m: Array,
) -> list[Observation]:
    """Move ring ends outwards by what the board ends sooner there: effects (3,) of `estimate_effects`."""
    moved = []
    for observation, f in zip(observations, features, strict=True):
        edge = nearest_edge(transform(f.T_board_cam @ T_cam_lidar, f.edge_points), board)
        outwards = f.edge_normals[edge] @ T_cam_lidar[:3, :3]
        shift = (describe_background(observation.lidar) @ effects_m)[:, None] * outwards
        lidar = replace(observation.lidar, edge_points=observation.lidar.edge_points + shift)
        moved.append(replace(observation, lidar=lidar))
    return moved
