"""Is the claimed uncertainty as large as captures drawn anew, left out singly or split in halves show?"""

from dataclasses import dataclass

import numpy as np

from lce_rig.core.findings import Finding
from lce_rig.core.geometry import Array
from lce_rig.residuals.quadratics import Quadratics, jackknife_scatter
from lce_rig.rig import VerdictSettings

_N_DRAWS = 300


@dataclass(frozen=True, eq=False)
class Spread:
    """How far resampled captures spread the extrinsic; covariances (6, 6) of the result from each way.

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
