"""Checks of a result on its own captures, before the verdict.

A covariance is compared with the scatter of its own cost. Subsets of captures, the negative control and the
nuisance parameters are judged by another one (`local_quadratic.py`), on purpose: the likelihood
gives contradicting captures less weight, and so hides them from a check by its own cost. By that cost, two
groups of captures that disagree by 1.1 and 1.2 deg (acfr_vlp16, os1_64) are not found; acfr_vlp16, 1.0 deg
and 51 mm from its reference, would be reported to 0.22 deg and 10 mm instead of 0.59 deg and 24 mm.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from lce_rig.calibrate.observations import group_placements
from lce_rig.calibrate.quadratics import Quadratics, jackknife_scatter
from lce_rig.calibrate.result import CalibrationEstimate
from lce_rig.core.calibration import Contribution
from lce_rig.core.camera import Intrinsics
from lce_rig.core.findings import Finding
from lce_rig.core.geometry import Array
from lce_rig.core.results import Observation
from lce_rig.judge.contributions import (
    KnownBetter,
    find_contradictions,
    known_better,
    list_contributions,
    profile_covariance,
)
from lce_rig.judge.findings import WIDENED
from lce_rig.judge.intrinsics_check import IntrinsicsCheck, compare_with_given
from lce_rig.judge.laser_angles import estimate_angles
from lce_rig.judge.local_quadratic import SCALE, expand
from lce_rig.judge.negative_control import NegativeControl, run_control, run_control_with_constants
from lce_rig.judge.nuisances import Nuisances, estimate_nuisances
from lce_rig.judge.rejected_captures import find_moved
from lce_rig.judge.split_consistency import Contrast, contrast_halves, find_groups, objections
from lce_rig.rig import LidarSettings, Rig, VerdictSettings

_N_DRAWS = 300


@dataclass(frozen=True, eq=False)
class Spread:
    """Spread of the extrinsics under resampling: covariances (6, 6) of the result from each method.

    Attributes:
        bootstrap: placements drawn with replacement.
        left_out: each placement left out in turn (jackknife).
        halves: random halves, their difference halved.
    """

    bootstrap: Array
    left_out: Array
    halves: Array

    def ratio_to(self, cov: Array) -> tuple[float, str]:
        """Compare with a reported covariance (6, 6).

        Returns:
            Largest ratio of the three to the reported standard deviation, in rotation or translation, and the
            name of its method.
        """
        ways = {"bootstrap": self.bootstrap, "left_out": self.left_out, "halves": self.halves}
        ratios = {
            name: max(np.trace(spread[k, k]) / np.trace(cov[k, k]) for k in (slice(0, 3), slice(3, 6)))
            for name, spread in ways.items()
        }
        widest = max(ratios, key=lambda name: ratios[name])
        return float(np.sqrt(ratios[widest])), widest


def resample(expansion: Quadratics, seed: int = 0) -> Spread:
    """Estimate the spread of the extrinsics by resampling placements.

    Args:
        expansion: of the captures, settled.
        seed: of the draws.
    """
    rng = np.random.default_rng(seed)
    groups = expansion.groups
    n = len(groups)
    drawn = rng.multinomial(n, np.full(n, 1 / n), size=_N_DRAWS).astype(np.float64)
    # Samples of few different placements may leave a direction undetermined.
    drawn = drawn[np.count_nonzero(drawn, axis=1) >= min(n, 4)]
    halves = (np.argsort(rng.random((_N_DRAWS, n)), axis=1) < n // 2).astype(np.float64)
    without = expansion.without_each()[:, :6]
    apart = (expansion.solve(halves @ groups) - expansion.solve((1 - halves) @ groups))[:, :6] / 2
    return Spread(
        bootstrap=_robust_cov(expansion.solve(drawn @ groups)[:, :6]),
        left_out=jackknife_scatter(without - without.mean(axis=0)),
        halves=_robust_cov(np.concatenate([apart, -apart])),
    )


def _robust_cov(tangents: Array) -> Array:
    """Estimate a covariance (6, 6) by the nine tenths of the samples (B, 6) nearest to the middle.

    Samples that nearly leave a direction undetermined are outliers and do not represent all captures.
    """
    about = tangents - np.median(tangents, axis=0)
    scale = np.median(np.abs(about), axis=0) + 1e-12
    far = np.linalg.norm(about / scale, axis=1)
    kept = about[far <= np.quantile(far, 0.9)]
    return np.asarray(kept.T @ kept / len(kept))


def widening(cov: Array, spread: Spread, limits: VerdictSettings) -> tuple[float, Finding | None]:
    """Compare a reported covariance with the spread of resampled captures.

    Args:
        cov: (6, 6) of the method.
        spread: of the same extrinsics.
        limits: of the verdict.

    Returns:
        The factor by which to widen standard deviations, 1 if they are large enough, and a note with the
        reason, else None.
    """
    ratio, way = spread.ratio_to(cov)
    if ratio <= limits.max_spread_ratio:
        return 1.0, None
    return ratio, WIDENED(ratio=ratio, spread=way)


# Fewer placements do not allow leave-one-out.
_MIN_PLACEMENTS = 4


@dataclass(frozen=True, eq=False)
class Validation:
    """Results of checks of an estimate on its own captures.

    Attributes:
        cov: (6, 6) to report, of extrinsics used with the session's intrinsics: the estimate's, widened if
            resampling spreads it farther, with errors of the profile and what checks contradict.
        cov_agreed: (6, 6) the same without what checks contradict.
        cov_shared: (6, 6) the part of `cov` from errors of the profile's board and LiDAR.
        contributions: its causes, the largest first.
        known_better: what the session's boards determine better than the profile.
        widened_by: factor by which the standard deviations were widened; 1 if they were not.
        remark: why; None if they were not.
        contrasts: subsets of the captures that should agree.
        control: residuals of held-out captures when the result is moved.
        nuisances: the nuisance parameters.
        laser_angles: errors of the lasers' angles in deg, as `estimate_angles`.
        intrinsics: the profile's compared with those fitted to the boards; None for too few boards.
    """

    cov: Array
    cov_agreed: Array
    cov_shared: Array
    contributions: tuple[Contribution, ...]
    known_better: tuple[KnownBetter, ...]
    widened_by: float
    remark: Finding | None
    contrasts: tuple[Contrast, ...]
    control: NegativeControl | None
    nuisances: Nuisances | None
    laser_angles: Mapping[str, float]
    intrinsics: IntrinsicsCheck | None


def validate(
    estimate: CalibrationEstimate,
    rig: Rig,
    lidar: LidarSettings,
    lens: Intrinsics,
    rejected: Sequence[Observation] = (),
) -> Validation:
    """Check a result on its own captures.

    Args:
        estimate: the result of any method.
        rig: board, targets and limits.
        lidar: its range error settings.
        lens: of the camera, as the profile says.
        rejected: captures in which both sensors see the board, that the estimate does not use.
    """
    board, known = rig.board.to_board(), estimate.sensitivities
    fitted = None if estimate.lens is None else estimate.lens.estimate
    intrinsics = None if fitted is None else compare_with_given(fitted, lens, board)[0]
    widened_by, remark, control, nuisances = 1.0, None, None, None
    contrasts: tuple[Contrast, ...] = ()
    laser_angles: Mapping[str, float] = {}
    observations = [estimate.fitted[name] for name in estimate.used]
    expansion = expand(
        observations,
        board,
        estimate.T_cam_lidar,
        laser_bias_sigma_m=lidar.laser_bias_sigma_m,
        range_offset_sigma_m=lidar.range_offset_sigma_m,
    )
    if len(expansion.groups) >= _MIN_PLACEMENTS:
        settled = expansion.hold(SCALE).settled()
        # Compare a covariance with the scatter of its own method, as another cost scatters differently.
        widened_by, remark = widening(estimate.cov, resample(estimate.cost or settled), rig.verdict)
        cov, moved = widened_by**2 * estimate.cov, (rig.calibration, rig.verdict.control_sigmas)
        if estimate.method == "ml":
            with_constants = _with_prior_of_scale(expansion, estimate)
            control = run_control_with_constants(with_constants, cov, estimate.lever_m, *moved)
        else:
            control = run_control(observations, board, estimate.T_cam_lidar, cov, settled, *moved)
        rings = np.unique(np.concatenate([observation.lidar.ring for observation in observations]))
        centres = np.array([observation.image.T_cam_board[:3, 3] for observation in observations])
        of_rejected = find_moved(observations, rejected, board, estimate.T_cam_lidar, lidar)
        contrasts = (*of_rejected, *contrast_halves(settled, centres), *find_groups(settled))
        nuisances = estimate_nuisances(expansion, rings)
        # Captures of another mounting would look like other angles.
        apart = {
            name
            for each in objections(contrasts, rig.calibration, rig.verdict)
            for name in each.minority(estimate.used)
        }
        agreeing = [observation for observation in observations if observation.capture not in apart]
        if lidar.has_rings and len(set(group_placements(agreeing))) >= _MIN_PLACEMENTS:
            laser_angles = estimate_angles(agreeing, board, estimate.T_cam_lidar, lidar)
    contradictions = list(find_contradictions(estimate, nuisances, contrasts, control, rig))
    cov_agreed = widened_by**2 * estimate.cov + profile_covariance(known)
    return Validation(
        cov=cov_agreed + sum(each.cov for each in contradictions),
        cov_agreed=cov_agreed,
        # Each session has fitted its own lens.
        cov_shared=profile_covariance([each for each in known if each.source != "intrinsics"]),
        contributions=list_contributions(estimate.diagnostics, widened_by, known, contradictions),
        known_better=known_better(estimate, nuisances),
        widened_by=widened_by,
        remark=remark,
        contrasts=contrasts,
        control=control,
        nuisances=nuisances,
        laser_angles=laser_angles,
        intrinsics=intrinsics,
    )


def _with_prior_of_scale(expansion: Quadratics, estimate: CalibrationEstimate) -> Quadratics:
    """Let the camera's scale be wrong as focal length and squares may be."""
    sigmas = [each.sigma for each in estimate.sensitivities if each.source == "square_size"]
    sigmas += [] if estimate.lens is None else [estimate.lens.focal_sigma]
    if not any(sigmas):
        return expansion.hold(SCALE)
    prior = expansion.prior.copy()
    prior[SCALE, SCALE] = 1 / sum(sigma**2 for sigma in sigmas)
    return replace(expansion, prior=prior)
