"""What is no part of the extrinsic but shifts it: scale, ranges, edges. Is it physically possible?

A range offset that all lasers share cannot be told from translation and scale; one laser's can.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lce_rig.calibrate.doubt import Doubt, Verdict
from lce_rig.calibrate.expansion import FIRST_RING, SCALE, SHIFT
from lce_rig.core.board import Board
from lce_rig.residuals.quadratics import Quadratics, jackknife_scatter
from lce_rig.rig import LidarSettings, VerdictSettings

# A scale that is off by this many times the limit leaves nothing to be used.
_SCALE_FAIL = 2.5
_SURE = 3.0
# Offsets that no profile needs to foresee.
_HARMLESS_M = 0.002


@dataclass(frozen=True)
class Nuisances:
    """Estimates beside the extrinsic, each with what captures left out one by one make of it.

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
) -> list[Doubt]:
    """Doubt a result that needs what cannot be: another scale, edges beyond the beam, ranges far off."""
    doubts = []
    off = abs(found.scale) - _SURE * found.scale_sigma
    if off > 0 and abs(found.scale) > limits.max_scale_error:
        verdict: Verdict = "fail" if off > _SCALE_FAIL * limits.max_scale_error else "marginal"
        doubts.append(Doubt(verdict, explain_scale(found, board)))
    if abs(found.edge_shift_m) - _SURE * found.edge_shift_sigma_m > limits.max_edge_shift_m:
        where = "beyond" if found.edge_shift_m > 0 else "within"
        text = (
            f"ring ends lie {1000 * abs(found.edge_shift_m):.0f} mm {where} the plate's edges, a beam is not "
            f"wider than {1000 * limits.max_edge_shift_m:.0f} mm: measure the plate"
        )
        doubts.append(Doubt("marginal", text))
    allowed_m = limits.max_prior_sigmas * max(lidar.laser_bias_sigma_m, _HARMLESS_M)
    if abs(found.laser_offset_m) > allowed_m:
        longer = "long" if found.laser_offset_m > 0 else "short"
        text = (
            f"ranges of laser ring {found.laser} look {1000 * abs(found.laser_offset_m):.0f} mm too "
            f"{longer}, the profile allows for {1000 * allowed_m:.0f} mm: correct them in the LiDAR's driver"
        )
        doubts.append(Doubt("marginal", text))
    return doubts


def explain_scale(found: Nuisances, board: Board) -> str:
    """Say by how much distances differ, and what the squares would measure if they are the cause."""
    longer = "longer" if found.scale > 0 else "shorter"
    percent = f"{100 * abs(found.scale):.1f} +- {100 * found.scale_sigma:.1f} %"
    square_mm = 1000 * board.square_m / (1 + found.scale)
    return (
        f"camera distances are {percent} {longer} than the LiDAR's: the squares measure {square_mm:.1f} mm "
        f"instead of {1000 * board.square_m:.1f} mm, or the intrinsics belong to another lens"
    )
