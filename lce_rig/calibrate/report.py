"""Turn a solution of any method into an estimate with residuals and figures."""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from lce_rig.calibrate.estimate import CalibrationEstimate
from lce_rig.calibrate.features import CaptureFeatures
from lce_rig.calibrate.metrics import capture_residual, summarise
from lce_rig.calibrate.observability import lever_arm
from lce_rig.calibrate.placements import group_placements
from lce_rig.core.board import Board
from lce_rig.core.calibration import Certificate
from lce_rig.core.diagnostics import Diagnostics
from lce_rig.core.findings import Refusal
from lce_rig.core.geometry import Array, sigma_sizes
from lce_rig.core.results import Observation

# For methods without a certificate.
NO_CERTIFICATE = Certificate(is_optimal=False, gap=float("inf"))


def with_parts(figures: Diagnostics, scatter: Array, systematic: Array) -> Diagnostics:
    """Add the sizes of both parts of a covariance, each (6 + k, 6 + k)."""
    (scatter_deg, scatter_m), (systematic_deg, systematic_m) = map(sigma_sizes, (scatter, systematic))
    return replace(
        figures,
        sigma_scatter_rotation_deg=scatter_deg,
        sigma_scatter_translation_m=scatter_m,
        sigma_systematic_rotation_deg=systematic_deg,
        sigma_systematic_translation_m=systematic_m,
    )


def report_estimate(
    T_cam_lidar: Array,
    cov: Array,
    observations: Sequence[Observation],
    features: Sequence[CaptureFeatures],
    board: Board,
    *,
    fitted: Sequence[Observation] | None = None,
    certificate: Certificate = NO_CERTIFICATE,
    held_out_m: Array | None = None,
    refused: Mapping[str, Refusal],
    diagnostics: Diagnostics,
) -> CalibrationEstimate:
    """Measure the residuals of extrinsics and assemble the estimate.

    Args:
        T_cam_lidar: (4, 4).
        cov: (6, 6) of it, tangent (translation m, rotation rad).
        observations: the F captures used, as measured; residuals are computed from these.
        features: of each.
        board: the board.
        fitted: the same as used in the method's cost, if it moves ring ends; as measured if None.
        certificate: of the minimum, if the method gives one.
        held_out_m: (F,) rms residual of each held-out capture, if the method computes it.
        refused: captures that the method rejected.
        diagnostics: the method's own figures.
    """
    held_out = np.full(len(observations), np.nan) if held_out_m is None else held_out_m
    residuals = tuple(
        capture_residual(T_cam_lidar, observation, board, float(error))
        for observation, error in zip(observations, held_out, strict=True)
    )
    metrics = summarise(residuals)
    figures = replace(
        diagnostics,
        # The paper's code counts every ring end twice, which halves its mean.
        paper_mee_m=metrics.mee_m / 2,
        held_out_m=float(np.mean(held_out)),
        n_placements=float(group_placements(observations).max() + 1),
    )
    return CalibrationEstimate(
        T_cam_lidar=T_cam_lidar,
        cov=cov,
        certificate=certificate,
        metrics=metrics,
        used=tuple(f.capture for f in features),
        refused=dict(sorted(refused.items())),
        observations={observation.capture: observation for observation in observations},
        fitted={observation.capture: observation for observation in fitted or observations},
        residuals=residuals,
        held_out_m=float(np.mean(held_out)),
        lever_m=lever_arm(features),
        diagnostics=figures,
    )
