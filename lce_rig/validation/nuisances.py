"""What is no part of the extrinsic but shifts it: scale, ranges, edges. Is it physically possible?

A range offset that all lasers share cannot be told from translation and scale; one laser's can.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lce_rig.core.board import Board
from lce_rig.core.findings import Finding
from lce_rig.extrinsics.local_quadratic import FIRST_RING, SCALE, SHIFT
from lce_rig.residuals.quadratics import Quadratics, jackknife_scatter
from lce_rig.rig import LidarSettings, VerdictSettings
from lce_rig.validation.weighing import doubt

# A scale that is off by this many times the limit leaves nothing to be used.
_SCALE_FAIL = 2.5
_SURE = 3.0
# Offsets that no profile needs to foresee.
_HARMLESS_M = 0.002


@dataclass(frozen=True)
class Nuisances:
    """Estimates beside the extrinsics, each with what captures left out one by one make of it.

    Attributes:
        scale, scale_sigma: camera distances over LiDAR distances, less 1.
        edge_shift_m, edge_shift_sigma_m: how far ring ends lie beyond the plate's edges.
        laser_offset_m: by how much the ranges of one laser are too long, of the one farthest from their mean.
        laser: its ring.
    """

    scale: float
    scale_sigma: float
    edge_shift_m: float
    edge_shift_sigma_m: float
    laser_offset_m: float
    laser: int


def estimate_nuisances(expansion: Quadratics, rings: NDArray[np.int16]) -> Nuisances:
    """Estimate what all captures share, the scale without any prior.

    Args:
        expansion: by `expand`, not settled.
        rings: (L,) numbers of those that occur, ascending.
    """
    held = expansion.hold(SCALE)
    x = held.optimum()
    offsets = x[FIRST_RING:]
    about_mean = offsets - offsets.mean()
    laser = int(np.argmax(np.abs(about_mean)))
    return Nuisances(
        scale=float(expansion.optimum()[SCALE]),
        scale_sigma=_sigma(expansion, SCALE),
        edge_shift_m=float(x[SHIFT]),
        edge_shift_sigma_m=_sigma(held, SHIFT),
        laser_offset_m=float(about_mean[laser]),
        laser=int(rings[laser]),
    )


def _sigma(expansion: Quadratics, unknown: int) -> float:
    """Estimate a deviation from what single errors do, and from the estimates without each placement."""
    without = expansion.without_each()[:, [unknown]]
    scatter = jackknife_scatter(without - without.mean(axis=0))[0, 0]
    return float(np.sqrt(expansion.covariance()[unknown, unknown] + scatter))


def doubt_nuisances(
    found: Nuisances, board: Board, lidar: LidarSettings, limits: VerdictSettings
) -> list[Finding]:
    """Doubt a result that needs what cannot be: another scale, edges beyond the beam, ranges far off."""
    doubts = []
    off = abs(found.scale) - _SURE * found.scale_sigma
    if off > 0 and abs(found.scale) > limits.max_scale_error:
        square_m = board.square_m
        figures = {"scale": found.scale, "scale_sigma": found.scale_sigma}
        figures |= {"square_m": square_m / (1 + found.scale), "profile_square_m": square_m}
        doubts.append(doubt("verdict.scale", figures, is_fail=off > _SCALE_FAIL * limits.max_scale_error))
    if abs(found.edge_shift_m) - _SURE * found.edge_shift_sigma_m > limits.max_edge_shift_m:
        figures = {"shift_m": found.edge_shift_m, "limit_m": limits.max_edge_shift_m}
        doubts.append(doubt("verdict.edge_shift", figures, is_fail=False))
    allowed_m = limits.max_prior_sigmas * max(lidar.laser_bias_sigma_m, _HARMLESS_M)
    if abs(found.laser_offset_m) > allowed_m:
        figures = {"ring": found.laser, "offset_m": found.laser_offset_m, "limit_m": allowed_m}
        doubts.append(doubt("verdict.laser_offset", figures, is_fail=False))
    return doubts
