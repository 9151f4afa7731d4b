"""The reported covariance: scatter of the captures, errors of the profile, and contradictions.

    cov = cov_session + sum_i sigma_i^2 S_i S_i^T + sum_c m_c m_c^T

with S_i the sensitivity to error i of the profile's lens or board, and m_c the displacement of the extrinsics
that would resolve contradiction c. The reported covariance then covers the extrinsics with and without it.
"""

import math
from collections.abc import Sequence

import numpy as np

from lce_rig.calibrate.result import BY_ALGORITHM_1, CalibrationEstimate, Sensitivity
from lce_rig.core.calibration import Contribution, Diagnostics
from lce_rig.core.geometry import Array, sigma_sizes
from lce_rig.rig import CalibrationSettings

OF_BOARD = ("square_size", "pattern_offset", "plate_size", "board_bow")
"""Errors of the profile that sessions share; each fits its own lens."""
_CONTRADICTION = "contradiction_"
_OTHER_ACTIONS = {BY_ALGORITHM_1: "other_method"}


def summed_covariance(sensitivities: Sequence[Sensitivity]) -> Array:
    """Sum the covariances (6, 6) by errors of the profile's lens and board, or by contradictions."""
    return np.asarray(sum((each.covariance() for each in sensitivities), np.zeros((6, 6))))


def channels_contradict(estimate: CalibrationEstimate, target: CalibrationSettings) -> list[Sensitivity]:
    """Return the displacement of channels of one camera that differ; their common pose lies between both."""
    apart = estimate.channel_difference
    if apart is None or target.excess(apart) <= 1:
        return []
    return [Sensitivity("channels", 1.0, apart.tangent[None] / 2)]


def list_contributions(
    figures: Diagnostics,
    sensitivities: Sequence[Sensitivity],
    contradictions: Sequence[Sensitivity],
) -> tuple[Contribution, ...]:
    """List the causes of the reported standard deviations, the largest in translation first."""
    parts = [
        Contribution("captures", figures.sigma_scatter_rotation_deg, figures.sigma_scatter_translation_m),
        Contribution(
            "lidar_ranges", figures.sigma_systematic_rotation_deg, figures.sigma_systematic_translation_m
        ),
        *(Contribution(each.source, *sigma_sizes(each.covariance())) for each in sensitivities),
        *(
            Contribution(_CONTRADICTION + each.source, *sigma_sizes(each.covariance()))
            for each in contradictions
        ),
    ]
    # Two cameras have no errors of a LiDAR.
    known = [part for part in parts if math.isfinite(part.sigma_translation_m)]
    return tuple(sorted(known, key=lambda part: -part.sigma_translation_m))


def largest(causes: Sequence[Contribution], size: str) -> str:
    """Return the source of the largest `sigma_rotation_deg` or `sigma_translation_m`; "" if unknown."""
    known = [each for each in causes if math.isfinite(getattr(each, size))]
    return max(known, key=lambda each: float(getattr(each, size))).source if known else ""


def measure_action(source: str) -> str:
    """Return the action against a source of uncertainty; "" if more captures reduce it."""
    if source.startswith(_CONTRADICTION):
        return "resolve"
    return f"measure_{source}" if source in ("intrinsics", *OF_BOARD) else _OTHER_ACTIONS.get(source, "")
