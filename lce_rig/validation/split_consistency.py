"""Compare extrinsics from two subsets of the captures: early and late, near and far, left and right.

Random subsets differ by noise. These subsets differ by more if a sensor moved during the session, or if the
intrinsics are wrong. The difference of random subsets is the reference.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from lce_rig.core.findings import Figure, Finding
from lce_rig.core.geometry import Array, tangent_sizes
from lce_rig.residuals.quadratics import Quadratics
from lce_rig.rig import CalibrationSettings, VerdictSettings
from lce_rig.validation.weighing import reason

# Fewer placements are not split.
_MIN_PLACEMENTS = 6
_MIN_SHARE = 3
_N_LOTS = 400
# Median of the chi-squared distribution with six degrees of freedom.
_MEDIAN_CHI2 = 5.348
# Differences beyond this many limits fail.
_FAIL = 2.0


@dataclass(frozen=True)
class Contrast:
    """Two subsets of the captures, calibrated separately.

    Attributes:
        first, second: their names, such as "near" and "far".
        rotation_deg, translation_m: angle and distance between their extrinsics.
        chance: probability that random subsets differ as much, in units of their noise.
        n_first: number of captures in the first subset.
        apart: (6,) tangent (translation m, rotation rad) from the second's extrinsics to the first's.
    """

    first: str
    second: str
    rotation_deg: float
    translation_m: float
    chance: float
    n_first: int
    apart: tuple[float, ...] = ()

    @property
    def is_change(self) -> bool:
        """Whether the subsets are the captures before and after one of them."""
        return self.first == "before"

    def excess(self, target: CalibrationSettings, limits: VerdictSettings) -> float:
        """Measure the difference in units of its limit; 0 if random subsets may differ as much."""
        if self.chance > limits.least_chance:
            return 0.0
        limit = limits.max_change if self.is_change else limits.max_contrast
        return target.in_targets(self.rotation_deg, self.translation_m) / limit


def contrast_halves(expansion: Quadratics, centres: Array, seed: int = 0) -> tuple[Contrast, ...]:
    """Compare subsets that should agree.

    Args:
        expansion: of F captures in the order in which they were taken, settled.
        centres: (F, 3) middle of the board in each, frame camera, m.
        seed: of the random subsets.

    Returns:
        Subsets before and after the capture of the largest change, near and far, left and right, upper and
        lower; none for fewer than 6 placements.
    """
    n_placements = len(expansion.groups)
    if n_placements < _MIN_PLACEMENTS:
        return ()
    order = np.argsort(np.random.default_rng(seed).random((_N_LOTS, n_placements)), axis=1)
    by_lot, _ = _chi2(expansion, (order < n_placements // 2) @ expansion.groups)
    unit = max(float(np.median(by_lot)) / _MEDIAN_CHI2, 1e-12)
    x, y, z = centres.T
    found = [_changed_on_the_way(expansion, unit)]
    for first, second, key in (
        ("near", "far", np.linalg.norm(centres, axis=1)),
        ("left", "right", x / z),
        ("upper", "lower", y / z),
    ):
        is_first = (np.argsort(np.argsort(key)) < len(key) // 2)[None].astype(np.float64)
        chi2, apart = _chi2(expansion, is_first)
        found.append(_contrast(first, second, apart[0], _tail(chi2[0] / unit), int(is_first.sum())))
    return tuple(found)


def _changed_on_the_way(expansion: Quadratics, unit: float) -> Contrast:
    """Find the capture from which on the results differ most, corrected for the number of captures tried."""
    n = len(expansion.gradients)
    cuts = np.arange(_MIN_SHARE, n - _MIN_SHARE + 1)
    chi2, apart = _chi2(expansion, (np.arange(n)[None] < cuts[:, None]).astype(np.float64))
    best = int(np.argmax(chi2))
    chance = min(len(cuts) * _tail(chi2[best] / unit), 1.0)
    return _contrast("before", "after", apart[best], chance, int(cuts[best]))


def _tail(chi2: float) -> float:
    from scipy.special import chdtrc

    return float(chdtrc(6, chi2))


def _chi2(expansion: Quadratics, shares: Array) -> tuple[Array, Array]:
    """Compare subsets (B, F) with the rest: squared distance (B,) in units of noise, tangents (B, 6)."""
    H_first = np.tensordot(shares, expansion.hessians, axes=1)
    g_first = shares @ expansion.gradients
    H_rest = expansion.hessians.sum(axis=0) - H_first
    g_rest = expansion.gradients.sum(axis=0) - g_first
    # A subset of few captures may leave a direction undetermined; a floor of 1 m and 1 rad keeps it finite.
    floor = np.eye(6)
    C_first, C_rest = np.linalg.inv(H_first + floor), np.linalg.inv(H_rest + floor)
    apart = -(C_first @ g_first[..., None] - C_rest @ g_rest[..., None])[..., 0]
    scaled = np.linalg.solve(C_first + C_rest, apart[..., None])[..., 0]
    return np.asarray(np.sum(apart * scaled, axis=1)), np.asarray(apart)


def _contrast(first: str, second: str, apart: Array, chance: float, n_first: int) -> Contrast:
    rotation_deg, translation_m = tangent_sizes(apart)
    return Contrast(first, second, rotation_deg, translation_m, chance, n_first, tuple(apart.tolist()))


def split_findings(
    contrasts: Sequence[Contrast],
    captures: Sequence[str],
    target: CalibrationSettings,
    limits: VerdictSettings,
) -> list[Finding]:
    """Find subsets that differ by more than the target and significantly more than random ones.

    Args:
        contrasts: see `contrast_halves`.
        captures: names, in the order in which they were taken.
        target: standard deviations to reach.
        limits: of the profile.
    """
    findings = []
    for c in contrasts:
        excess = c.excess(target, limits)
        if excess <= 1:
            continue
        apart = {"rotation_deg": c.rotation_deg, "translation_m": c.translation_m, "chance": c.chance}
        if c.is_change:
            figures: dict[str, Figure] = {"capture": captures[c.n_first], **apart}
            findings.append(reason("verdict.changed", figures, is_fail=excess > _FAIL))
        else:
            figures = {"first": c.first, "second": c.second, **apart}
            action = "near" if c.first == "near" else ""
            findings.append(reason("verdict.shares_differ", figures, is_fail=excess > _FAIL, action=action))
    return findings
