"""Whether the extrinsics of one camera and LiDAR changed between sessions: steps, slow drift, odd sessions.

Tangents x_k of the sessions from one pose, with covariances C_k and weights W_k = C_k^-1, are constant but
for noise. For a step before session k, m_b and m_a the weighted means before and from it on,

    L_k = (m_a - m_b)^T (W_b^-1 + W_a^-1)^-1 (m_a - m_b),    W_b, W_a the summed weights

is chi-squared with 6 degrees of freedom if nothing changed. So are the statistics of one odd session against
all others, and of a slope b in x = a + b t. Each is compared with one limit, for which the probability that
any of them exceeds it in an unchanged fleet is `FALSE_ALARMS` at most.

A cumulative sum [1] of each axis adds up what no single test shows. z_k is the difference of a session from
the weighted mean of those before it, in units of its standard deviation:

    S_k = max(0, S_{k-1} + z_k - 1/2)    and the same of -z_k

[1] D. Siegmund, Sequential Analysis, 1985: mean number of sessions between false alarms.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from lce_rig.core.geometry import Array
from lce_rig.scene.alignment import AXES, IS_ROTATION
from lce_rig.scene.drift import NEARLY, AxisDrift

Kind = Literal["step", "drift", "odd"]

FALSE_ALARMS, FALSE_CUSUMS = 0.04, 0.01
"""Probability that a fleet in which nothing changed gives a change, and that a cumulative sum does."""
MISSED = 0.05
"""Share of the trials in which the smallest change is not seen."""
_ALLOWANCE = 0.5
# What remains of a change is noise above this probability.
_NOISE = 0.01
# A sensor is named if its turning about itself explains so much more, in chi-squared.
_SENSOR_KNOWN = 9.0
_FEWEST_FOR_SLOPE = 4
_MOST_CHANGES = 50
# 0.01 mm and 0.0006 deg: keep the weights of any table finite.
_LEAST = 1e-10 * np.eye(6)


@dataclass(frozen=True, eq=False)
class Sessions:
    """Sessions of several series, one below the other, each in the order of time.

    Attributes:
        starts: (G + 1,) the first session of each series, and the number of sessions.
        tangents: (N, 6) from one pose of each series, m and rad.
        cov: (N, 6, 6) of what scatters between sessions.
        shared: (N, 6, 6) of errors that sessions of one profile have in common.
        profile: (N,) a number for each profile.
        days: (N,) time.
    """

    starts: NDArray[np.intp]
    tangents: Array
    cov: Array
    shared: Array
    profile: NDArray[np.intp]
    days: Array

    @cached_property
    def weights(self) -> Array:
        """(N, 6, 6) inverse covariances."""
        return _inverse(self.cov + _LEAST)

    def part(self, first: int, last: int) -> "Sessions":
        """Take sessions of one series."""
        own = slice(first, last)
        return Sessions(
            np.array([0, last - first]),
            self.tangents[own],
            self.cov[own],
            self.shared[own],
            self.profile[own],
            self.days[own],
        )


@dataclass(frozen=True, eq=False)
class Statistics:
    """Chi-squared of each change, 6 degrees of freedom; zero where it cannot be tested.

    Attributes:
        step: (N,) before each session.
        odd: (N,) of each session against all others.
        slope: (G,) of a slow drift.
    """

    step: Array
    odd: Array
    slope: Array


@dataclass(frozen=True, eq=False)
class References:
    """Each session against the weighted mean of those before it, and the mean of all.

    Attributes:
        apart: (N, 6) difference, m and rad; NaN for the first session of a part.
        sigma: (N, 6) standard deviation of it.
        chi2: (N,) of it.
        cusum: (N, 6) the larger of both cumulative sums, with its sign.
        mean, cov: (G, 6), (G, 6, 6) of all, by part.
        smallest: (G, 6) change along each axis that one more session like the last would show.
    """

    apart: Array
    sigma: Array
    chi2: Array
    cusum: Array
    mean: Array
    cov: Array
    smallest: Array


@dataclass(frozen=True)
class Found:
    """One change of a series.

    Attributes:
        kind: "step", "drift" or "odd".
        session: the first one after a step, the odd one, or the first one of a drift; counted in its series.
        end: the session after the last one that it concerns.
        earliest, latest: sessions before which the step may lie, 95 %.
        chi2: of the change.
        tangent: (6,) the change, of a drift from its first to its last session; m and rad.
        axes: that explain it, the largest share first.
        sensor: "camera" or "lidar" if one of them turned about itself; "" if that cannot be told.
        n_before, n_after: sessions behind both sides of a step.
    """

    kind: Kind
    session: int
    end: int
    earliest: int
    latest: int
    chi2: float
    tangent: tuple[float, ...]
    axes: tuple[AxisDrift, ...]
    sensor: str
    n_before: int
    n_after: int


@dataclass(frozen=True)
class Limits:
    """Limits for a fleet.

    Attributes:
        chi2: of the statistics of changes.
        cusum: of cumulative sums.
        smallest_chi2: non-centrality of a change that is seen in 95 % of the trials.
    """

    chi2: float
    cusum: float
    smallest_chi2: float

    @classmethod
    def of(cls, lengths: NDArray[np.intp]) -> "Limits":
        """Choose limits for series of so many sessions each.

        There are K - 1 steps, K - 2 odd sessions and a slope in K sessions, and 12 K cumulative sums, each of
        which exceeds h in one of 2 (exp(h + 1.166) - h - 2.166) sessions [1].
        """
        from scipy.optimize import brentq
        from scipy.special import chdtri, chndtrinc

        several = lengths[lengths > 1]
        n_tests = int((2 * several - 2).sum())
        if n_tests == 0:
            return cls(np.inf, np.inf, np.inf)
        chi2 = float(chdtri(6, FALSE_ALARMS / n_tests))
        wanted = 12.0 * int(several.sum()) / FALSE_CUSUMS
        cusum = float(brentq(lambda h: np.log(2 * (np.exp(h + 1.166) - h - 2.166)) - np.log(wanted), 1, 60))
        return cls(chi2, cusum, float(chndtrinc(chi2, 6, MISSED)))


def scale_of(sessions: Sessions) -> tuple[Array, int]:
    """Find by how much sessions scatter more than their covariances say.

    Differences of successive sessions of one profile, in units of their standard deviations, have the median
    0.6745 by axis if covariances are right, and the median 5.35 of their chi-squared. Few robots that moved
    do not change a median. As few differences tell little, 1 counts as 20 of them.

    Returns:
        (6,) factors on standard deviations, and the number of differences.
    """
    known = np.ones(len(sessions.tangents), bool)
    known[sessions.starts[:-1]] = False
    known[1:] &= sessions.profile[1:] == sessions.profile[:-1]
    k = np.flatnonzero(known)
    if not len(k):
        return np.ones(6), 0
    apart = sessions.tangents[k] - sessions.tangents[k - 1]
    cov = sessions.cov[k] + sessions.cov[k - 1]
    n = len(k)
    by_axis = np.median(np.abs(apart) / np.sqrt(np.einsum("kii->ki", cov)), axis=0) / 0.67449
    scale = _shrunk(by_axis, n)
    apart = apart / scale
    # Chi-squared with 6 degrees of freedom: its median and its 90 % quantile, which shows long tails.
    whole = np.max(np.quantile(_chi2(cov, apart), [0.5, 0.9]) / [5.34812, 10.64464])
    return scale * _shrunk(np.sqrt(whole), n), n


def _shrunk(factor: Array, n: int) -> Array:
    return np.sqrt((20 + n * np.maximum(factor, 0.05) ** 2) / (20 + n))


def pooled(sessions: Sessions) -> Sessions:
    """Take half of each covariance from the mean of its series.

    A covariance from a few placements of the board is itself uncertain; sessions whose covariance came out
    too small by chance would rule the weighted means.
    """
    starts = sessions.starts
    if len(starts) < 2:
        return sessions
    lengths = np.diff(starts)
    mean = np.add.reduceat(sessions.cov, starts[:-1]) / lengths[:, None, None]
    return replace(sessions, cov=(sessions.cov + np.repeat(mean, lengths, axis=0)) / 2)


def rescaled(sessions: Sessions, scale: Array) -> Sessions:
    """Multiply the standard deviations of what scatters by factors (6,)."""
    return replace(sessions, cov=sessions.cov * scale[:, None] * scale)


class _Sums:
    """Weights and weighted tangents, summed over the sessions of each series."""

    def __init__(
        self,
        sessions: Sessions,
        keep: NDArray[np.bool_] | None,
        starts: NDArray[np.intp] | None = None,
    ) -> None:
        bounds = sessions.starts if starts is None else starts
        self.starts, self.group = bounds[:-1], np.repeat(np.arange(len(bounds) - 1), np.diff(bounds))
        self.weights = sessions.weights
        if keep is not None and not keep.all():
            self.weights = self.weights * keep[:, None, None]
        self.weighted = _times(self.weights, sessions.tangents)
        self.total = np.add.reduceat(self.weights, self.starts)
        self.total_weighted = np.add.reduceat(self.weighted, self.starts)
        self.mean_cov = _inverse(self.total)
        self.mean = _times(self.mean_cov, self.total_weighted)

    def before(self) -> tuple[Array, Array]:
        """Sum weights (N, 6, 6) and weighted tangents (N, 6) of the sessions before each."""
        return _before(self.weights, self.starts, self.group), _before(self.weighted, self.starts, self.group)


def _before(values: Array, starts: NDArray[np.intp], group: NDArray[np.intp]) -> Array:
    sums = np.cumsum(values, axis=0) - values
    return sums - sums[starts][group]


def _times(matrices: Array, vectors: Array) -> Array:
    return np.asarray((matrices @ vectors[..., None])[..., 0])


def _inverse(matrices: Array) -> Array:
    return np.asarray(np.linalg.inv(matrices), dtype=np.float64)


def _chi2(cov: Array, vectors: Array) -> Array:
    return np.asarray(np.einsum("...i,...i->...", vectors, np.linalg.solve(cov, vectors[..., None])[..., 0]))


def _squares(weights: Array, weighted: Array) -> Array:
    """Compute y^T W^-1 y, which summed weights W and tangents y explain by their mean."""
    return np.asarray(np.einsum("ki,ki->k", weighted, np.linalg.solve(weights, weighted[..., None])[..., 0]))


def _is_mixed(sessions: Sessions) -> NDArray[np.bool_]:
    """Return whether a series (G,) has sessions of several profiles, whose shared errors may differ."""
    starts = sessions.starts[:-1]
    least = np.minimum.reduceat(sessions.profile, starts)
    return np.asarray(least != np.maximum.reduceat(sessions.profile, starts))


def statistics(sessions: Sessions, keep: NDArray[np.bool_] | None = None) -> Statistics:
    """Test every change of every series.

    Where a series has sessions of several profiles, the shared errors of two of them are added.

    Args:
        sessions: the series, none of them empty.
        keep: (N,) sessions that count; the first one of each series does.
    """
    sums = _Sums(sessions, keep)
    starts, group, n = sums.starts, sums.group, len(sessions.tangents)
    kept = np.ones(n, bool) if keep is None else keep
    lengths = np.add.reduceat(kept.astype(np.intp), starts)
    mixed = _is_mixed(sessions)
    is_first = np.zeros(n, bool)
    is_first[starts] = True

    step, odd = np.zeros(n), np.zeros(n)
    before, before_weighted = sums.before()
    k = np.flatnonzero(kept & ~is_first)
    if len(k):
        total, total_weighted = sums.total[group[k]], sums.total_weighted[group[k]]
        step[k] = (
            _squares(before[k], before_weighted[k])
            + _squares(total - before[k], total_weighted - before_weighted[k])
            - np.einsum("gi,gi->g", sums.mean, sums.total_weighted)[group[k]]
        )
    k = np.flatnonzero(kept & ~is_first & mixed[group])
    if len(k):
        cov_before = _inverse(before[k])
        cov_after = _inverse(sums.total[group[k]] - before[k])
        apart = _times(cov_after, sums.total_weighted[group[k]] - before_weighted[k])
        apart -= _times(cov_before, before_weighted[k])
        step[k] = _chi2(cov_before + cov_after + sessions.shared[k] + sessions.shared[k - 1], apart)

    inside = kept & ~is_first
    # The last session that counts is at once a step and odd.
    position = np.where(kept, np.arange(n), -1)
    inside[np.maximum.reduceat(position, starts)] = False
    k = np.flatnonzero(inside)
    if len(k):
        g = group[k]
        cov = sessions.cov[k] + _LEAST - sums.mean_cov[g] + 2 * mixed[g, None, None] * sessions.shared[k]
        odd[k] = _chi2(cov, sessions.tangents[k] - sums.mean[g])
    return Statistics(step, odd, _slopes(sessions, sums, (lengths >= _FEWEST_FOR_SLOPE) & ~mixed)[0])


def _slopes(sessions: Sessions, sums: _Sums, wanted: NDArray[np.bool_]) -> tuple[Array, Array, Array]:
    """Fit a slope to each series: (chi-squared, slope (G, 6) per day, its information (G, 6, 6))."""
    starts, group = sums.starts, sums.group
    days = sessions.days - np.add.reduceat(sessions.days, starts)[group] / np.diff(sessions.starts)[group]
    first = np.add.reduceat(sums.weights * days[:, None, None], starts)
    second = np.add.reduceat(sums.weights * (days**2)[:, None, None], starts)
    weighted = np.add.reduceat(sums.weighted * days[:, None], starts)
    information = second - first @ sums.mean_cov @ first
    rest = weighted - _times(first, sums.mean)
    chi2, slope = np.zeros(len(starts)), np.zeros((len(starts), 6))
    # Sessions of one moment have no slope.
    g = np.flatnonzero(wanted & (np.maximum.reduceat(days, starts) - np.minimum.reduceat(days, starts) > 0))
    if len(g):
        slope[g] = np.linalg.solve(information[g], rest[g][..., None])[..., 0]
        chi2[g] = np.einsum("gi,gi->g", slope[g], rest[g])
    return chi2, slope, information


def references(
    sessions: Sessions, starts_now: NDArray[np.intp], keep: NDArray[np.bool_], limits: Limits
) -> References:
    """Compare each session with the weighted mean of those of its part before it.

    Args:
        sessions: all.
        starts_now: (G + 1,) as `Sessions.starts`, of parts in which nothing changed.
        keep: (N,) sessions that belong to the mean; the first one of each part does.
        limits: of the fleet.
    """
    sums = _Sums(sessions, keep, starts_now)
    starts, n = sums.starts, len(sessions.tangents)
    is_first = np.zeros(n, bool)
    is_first[starts] = True
    before, before_weighted = sums.before()
    apart, sigma = np.full((n, 6), np.nan), np.full((n, 6), np.nan)
    chi2, z = np.full(n, np.nan), np.zeros((n, 6))
    k = np.flatnonzero(~is_first)
    if len(k):
        cov = _inverse(before[k])
        apart[k] = sessions.tangents[k] - _times(cov, before_weighted[k])
        cov += sessions.cov[k]
        differs = sessions.profile[k] != sessions.profile[k - 1]
        cov += differs[:, None, None] * (sessions.shared[k] + sessions.shared[k - 1])
        sigma[k] = np.sqrt(np.einsum("kii->ki", cov))
        chi2[k] = _chi2(cov, apart[k])
        z[k] = np.where(keep[k, None], apart[k] / sigma[k], 0.0)
    above, below = _cusum(z, starts), _cusum(-z, starts)
    information = _inverse(sums.mean_cov + sessions.cov[starts_now[1:] - 1])
    smallest = np.sqrt(limits.smallest_chi2 / np.einsum("gii->gi", information))
    return References(
        apart, sigma, chi2, np.where(above >= below, above, -below), sums.mean, sums.mean_cov, smallest
    )


def _cusum(z: Array, starts: NDArray[np.intp]) -> Array:
    """Add up z - 1/2, never below zero: the sum from the start less its least value so far."""
    sums = np.cumsum(z - _ALLOWANCE, axis=0)
    result = np.empty_like(sums)
    for first, last in zip(starts, [*starts[1:], len(z)], strict=True):
        own = sums[first:last]
        least = np.minimum.accumulate(own, axis=0)
        entry = sums[first - 1] if first else np.zeros(z.shape[1])
        result[first:last] = own - np.minimum(least, entry)
    return result


def find_changes(series: Sessions, limits: Limits, T_cam_lidar: Array) -> tuple[Found, ...]:
    """List the changes of one series, in the order of time.

    Halves are split at the largest step until none exceeds the limit; odd sessions are taken out on the way.
    Then each step is placed anew between its neighbours. A slow drift takes their place where it explains as
    much with fewer changes.

    Args:
        series: one series.
        limits: of the fleet.
        T_cam_lidar: (4, 4) of it.
    """
    n = len(series.tangents)
    steps, keep = _split(series, limits.chi2)
    odd = np.flatnonzero(~keep)
    whole = statistics(series, keep)
    n_changes = len(steps)
    explained = _misfit(series, keep, [0, n]) - _misfit(series, keep, [0, *steps, n])
    if whole.slope[0] > max(limits.chi2, explained - max(n_changes - 1, 0) * limits.chi2):
        found = [_as_drift(series, keep, limits, T_cam_lidar)]
        steps = []
    else:
        found = [_as_step(series, keep, [0, *steps, n], i, limits, T_cam_lidar) for i in range(len(steps))]
    bounds = [0, *steps, n]
    for k in odd.tolist():
        first = max(b for b in bounds if b <= k)
        found.append(_as_odd(series, keep, k, (first, min(b for b in bounds if b > k)), limits, T_cam_lidar))
    return tuple(sorted(found, key=lambda each: each.session))


def _split(series: Sessions, limit: float) -> tuple[list[int], NDArray[np.bool_]]:
    """Find steps and the sessions that are not odd."""
    n = len(series.tangents)
    keep = np.ones(n, bool)
    todo, steps = [(0, n)], []
    for _ in range(_MOST_CHANGES):
        if not todo:
            break
        first, last = todo.pop()
        if np.count_nonzero(keep[first:last]) < 2:
            continue
        found = statistics(series.part(first, last), keep[first:last])
        if found.odd.max() > max(limit, found.step.max()):
            keep[first + int(np.argmax(found.odd))] = False
            todo.append((first, last))
        elif found.step.max() > limit:
            k = first + int(np.argmax(found.step))
            steps.append(k)
            todo += [(first, k), (k, last)]
    steps.sort()
    return _placed_anew(series, keep, steps, limit), keep


def _placed_anew(series: Sessions, keep: NDArray[np.bool_], steps: list[int], limit: float) -> list[int]:
    """Put each step where it is largest between its neighbours; leave out what falls below the limit."""
    i = 0
    while i < len(steps):
        first = steps[i - 1] if i else 0
        last = steps[i + 1] if i + 1 < len(steps) else len(keep)
        step = statistics(series.part(first, last), keep[first:last]).step
        if step.max() > limit:
            steps[i] = first + int(np.argmax(step))
            i += 1
        else:
            del steps[i]
    return steps


def _misfit(series: Sessions, keep: NDArray[np.bool_], bounds: Sequence[int]) -> float:
    """Sum the squared distances from the mean of each part, in units of the covariances."""
    total = 0.0
    for first, last in pairwise(bounds):
        part, own = series.part(first, last), keep[first:last]
        sums = _Sums(part, own)
        apart = part.tangents - sums.mean
        total += float(np.einsum("ki,kij,kj->", apart, sums.weights, apart))
    return total


def _as_step(
    series: Sessions,
    keep: NDArray[np.bool_],
    bounds: Sequence[int],
    i: int,
    limits: Limits,
    T_cam_lidar: Array,
) -> Found:
    first, k, last = bounds[i], bounds[i + 1], bounds[i + 2]
    before = _Sums(series.part(first, k), keep[first:k])
    after = _Sums(series.part(k, last), keep[k:last])
    part = series.part(first, last)
    cov = before.mean_cov[0] + after.mean_cov[0]
    cov = cov + _is_mixed(part)[0] * (series.shared[k] + series.shared[k - 1])
    step = statistics(part, keep[first:last]).step
    chance = np.where(step > 0, np.exp((step - step.max()) / 2), 0.0)
    likely = np.flatnonzero(chance > 0.05 * chance.sum())
    tangent = after.mean[0] - before.mean[0]
    return Found(
        "step",
        k,
        last,
        first + int(likely[0]),
        first + int(likely[-1]),
        float(_chi2(cov, tangent)),
        tuple(tangent.tolist()),
        *explain(tangent, cov, limits, T_cam_lidar),
        int(np.count_nonzero(keep[first:k])),
        int(np.count_nonzero(keep[k:last])),
    )


def _as_odd(
    series: Sessions,
    keep: NDArray[np.bool_],
    k: int,
    bounds: tuple[int, int],
    limits: Limits,
    T_cam_lidar: Array,
) -> Found:
    first, last = bounds
    rest = _Sums(series.part(first, last), keep[first:last])
    cov = rest.mean_cov[0] + series.cov[k] + _is_mixed(series.part(first, last))[0] * 2 * series.shared[k]
    tangent = series.tangents[k] - rest.mean[0]
    n = int(np.count_nonzero(keep[first:last]))
    chi2 = float(_chi2(cov, tangent))
    axes, sensor = explain(tangent, cov, limits, T_cam_lidar)
    return Found("odd", k, k + 1, k, k, chi2, tuple(tangent.tolist()), axes, sensor, n, 1)


def _as_drift(series: Sessions, keep: NDArray[np.bool_], limits: Limits, T_cam_lidar: Array) -> Found:
    chi2, slope, information = _slopes(series, _Sums(series, keep), np.array([True]))
    span = float(series.days[-1] - series.days[0])
    tangent, cov = slope[0] * span, _inverse(information[0]) * span**2
    n = int(np.count_nonzero(keep))
    axes, sensor = explain(tangent, cov, limits, T_cam_lidar)
    return Found("drift", 0, len(keep), 0, 0, float(chi2[0]), tuple(tangent.tolist()), axes, sensor, n, n)


def explain(
    tangent: Array, cov: Array, limits: Limits, T_cam_lidar: Array
) -> tuple[tuple[AxisDrift, ...], str]:
    """Explain a change by as few axes as leave noise, the one that explains most first.

    Args:
        tangent: (6,) the change, m and rad.
        cov: (6, 6) of it.
        limits: of the fleet.
        T_cam_lidar: (4, 4).

    Returns:
        The axes; and "camera" or "lidar" if a single rotation of one of them about its own origin explains
        the change clearly better than one of the other, else "".
    """
    from scipy.special import chdtrc

    information = _inverse(cov)
    whole = float(tangent @ information @ tangent)
    chosen: list[int] = []
    instead: list[tuple[str, ...]] = []
    while len(chosen) < 6:
        open_axes = [axis for axis in range(6) if axis not in chosen]
        gain = {axis: _explained(tangent, information, np.eye(6)[[*chosen, axis]]) for axis in open_axes}
        best = max(open_axes, key=lambda axis: gain[axis])
        others = [AXES[axis] for axis in open_axes if axis != best and gain[axis] > (1 - NEARLY) * gain[best]]
        chosen.append(best)
        instead.append(tuple(others))
        if chdtrc(6 - len(chosen), whole - gain[best]) > _NOISE if len(chosen) < 6 else True:
            break
    directions = np.eye(6)[chosen]
    own = _inverse(directions @ information @ directions.T)
    sizes, sigmas = own @ directions @ information @ tangent, np.sqrt(np.diag(own))
    smallest = np.sqrt(limits.smallest_chi2 / np.diag(information)[chosen])
    axes = []
    for axis, size, sigma, least, others_of in zip(chosen, sizes, sigmas, smallest, instead, strict=True):
        unit = float(np.degrees(1.0)) if IS_ROTATION[axis] else 1.0
        figures = (unit * float(size), unit * float(sigma), unit * float(least))
        axes.append(AxisDrift(AXES[axis], "changed", *figures, instead=tuple(others_of)))
    return tuple(axes), _sensor(tangent, information, T_cam_lidar)


def _explained(tangent: Array, information: Array, directions: Array) -> float:
    """Compute how much of chi-squared directions (n, 6) explain together."""
    projected = directions @ information @ tangent
    return float(projected @ np.linalg.solve(directions @ information @ directions.T, projected))


def _sensor(tangent: Array, information: Array, T_cam_lidar: Array) -> str:
    """Name the sensor that turned about itself.

    A turning LiDAR leaves t as it is; a turning camera moves it by phi x t.
    """
    lidar = np.eye(6)[3:]
    camera = lidar.copy()
    camera[:, :3] = np.cross(np.eye(3), T_cam_lidar[:3, 3])
    gains = [max(_explained(tangent, information, u[None]) for u in each) for each in (camera, lidar)]
    shifts = max(_explained(tangent, information, u[None]) for u in np.eye(6)[:3])
    if max(gains) < shifts or abs(gains[0] - gains[1]) < _SENSOR_KNOWN:
        return ""
    return "camera" if gains[0] > gains[1] else "lidar"
