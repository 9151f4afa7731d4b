"""What is compared with a result before it is judged: checks that need the captures themselves."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from lce_rig.core.camera import Intrinsics
from lce_rig.core.findings import Finding
from lce_rig.core.geometry import Array
from lce_rig.extrinsics.estimate import CalibrationEstimate
from lce_rig.extrinsics.local_quadratic import SCALE, expand
from lce_rig.lens.lens_estimate import BoardView
from lce_rig.residuals.quadratics import Quadratics, jackknife_scatter
from lce_rig.rig import LidarSettings, Rig, VerdictSettings
from lce_rig.validation.intrinsics_check import IntrinsicsCheck, check_intrinsics
from lce_rig.validation.negative_control import NegativeControl, run_control
from lce_rig.validation.nuisances import Nuisances, estimate_nuisances
from lce_rig.validation.split_consistency import Contrast, contrast_halves

# Is the claimed uncertainty as large as captures drawn anew, left out singly or split in halves show?

_N_DRAWS = 300


@dataclass(frozen=True, eq=False)
class Spread:
    """How far resampled captures spread the extrinsics; covariances (6, 6) of the result from each way.

    Attributes:
        bootstrap: placements drawn with replacement.
        left_out: each placement left out in turn (jackknife).
        halves: random halves, their difference halved.
    """

    bootstrap: Array
    left_out: Array
    halves: Array

    def ratio_to(self, cov: Array) -> tuple[float, str]:
        """Compare with a claimed covariance (6, 6).

        Returns:
            By how much the largest of the three exceeds the claim, in standard deviations of rotation or of
            translation, and which it is.
        """
        ways = {
            "bootstrap": self.bootstrap,
            "left_out": self.left_out,
            "halves": self.halves,
        }
        ratios = {
            words: float(
                np.sqrt(
                    max(
                        np.trace(spread[part, part]) / np.trace(cov[part, part])
                        for part in (slice(0, 3), slice(3, 6))
                    )
                )
            )
            for words, spread in ways.items()
        }
        words = max(ratios, key=lambda name: ratios[name])
        return ratios[words], words


def resample(expansion: Quadratics, seed: int = 0) -> Spread:
    """Spread the extrinsic by resampling placements.

    Args:
        expansion: of the captures, settled.
        seed: of the draws.
    """
    rng = np.random.default_rng(seed)
    groups = expansion.groups
    n = len(groups)
    drawn = rng.multinomial(n, np.full(n, 1 / n), size=_N_DRAWS).astype(np.float64)
    # Draws of few different placements may leave a direction open.
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
    """Estimate a covariance (6, 6) by those nine tenths of the draws (B, 6) that lie nearest to the middle.

    A draw that happens to leave a direction nearly open lies anywhere, and says nothing of all captures.
    """
    about = tangents - np.median(tangents, axis=0)
    scale = np.median(np.abs(about), axis=0) + 1e-12
    far = np.linalg.norm(about / scale, axis=1)
    kept = about[far <= np.quantile(far, 0.9)]
    return np.asarray(kept.T @ kept / len(kept))


def widening(cov: Array, spread: Spread, limits: VerdictSettings) -> tuple[float, Finding | None]:
    """Compare a claimed covariance with the spread of resampled captures.

    Args:
        cov: (6, 6) as the method claims it.
        spread: of the same extrinsic.
        limits: of the verdict.

    Returns:
        By how many times standard deviations are to be widened, 1 where the claim is large enough; and a
        note that says why, else None.
    """
    ratio, way = spread.ratio_to(cov)
    if ratio <= limits.max_spread_ratio:
        return 1.0, None
    return ratio, Finding("verdict.widened", "note", figures={"ratio": ratio, "spread": way})


# Fewer placements leave nothing to be left out.
_MIN_PLACEMENTS = 4
# More images say no more about a lens that is wrong, and take their time.
_MAX_VIEWS = 40


@dataclass(frozen=True, eq=False)
class Validation:
    """What checks on its own captures found about an estimate.

    Attributes:
        cov: (6, 6) to report: the estimate's, widened where captures spread it farther than it claims.
        widened_by: by how many times the standard deviations were widened; 1 where they were not.
        remark: why; None if they were not.
        contrasts: shares of the captures that ought to agree.
        control: what happens to left-out captures when the result is moved.
        nuisances: what the captures share beside the extrinsics.
        intrinsics: the profile's, against those that the boards ask for; None if too few boards tell.
    """

    cov: Array
    widened_by: float
    remark: Finding | None
    contrasts: tuple[Contrast, ...]
    control: NegativeControl | None
    nuisances: Nuisances | None
    intrinsics: IntrinsicsCheck | None


def validate(
    estimate: CalibrationEstimate,
    rig: Rig,
    lidar: LidarSettings,
    lens: Intrinsics,
    views: Sequence[BoardView],
) -> Validation:
    """Check a result on its own captures.

    Args:
        estimate: the result of any method.
        rig: board, targets and limits.
        lidar: which errors its ranges may have.
        lens: of the camera.
        views: its images of the board, of the captures used.
    """
    board = rig.board.to_board()
    intrinsics = check_intrinsics(_thinned(views), lens, board) if views else None
    observations = [estimate.fitted[name] for name in estimate.used]
    expansion = expand(
        observations,
        board,
        estimate.T_cam_lidar,
        laser_bias_sigma_m=lidar.laser_bias_sigma_m,
        range_offset_sigma_m=lidar.range_offset_sigma_m,
    )
    if len(expansion.groups) < _MIN_PLACEMENTS:
        return Validation(estimate.cov, 1.0, None, (), None, None, intrinsics)
    settled = expansion.hold(SCALE).settled()
    # A cost recomputed scatters as it does itself: a claim is compared with the scatter of its own method.
    widened_by, remark = widening(estimate.cov, resample(estimate.expansion or settled), rig.verdict)
    cov = widened_by**2 * estimate.cov
    control = run_control(
        observations,
        board,
        estimate.T_cam_lidar,
        cov,
        settled,
        rig.calibration,
        rig.verdict.control_sigmas,
    )
    rings = np.unique(np.concatenate([observation.lidar.ring for observation in observations]))
    centres = np.array([observation.image.T_cam_board[:3, 3] for observation in observations])
    nuisances = estimate_nuisances(expansion, rings)
    contrasts = contrast_halves(settled, centres)
    return Validation(cov, widened_by, remark, contrasts, control, nuisances, intrinsics)


def _thinned(views: Sequence[BoardView]) -> list[BoardView]:
    every = -(-len(views) // _MAX_VIEWS)
    return list(views[::every])
