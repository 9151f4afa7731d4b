"""Compare extrinsics from two subsets of the captures: early and late, near and far, left and right.

Random subsets differ by noise. These subsets differ by more if a sensor moved during the session, or if the
intrinsics are wrong. The difference of random subsets is the reference. Two subsets that no order tells are
looked for: those of a sensor that moved to and fro.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from lce_rig.calibrate.quadratics import Quadratics
from lce_rig.core.findings import Finding
from lce_rig.core.geometry import Array, chance_of, tangent_sizes
from lce_rig.judge.findings import MOVED, SHARES_DIFFER, failing
from lce_rig.rig import CalibrationSettings

LEAST_CHANCE = 0.001
"""A difference of subsets of the captures is significant below this probability."""
# Largest differences of subsets, in targets: of earlier and later captures, of two cameras' relative pose by
# images, which are accurate enough to show any relevant change, and of boards at two places or two groups of
# captures, which nearly cancel in the whole.
_MAX_CHANGE, _MAX_OF_CAMERAS, _MAX_CONTRAST = 1.5, 1.0, 2.5
# Fewer placements are not split.
_MIN_PLACEMENTS = 6
_MIN_SHARE = 3
_N_LOTS = 400
# Median of the chi-squared distribution with six degrees of freedom.
MEDIAN_CHI2 = 5.348
# Its third quartile, which a capture exceeds that agrees with the others in one case of four.
_EACH_CHI2 = 7.841
# What a placement adds to the degrees of freedom of a noise measured by halves of few: errors of captures
# lie along few directions. With two, 0.1 % of 7,200 draws of 6 to 20 captures from ten sound recorded and
# simulated sessions show a change of the first or last two; with six 1 %, with a noise taken as known 2 %.
_FREEDOMS = 2
# Differences beyond this many limits fail.
_FAIL = 2.0
# Groups of captures: of fewer placements none are looked for, and a group has this share of them at least.
_MIN_GROUPED, _MIN_GROUP = 8, 0.2
_N_NULL, _N_STARTS, _N_ROUNDS = 100, 10, 8
_EULER = 0.5772
# Errors that placements have in common, such as those of a laser, gain a tenth more than random ones.
_COMMON = 1.1
# How much wider gains of sound sessions are distributed than those of errors exchanged within one of them. Of
# 2,160 draws of 8 to 20 captures from seven sound sessions, five of them recorded, 0.9 % have groups with it
# (simulated: none) and 15 % without; with every third capture turned by 1 deg, 83 % and 96 %.
_WIDER = 2.67
# Groups below this share of the least chance count from one target on: none of 470 draws of 8 to 16 captures
# from 24 sound sessions, 11 of them recorded, lies below it, and six below the least chance itself.
_CERTAIN = 0.1
# The gain of dividing n sorted normal variables at the best place, over n: 2 / pi and a little for the
# choice (100,000 draws of 8 to 60; its variance is 1 / n).
_MEAN_GAIN = 0.65
# A sensor that moved is looked for before this many of the last turns and after as many of the first; without
# the one that differs most, the others of that side differ from the rest at this chance.
_MIN_END, _DIFFERS = 2, 0.05


@dataclass(frozen=True, eq=False)
class Contrast:
    """Two subsets of the captures, calibrated separately: boards at two places, or a mounting and another.

    Attributes:
        first, second: their names, such as "near" and "far"; of mountings "before" and "after", or "group"
            and "rest" where no order tells them.
        apart: (6,) tangent (translation m, rotation rad) from the second's extrinsics to the first's.
        chance: probability that random subsets differ as much, in units of their noise.
        captures: the fewer ones, of a mounting of their own; none of boards at two places.
        place: "last" or "first" of these in time; "" where others lie between them.
        neighbour: the capture before the last ones, or after the first ones.
        is_noise_known: whether `chance` is that of a known noise, not of one measured by the captures.
        is_rejected: whether half of these captures or more were rejected as outliers.
    """

    first: str
    second: str
    apart: Array
    chance: float
    captures: tuple[str, ...] = ()
    place: str = ""
    neighbour: str = ""
    is_noise_known: bool = False
    is_rejected: bool = False

    @property
    def is_change(self) -> bool:
        """Whether the subsets are the captures before and after one of them."""
        return self.first == "before"

    @property
    def is_group(self) -> bool:
        """Whether the captures used are shared out without regard to their order."""
        return self.first == "group" and not self.is_rejected

    def excess(self, target: CalibrationSettings, max_change: float = _MAX_CHANGE) -> float:
        """Measure the difference in units of its limit; 0 if random subsets may differ as much."""
        if self.chance > LEAST_CHANCE:
            return 0.0
        limit = max_change if self.is_change else _MAX_CONTRAST
        if self.is_group and (self.is_noise_known or self.chance < _CERTAIN * LEAST_CHANCE):
            limit = 1.0
        return target.in_targets(*tangent_sizes(self.apart)) / limit


def contrast_halves(expansion: Quadratics, centres: Array, captures: Sequence[str]) -> tuple[Contrast, ...]:
    """Compare subsets that should agree.

    Args:
        expansion: of F captures in the order in which they were taken, settled.
        centres: (F, 3) middle of the board in each, frame camera, m.
        captures: their names.

    Returns:
        Subsets before and after the capture of the largest change, near and far, left and right, upper and
        lower; none for fewer than 6 placements.
    """
    n_placements = len(expansion.groups)
    if n_placements < _MIN_PLACEMENTS:
        return ()
    every = np.ones(len(expansion.gradients))
    unit = _noise(expansion, every)
    x, y, z = centres.T
    # The capture from which on the results differ most, corrected for the number of captures tried.
    n = len(every)
    cuts = np.arange(_MIN_SHARE, n - _MIN_SHARE + 1)
    chi2, apart = _chi2(expansion, (np.arange(n)[None] < cuts[:, None]).astype(np.float64))
    best = int(np.argmax(chi2))
    changes = [(chance_of(chi2[best] / unit, 6), apart[best], int(cuts[best]))]
    changes += [_change_at_end(expansion, cut) for cut in (2, n - 2)]
    chance, tangent, cut = min(changes, key=lambda change: change[0])
    found = [_change(tangent, min((len(cuts) + 2) * chance, 1.0), cut, captures)]
    for first, second, key in (
        ("near", "far", np.linalg.norm(centres, axis=1)),
        ("left", "right", x / z),
        ("upper", "lower", y / z),
    ):
        is_first = (np.argsort(np.argsort(key)) < len(key) // 2)[None].astype(np.float64)
        chi2, apart = _chi2(expansion, is_first)
        found.append(Contrast(first, second, apart[0], chance_of(chi2[0] / unit, 6)))
    return tuple(found)


def _change(
    apart: Array, chance: float, cut: int, captures: Sequence[str], *, is_noise_known: bool = False
) -> Contrast:
    """Compare the captures before a cut with those after it; the fewer ones are of another mounting."""
    if 2 * cut < len(captures):
        fewer, place, neighbour = captures[:cut], "first", captures[cut]
    else:
        fewer, place, neighbour = captures[cut:], "last", captures[cut - 1]
    return Contrast("before", "after", apart, chance, tuple(fewer), place, neighbour, is_noise_known)


def _change_at_end(expansion: Quadratics, cut: int) -> tuple[float, Array, int]:
    """Compare the first or last two captures with the others, in units of the noise of the others.

    After a sensor moved each of the two differs from the others; of an outlier and a sound capture one does.
    The noise is that of few placements, so that squared distances follow a distribution of Fisher.

    Returns:
        The probability that sound captures differ as much, 1 where one of them agrees with the others; the
        tangent (6,) from after to before; the cut.
    """
    from scipy.special import fdtrc

    n = len(expansion.gradients)
    is_first = (np.arange(n) < cut).astype(np.float64)
    is_end = is_first if 2 * cut < n else 1 - is_first
    unit = _noise(expansion, 1 - is_end)
    (surprise,), (apart,) = _chi2(expansion, is_first[None])
    alone = np.eye(n)[is_end > 0]
    each = [float(_chi2(expansion, one[None], 1 - is_end + one)[0][0]) / unit for one in alone]
    is_change = min(each) > _EACH_CHI2 and len(np.unique(expansion.placement[is_end > 0])) == 2
    n_rest = len(np.unique(expansion.placement[is_end == 0]))
    chance = float(fdtrc(6, _FREEDOMS * (n_rest - 1), surprise / unit / 6))
    return chance if is_change else 1.0, apart, cut


def _noise(expansion: Quadratics, among: Array) -> float:
    """Measure by random halves the noise of captures (F,), of which `among` is 1, in units of their cost."""
    groups = expansion.groups * among
    groups = groups[groups.any(axis=1)]
    order = np.argsort(np.random.default_rng(0).random((_N_LOTS, len(groups))), axis=1)
    by_lot, _ = _chi2(expansion, (order < len(groups) // 2) @ groups, among)
    return max(float(np.median(by_lot)) / MEDIAN_CHI2, 1e-12)


def find_groups(expansion: Quadratics, captures: Sequence[str]) -> tuple[Contrast, ...]:
    """Look for two groups of captures with extrinsics of their own, whatever their order.

    Placements are shared out so that two extrinsics x_1 and x_2 explain them best (k-means with the captures'
    costs), which gains

        s^2 = min_x C(x) - min_{x_1, x_2} sum_k min(C_k(x_1), C_k(x_2))

    over one. Noise gains as well: the same search is run on the errors that two extrinsics leave, exchanged
    between placements, axis by axis, with random signs.

    Args:
        expansion: of F captures, settled.
        captures: their names.

    Returns:
        The smaller group compared with the rest; none for fewer than 8 placements.
    """
    n = len(expansion.groups)
    if n < _MIN_GROUPED:
        return ()
    rng = np.random.default_rng(0)
    H = np.tensordot(expansion.groups, expansion.hessians, axes=1)
    g = expansion.groups @ expansion.gradients
    starts = rng.random((_N_NULL + 1, _N_STARTS, n)) < 0.5
    starts[:, 0] = np.arange(n) % 2 == 0
    gain, is_first, left = _share_out(g[None], H, starts[:1])
    values, axes = np.linalg.eigh(H)
    roots = np.sqrt(np.maximum(values, 1e-9 * values[:, -1:]))
    white = np.einsum("kji,kj->ki", axes, left[0]) / roots
    order = np.argsort(rng.random((_N_NULL, n, 6)), axis=1)
    signs = rng.choice([-1.0, 1.0], size=order.shape)
    drawn = signs * np.take_along_axis(white[None], order, axis=1)
    gains, _, left = _share_out(np.einsum("kij,bkj->bki", axes, roots * drawn), H, starts[1:])
    # The search makes errors smaller, the captures' own as much as those drawn.
    made_smaller = np.linalg.norm(np.einsum("kji,bkj->bki", axes, left) / roots) / np.linalg.norm(drawn)
    gains = gains * _COMMON / made_smaller
    # The largest of many gains follows a Gumbel distribution.
    width = _WIDER * float(gains.std(ddof=1)) * np.sqrt(6) / np.pi
    excess = (float(gain[0]) - gains.mean()) / max(width, 1e-12) + _EULER
    chance = float(-np.expm1(-np.exp(-excess)))
    smaller = is_first[0] if 2 * is_first[0].sum() <= n else ~is_first[0]
    shares = smaller @ expansion.groups
    _, apart = _chi2(expansion, shares[None])
    return (Contrast("group", "rest", apart[0], chance, _named(captures, shares)),)


def _named(captures: Sequence[str], shares: Array) -> tuple[str, ...]:
    """Name the captures whose share (F,) is not zero."""
    return tuple(name for name, share in zip(captures, shares, strict=True) if share)


def find_turned(turns: Array, centres: Array, groups: Array, captures: Sequence[str]) -> tuple[Contrast, ...]:
    """Look for boards turned differently about their lines of sight: two groups, and before and after.

    A turn of the image moves ring ends along the edges, which their own cost tells more accurately than
    their distances. The turns, sorted, are divided where the weighted sum of squares falls most, by G. For n
    turns of known noise and no groups, G has mean 0.65 n and variance n. In order of time, each fall is
    chi-squared with one degree of freedom.

    Args:
        turns: (2, F) angle of each capture, rad, and standard deviation.
        centres: (F, 3) middle of the board in each, frame camera, m.
        groups: (n, F) 1 where a capture shows a placement, whose captures have the same error.
        captures: their names.

    Returns:
        The smaller group compared with the rest, and the captures before the largest change with those after
        it; none for fewer than 8 placements.
    """
    if len(groups) < _MIN_GROUPED:
        return ()
    shares = groups / groups.sum(axis=1, keepdims=True)
    sight = centres.mean(axis=0) / np.linalg.norm(centres.mean(axis=0))
    boards = _Turns(shares @ turns[0], 1 / (shares @ turns[1] ** 2), sight)
    # Captures of one placement have one error, but each may be an outlier.
    each = _Turns(turns[0], shares.sum(axis=0) / turns[1] ** 2, sight)
    return boards.groups(groups, captures), each.change(captures)


class _Turns(NamedTuple):
    """Boards of n placements or captures turned about their lines of sight.

    Attributes:
        angles: (n,) rad.
        weights: (n,) of these.
        sight: (3,) the mean line of sight.
    """

    angles: Array
    weights: Array
    sight: Array

    def groups(self, groups: Array, captures: Sequence[str]) -> Contrast:
        """Compare the smaller of the two groups (n, F) that differ most with the rest."""
        order, n = np.argsort(self.angles), len(self.angles)
        cut, fall = self._divide(order, max(_MIN_SHARE, int(np.ceil(_MIN_GROUP * n))))
        smaller, rest = sorted((order[:cut], order[cut:]), key=len)
        # A gamma distribution of that mean and variance.
        chance = chance_of(2 * _MEAN_GAIN * fall, 2 * _MEAN_GAIN**2 * n)
        members = _named(captures, groups[smaller].any(axis=0))
        apart, _ = self._compare(smaller, rest)
        return Contrast("group", "rest", apart, chance, members, is_noise_known=True)

    def change(self, captures: Sequence[str]) -> Contrast:
        """Compare captures before and after the largest change."""
        order = np.arange(len(self.angles))
        cut, fall = self._divide(order, _MIN_END)
        smaller, rest = sorted((order[:cut], order[cut:]), key=len)
        # Beside an outlier, the others of its side agree with the rest.
        others = (np.delete(smaller, k) for k in range(len(smaller)))
        is_change = chance_of(min(self._compare(each, rest)[1] for each in others), 1) < _DIFFERS
        n_tried = len(order) + 1 - 2 * _MIN_END
        chance = min(n_tried * chance_of(fall, 1), 1.0) if is_change else 1.0
        apart, _ = self._compare(order[:cut], order[cut:])
        return _change(apart, chance, cut, captures, is_noise_known=True)

    def _divide(self, order: NDArray[np.intp], least: int) -> tuple[int, float]:
        """Divide boards in an order where the weighted sum of squares falls most.

        Returns:
            How many come first, at least so many and at most all but those; how far the sum falls.
        """
        w = self.weights[order]
        off = w * (self.angles[order] - np.average(self.angles, weights=self.weights))
        first, total = np.cumsum(w)[:-1], w.sum()
        falls = np.cumsum(off)[:-1] ** 2 * (1 / first + 1 / (total - first))
        cut = least + int(np.argmax(falls[least - 1 : len(w) - least]))
        return cut, float(falls[cut - 1])

    def _compare(self, first: NDArray[np.intp], second: NDArray[np.intp]) -> tuple[Array, float]:
        """Compare two subsets: tangent (6,) from the second to the first, its chi-squared."""
        parts = [(self.angles[part], self.weights[part]) for part in (first, second)]
        means = [np.average(angles, weights=weights) for angles, weights in parts]
        apart_rad, variance = means[0] - means[1], sum(1 / weights.sum() for _, weights in parts)
        return np.r_[np.zeros(3), apart_rad * self.sight], float(apart_rad**2 / variance)


def _share_out(g: Array, H: Array, starts: NDArray[np.bool_]) -> tuple[Array, NDArray[np.bool_], Array]:
    """Share n placements out over two extrinsics.

    Args:
        g: (B, n, 6) half gradients of B sessions.
        H: (n, 6, 6) half Hessians.
        starts: (B, R, n) which placements belong to the first, to begin with.

    Returns:
        The root of the best gain (B,), which placements belong to the first (B, n), and the half gradients
        (B, n, 6) at the extrinsics of each one's group.
    """
    (n_sessions, _, n), is_first, flat = starts.shape, starts, H.reshape(len(H), 36)
    least = max(_MIN_SHARE, int(np.ceil(_MIN_GROUP * n)))
    total_H, total_g, floor = H.sum(axis=0), g.sum(axis=1), np.eye(6)

    def costs(H_own: Array, g_own: Array) -> tuple[Array, Array]:
        x = -np.linalg.solve(H_own + floor, g_own[..., None])[..., 0]
        squares = (x[..., :, None] * x[..., None, :]).reshape(*x.shape[:-1], 36)
        return np.asarray(2 * x @ np.swapaxes(g, 1, 2) + squares @ flat.T), np.asarray(x)

    for is_last in (*[False] * _N_ROUNDS, True):
        H_first = (is_first @ flat).reshape(*is_first.shape[:2], 6, 6)
        g_first = is_first.astype(np.float64) @ g
        first, x_first = costs(H_first, g_first)
        second, x_second = costs(total_H - H_first, total_g[:, None] - g_first)
        if not is_last:
            rank = np.argsort(np.argsort(first - second, axis=-1), axis=-1)
            n_first = np.clip(np.sum(first < second, axis=-1), least, n - least)
            is_first = rank < n_first[..., None]
    one, _ = costs(np.broadcast_to(total_H, (n_sessions, 1, 6, 6)), total_g[:, None])
    gains = one.sum(axis=(1, 2))[:, None] - np.where(is_first, first, second).sum(axis=-1)
    best, each = np.argmax(gains, axis=1), np.arange(n_sessions)
    found = is_first[each, best]
    x = np.where(found[..., None], x_first[each, best][:, None], x_second[each, best][:, None])
    left = g + np.einsum("kij,bkj->bki", H, x)
    return np.sqrt(np.maximum(gains[each, best], 0.0)), found, left


def _chi2(expansion: Quadratics, shares: Array, among: Array | None = None) -> tuple[Array, Array]:
    """Compare subsets (B, F) with the rest of those `among` (F,): squared distances (B,), tangents (B, 6)."""
    among = np.ones(len(expansion.gradients)) if among is None else among
    H_first = np.tensordot(shares, expansion.hessians, axes=1)
    g_first = shares @ expansion.gradients
    H_rest = np.tensordot(among, expansion.hessians, axes=1) - H_first
    g_rest = among @ expansion.gradients - g_first
    # A subset of few captures may leave a direction undetermined; a floor of 1 m and 1 rad keeps it finite.
    floor = np.eye(6)
    C_first, C_rest = np.linalg.inv(H_first + floor), np.linalg.inv(H_rest + floor)
    apart = -(C_first @ g_first[..., None] - C_rest @ g_rest[..., None])[..., 0]
    scaled = np.linalg.solve(C_first + C_rest, apart[..., None])[..., 0]
    return np.asarray(np.sum(apart * scaled, axis=1)), np.asarray(apart)


def objections(
    contrasts: Sequence[Contrast], target: CalibrationSettings, max_change: float = _MAX_CHANGE
) -> list[Contrast]:
    """List the subsets that differ significantly and by more than their limit.

    A change at one capture makes two groups, too, two searches each may find groups or a change, and a change
    seen in rejected captures is seen in others: each is told once. Where boards at other places differ more
    significantly than earlier and later ones, a constant error of lens, board or ranges is the cause, and no
    sensor moved.
    """
    found = sorted((c for c in contrasts if c.excess(target, max_change) > 1), key=lambda each: each.chance)
    by_place = min((each.chance for each in found if not each.captures), default=1.0)
    moved = [each for each in found if each.is_rejected]
    used = [each for each in found if each.captures and not each.is_rejected]
    changes = [each for each in used if each.is_change and each.chance <= by_place]
    groups = [each for each in used if each.is_group and by_place == 1 and not changes]
    told = [*(moved or changes)[:1], *groups[:1]]
    return [each for each in contrasts if each in told or (each in found and not each.captures)]


def split_findings(
    contrasts: Sequence[Contrast],
    target: CalibrationSettings,
    of_cameras: str = "",
) -> list[Finding]:
    """Find subsets that differ by more than the target and significantly more than random ones.

    Args:
        contrasts: see `contrast_halves`.
        target: standard deviations to reach.
        of_cameras: names of two cameras where their relative pose is compared, not extrinsics.
    """
    findings = []
    max_change = _MAX_OF_CAMERAS if of_cameras else _MAX_CHANGE
    found = objections(contrasts, target, max_change)
    # Boards that contradict may be far, at the left and low: the places that differ most tell of them all.
    of_places = [each for each in found if not each.captures]
    others = sorted(of_places, key=lambda each: each.excess(target))[:-1]
    for c in found:
        if c in others:
            continue
        severity = failing(c.excess(target, max_change) > _FAIL)
        rotation_deg, translation_m = tangent_sizes(c.apart)
        if c.captures:
            # Where the first captures were taken before a sensor moved, the result holds since.
            is_rough = c.is_group or (c.is_rejected and c.place == "first")
            findings.append(
                MOVED(
                    of_cameras,
                    severity="warning" if is_rough else severity,
                    captures=c.captures,
                    n_captures=len(c.captures),
                    place=c.place,
                    neighbour=c.neighbour,
                    rotation_deg=rotation_deg,
                    translation_m=translation_m,
                    chance=c.chance,
                )
            )
        elif not of_cameras:
            findings.append(
                SHARES_DIFFER(
                    severity=severity,
                    action="near" if c.first == "near" else "",
                    first=c.first,
                    second=c.second,
                    others=tuple(f"{each.first} and {each.second}" for each in others[::-1]),
                    rotation_deg=rotation_deg,
                    translation_m=translation_m,
                    chance=c.chance,
                )
            )
    return findings
