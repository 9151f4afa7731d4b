"""The reported covariance: what the captures show, what the profile may have wrong, what checks contradict.

    cov = cov_session + sum_i sigma_i^2 S_i S_i^T + sum_c m_c m_c^T

with S_i the sensitivity to error i of the profile's lens or board, and m_c the move of the extrinsics that
would resolve contradiction c: a check that finds something else than the profile says, beyond both standard
deviations, widens the claim until it holds both.
"""

import math
from collections.abc import Iterator, Sequence
from typing import get_args

import numpy as np

from lce_rig.calibrate.options import Source
from lce_rig.calibrate.result import CalibrationEstimate, Sensitivity
from lce_rig.core.calibration import Contribution, Diagnostics
from lce_rig.core.geometry import Array, sigma_sizes
from lce_rig.judge.split_consistency import Contrast, objections
from lce_rig.rig import Rig

# Scales differ significantly beyond this many standard deviations.
_SURE = 3.0
# Two subsets of the captures that contradict each other: the result is the mean of both.
_HALF = 0.5
_CONTRADICTION = "contradiction_"


def summed_covariance(sensitivities: Sequence[Sensitivity]) -> Array:
    """Sum the covariances (6, 6) by errors of the profile's lens and board, or by contradictions."""
    return np.asarray(sum((each.covariance() for each in sensitivities), np.zeros((6, 6))))


def find_contradictions(
    estimate: CalibrationEstimate,
    scale: tuple[float, float] | None,
    pattern: tuple[Array, Array] | None,
    contrasts: Sequence[Contrast],
    rig: Rig,
) -> Iterator[Sensitivity]:
    """List the checks that contradict an estimate, each with the move of the extrinsics that resolves it.

    Args:
        estimate: with the sensitivities to errors of the profile.
        scale: of the camera's distances, with its standard deviation.
        pattern: (2,) offset from its place on the plate that contradicts the profile, with its covariance.
        contrasts: subsets of the captures that should agree.
        rig: targets and limits.
    """
    target, of_source = rig.calibration, {each.source: each for each in estimate.sensitivities}
    # The likelihood weighs the camera's distances and the LiDAR's itself.
    if of_source and scale is not None and estimate.method == "paper" and estimate.lens is not None:
        squares = of_source["square_size"]
        variance = scale[1] ** 2 + squares.sigma**2 + estimate.lens.focal_sigma**2
        if scale[0] ** 2 > _SURE**2 * variance:
            yield Sensitivity("scale", 1.0, scale[0] * squares.moves)
    if of_source and pattern is not None:
        yield Sensitivity("pattern", 1.0, pattern[0][None] @ of_source["pattern_offset"].moves)
    for contrast in objections(contrasts, target):
        # The result lies between both subsets; where the extrinsics change on the way, it lies a whole change
        # from one of the two that may hold now.
        share = 1.0 if contrast.is_change else _HALF
        yield Sensitivity(f"{contrast.first}_{contrast.second}", 1.0, share * contrast.apart[None])
    # Channels of one camera have one pose: the result lies between both.
    apart = estimate.channel_difference
    if apart is not None and target.excess(apart) > 1:
        yield Sensitivity("channels", 1.0, _HALF * apart.tangent[None])


def list_contributions(
    figures: Diagnostics,
    sensitivities: Sequence[Sensitivity],
    contradictions: Sequence[Sensitivity],
) -> tuple[Contribution, ...]:
    """List the causes of the reported standard deviations, the largest translation first."""
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
    return tuple(sorted(parts, key=lambda part: -part.sigma_translation_m))


def largest(causes: Sequence[Contribution], size: str) -> str:
    """Name the cause with the largest `sigma_rotation_deg` or `sigma_translation_m`; "" if none is known."""
    known = [each for each in causes if math.isfinite(getattr(each, size))]
    return max(known, key=lambda each: float(getattr(each, size))).source if known else ""


def measure_action(source: str) -> str:
    """Return the action of a finding against a cause; "" if more captures reduce it."""
    if source.startswith(_CONTRADICTION):
        return "resolve"
    return f"measure_{source}" if source in get_args(Source) else ""
