"""Nuisance parameters that shift the extrinsics, scale, ranges and edges: are they physically possible?

A range offset common to all lasers cannot be separated from translation and scale; one laser's can.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lce_rig.calibrate.quadratics import Quadratics, jackknife_scatter
from lce_rig.calibrate.result import CalibrationEstimate
from lce_rig.core.board import Board
from lce_rig.core.findings import Finding
from lce_rig.judge.findings import EDGE_SHIFT, LASER_OFFSET, SCALE_OFF, failing
from lce_rig.judge.local_quadratic import FIRST_RING, SCALE, SHIFT
from lce_rig.rig import LidarSettings, VerdictSettings

# A scale error of this many times the limit fails.
_SCALE_FAIL = 2.5
_SURE = 3.0
# Offsets allowed for every profile.
_HARMLESS_M = 0.002


@dataclass(frozen=True)
class Nuisances:
    """Estimates of nuisance parameters with their leave-one-out standard deviations.

    Attributes:
        scale, scale_sigma: camera distances over LiDAR distances, less 1.
        edge_shift_m, edge_shift_sigma_m: distance of ring ends beyond the plate's edges.
        laser_offset_m: range error, positive for too long, of the laser farthest from their mean.
        laser: its ring.
    """

    scale: float
    scale_sigma: float
    edge_shift_m: float
    edge_shift_sigma_m: float
    laser_offset_m: float
    laser: int


def estimate_nuisances(expansion: Quadratics, rings: NDArray[np.int16]) -> Nuisances:
    """Estimate the nuisance parameters common to all captures, the scale without a prior.

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
    """Estimate a standard deviation from single errors and from leave-one-out estimates."""
    without = expansion.without_each()[:, [unknown]]
    scatter = jackknife_scatter(without - without.mean(axis=0))[0, 0]
    return float(np.sqrt(expansion.covariance()[unknown, unknown] + scatter))


def nuisance_findings(
    found: Nuisances | None,
    estimate: CalibrationEstimate,
    board: Board,
    lidar: LidarSettings,
    limits: VerdictSettings,
) -> list[Finding]:
    """Find implausible nuisance parameters: a scale error, edges beyond the beam, large range errors.

    The likelihood estimates the squares, with which it is consistent: their size is a note then.
    """
    if found is None:
        return []
    findings, is_weighed = [], estimate.method == "ml" and estimate.lens is not None
    off = abs(found.scale) - _SURE * found.scale_sigma
    if off > 0 and abs(found.scale) > limits.max_scale_error:
        findings.append(
            SCALE_OFF(
                severity="note" if is_weighed else failing(off > _SCALE_FAIL * limits.max_scale_error),
                scale=found.scale,
                scale_sigma=found.scale_sigma,
                square_m=board.square_m / (1 + found.scale),
                profile_square_m=board.square_m,
            )
        )
    if abs(found.edge_shift_m) - _SURE * found.edge_shift_sigma_m > limits.max_edge_shift_m:
        findings.append(EDGE_SHIFT(shift_m=found.edge_shift_m, limit_m=limits.max_edge_shift_m))
    allowed_m = limits.max_prior_sigmas * max(lidar.laser_bias_sigma_m, _HARMLESS_M)
    if abs(found.laser_offset_m) > allowed_m:
        findings.append(LASER_OFFSET(ring=found.laser, offset_m=found.laser_offset_m, limit_m=allowed_m))
    return findings
