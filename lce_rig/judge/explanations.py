"""Score tests of errors that may explain the captures, on the estimate's own likelihood.

The likelihood (`calibrate.likelihood.hypothesis`) is expanded to second order at its optimum. An explanation
adds unknowns s to the unknowns z that all captures share. Capture k is then seen with

    z + w_k D s                                                                                          (1)

A constant error has w_k = 1, and D selects its unknowns. s has no prior, which frees the error of the
profile's. For a sensor that moved, D selects the extrinsics, and w_k = 1 for the captures on one side. With
g_k and H_k half the gradient and half the Hessian of the captures' costs, g and H those of all captures with
the priors, the cost falls by

    chi2 = h^T S^-1 h,    h = g_s - H_sz H^-1 g,    S = H_ss - H_sz H^-1 H_zs,
    g_s = sum_k w_k D^T g_k,    H_sz = sum_k w_k D^T H_k,    H_ss = sum_k w_k^2 D^T H_k D                 (2)

which is chi-squared without the error. The most significant explanation is assumed, the likelihood settles
under it, and the others are tested again, until none is significant. Explanations that lose their
significance on the way followed from the assumed one. Noisier images than usual also explain captures that
disagree. An explanation is therefore assumed only if it raises the likelihood significantly with the noise of
the images fitted in both cases.

References:
    Rao, "Large sample tests of statistical hypotheses", 1948 (the score test).
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from lce_rig.calibrate.likelihood.hypothesis import Hypothesis
from lce_rig.calibrate.likelihood.layout import Indices
from lce_rig.calibrate.quadratics import Quadratics
from lce_rig.core.geometry import Array, difference

Cause = Literal[
    "squares",
    "pattern",
    "plate",
    "bow",
    "lens",
    "range_offset",
    "range_scale",
    "range_contrast",
    "azimuths",
    "elevations",
    "moved",
    "groups",
    "alone",
    "drift",
    "focus_drift",
    "two_boards",
]
MOUNTINGS: tuple[Cause, ...] = ("moved", "groups", "alone", "drift")
"""Causes that change the extrinsics during the session."""
# Significance limit, log10 of the probability, corrected for all explanations of the kind that are tried.
_LEAST = -4.0
# The same of explanations that are settled. Ring ends far from their edges count as strays, and (2)
# understates their gain: a move of 0.8 deg before the last 3 of 15 simulated captures has -3.8,
# settled -146.
_TRIED = -2.0
# Prior standard deviation of freed errors, m, rad or a fraction: the size of users' mistakes.
_WIDE = 0.2
_FREED: Mapping[Cause, Mapping[str, Any]] = {
    "squares": {"squares": _WIDE},
    "pattern": {"pattern_m": _WIDE},
    "plate": {"plate_m": _WIDE},
    "bow": {"bow_m": _WIDE},
    "lens": {"optics": 100.0},  # in standard deviations of the profile
    "range_offset": {"offset_m": _WIDE},
    "range_scale": {"stretch": _WIDE},
    "range_contrast": {"contrast_m": _WIDE},
    "azimuths": {"azimuth_rad": _WIDE, "known": None},
    "elevations": {"elevation_rad": _WIDE, "known": None},
}
CONSTANT: tuple[Cause, ...] = tuple(_FREED)
"""Causes that are the same in all captures."""
_OF_CAMERA: tuple[Cause, ...] = ("focus_drift", "two_boards")
ALL: tuple[Cause, ...] = (*CONSTANT, *_OF_CAMERA, *MOUNTINGS)
# Causes that the likelihood cannot settle under; their probabilities are comparable with each other's only.
_UNSETTLED: tuple[Cause, ...] = ("drift", *_OF_CAMERA)
# Changes of the extrinsics in (1). A focal length that grows by a fraction shows boards nearer by the same
# fraction of their depth: a translation along the camera's axis.
_OF_POSES: tuple[Cause, ...] = (*MOUNTINGS, "focus_drift")
# Handicap of the rarer of two errors that only the plate's size separates, log10 of the probability: ranges
# too long by a fraction look like squares larger than the profile's. On rlfs02, ranges of 2 % prefer the
# right cause by 9, squares of 3 % the wrong one by 4.
_RARER: Mapping[Cause, float] = {"range_scale": 8.0}
_ALIKE: Sequence[Sequence[Cause]] = ((*MOUNTINGS, *_OF_CAMERA), ("squares", "range_scale"))
# Similar causes are settled, too, from this fraction of the best one's log10 of the probability.
_LIKELY = 0.2
SCATTER = 4.0
"""Largest noise of images and of ranges, in usual levels, of captures that are explained.

It is two standard deviations of the prior of these levels. Few captures determine their noise by a quarter
only, so an explanation that leaves more must be more probable with this noise than any noise without it."""
# Noise of images, in usual levels, from which a change of the mounting counts less, by its square. Errors of
# boards that moved have long tails: setting any part of them aside improves the fit of the rest. Each channel
# of rles01 and rles02 alone scatters 3 to 11 times as usual and seems to have moved.
_TAILED = 2.0
_FEWEST_IN_GROUPS, _FEWEST_AT_END, _FEWEST_OF_GROUP = 8, 2, 3
_MOST, _N_REJECTED = 4, 3
_N_STARTS, _N_ROUNDS, _N_DIVISIONS = 24, 10, 4
_MEDIAN_CHI2 = 5.348  # of six degrees of freedom
_AXES = np.eye(6)


@dataclass(frozen=True, eq=False)
class Explanation:
    """A possible cause of disagreement between captures.

    Attributes:
        cause: the cause's kind.
        weights: (F,) w of (1).
        n_tried: number of explanations of this kind.
        cut: index of the first capture after a move ("moved"), of another board ("two_boards"), or of the
            only one ("alone").
    """

    cause: Cause
    weights: Array
    n_tried: float = 1.0
    cut: int = 0


class Gain(NamedTuple):
    """Decrease of the cost by an explanation, and its significance.

    Attributes:
        explanation: the explanation.
        log10_chance: log10 of the probability of such a fall without the error, in any of those tried.
        freedoms: degrees of freedom of its chi-squared.
        value: (n,) estimate of s.
    """

    explanation: Explanation
    log10_chance: float
    freedoms: int
    value: Array

    @property
    def cause(self) -> Cause:
        """Of the explanation."""
        return self.explanation.cause

    @property
    def key(self) -> tuple[Cause, int]:
        """Tells it from other explanations of the table."""
        return self.explanation.cause, self.explanation.cut


class Selected(NamedTuple):
    """An explanation that was assumed.

    Attributes:
        gain: the gain's significance and estimate.
        change: (6,) tangent (translation m, rotation rad) by which it changes the extrinsics. For mountings:
            from before to after, or from the rest to the group.
        after: the likelihood with it.
    """

    gain: Gain
    change: Array
    after: Hypothesis


class Poses(NamedTuple):
    """Derivatives of F captures' costs by the extrinsics of their mounting, at the optimum of all.

    Attributes:
        gradient: (F, 6).
        by_z: (F, G, 6).
        hessian: (F, 6, 6).
        inverse: (G, G) covariance of z.
    """

    gradient: Array
    by_z: Array
    hessian: Array
    inverse: Array

    def gain(self, explanation: Explanation) -> Gain:
        """Compute (2) for a change of the extrinsics."""
        D = _AXES[:, 2:3] if explanation.cause == "focus_drift" else _AXES
        h, S = self.score(explanation.weights)
        found = score_test(explanation, D.T @ h, D.T @ S @ D, _WIDE)
        return found._replace(value=D @ found.value)

    def score(self, weights: Array) -> tuple[Array, Array]:
        """Compute h (6,) and S (6, 6) of (2) for a change of the extrinsics with weights (F,)."""
        by_z = np.tensordot(weights, self.by_z, axes=1)
        hessian = np.tensordot(weights**2, self.hessian, axes=1)
        return weights @ self.gradient, hessian - by_z.T @ self.inverse @ by_z

    def singles(self, gradient: Array) -> Array:
        """Compute each capture's decrease in cost (F,) with separate extrinsics: chi-squared, 6 d.o.f.

        Args:
            gradient: (F, 6) at the optimum.
        """
        own = np.linalg.solve(self.hessian + 1e-9 * np.eye(6), gradient[..., None])[..., 0]
        return np.asarray(np.einsum("ki,ki->k", gradient, own))

    def unit_without(self, weights: Array, by_z: Array, by_pose: Array) -> float:
        """Measure the noise of single captures under an explanation, in units of the usual noise.

        Args:
            weights: (F,) w.
            by_z: (G,) H_zs s.
            by_pose: (F, 6) derivatives of the captures' gradients, times s.
        """
        step = -self.inverse @ by_z
        gradient = self.gradient + np.einsum("kga,g->ka", self.by_z, step) + weights[:, None] * by_pose
        return _unit(self.singles(gradient))

    def moves(self) -> Iterator[Explanation]:
        """List moves before each capture."""
        F = len(self.gradient)
        order, cuts = np.arange(F), range(_FEWEST_AT_END, F - _FEWEST_AT_END + 1)
        for cut in cuts:
            # Assign the separate mounting to the smaller side.
            is_own = order < cut if 2 * cut < F else order >= cut
            yield Explanation("moved", is_own.astype(np.float64), len(cuts), cut)

    def candidates(self) -> Iterator[Explanation]:
        """List candidates: moves at each capture, single captures, the two most different groups, a drift."""
        yield from self.moves()
        F = len(self.gradient)
        order = np.arange(F)
        for k in range(F):
            yield Explanation("alone", (order == k).astype(np.float64), F, k)
        if F >= _FEWEST_IN_GROUPS and np.count_nonzero(np.diff(members := self.divide())) > 1:
            yield Explanation("groups", members, 2.0 ** (F - 1))
        yield Explanation("drift", order / max(F - 1, 1) - 0.5)

    def divide(self) -> Array:
        """Divide captures by k-means between the two extrinsics that fit them best: (F,) of 0 and 1."""
        g, H, F = self.gradient, self.hessian, len(self.gradient)
        starts = np.random.default_rng(0).random((_N_STARTS, F)) < 0.5
        starts[0] = np.arange(F) % 2 == 0
        best, members = -np.inf, starts[0]
        for is_first in starts:
            for _ in range(_N_ROUNDS):
                shares = is_first.astype(np.float64)
                costs = [self._costs(w @ g, np.tensordot(w, H, axes=1)) for w in (shares, 1 - shares)]
                is_now = costs[0] < costs[1]
                if min(is_now.sum(), (~is_now).sum()) < _FEWEST_OF_GROUP or (is_now == is_first).all():
                    break
                is_first = is_now
            fall = -float(np.minimum(*costs).sum())
            if fall > best:
                best, members = fall, is_first
        smaller = members if 2 * members.sum() <= F else ~members
        return np.asarray(smaller, dtype=np.float64)

    def _costs(self, g: Array, H: Array) -> Array:
        """Compute each capture's cost (F,) at the minimum of a cost with gradient g and Hessian H."""
        x = -np.linalg.solve(H + np.eye(6), g)
        return np.asarray(2 * self.gradient @ x + np.einsum("i,kij,j->k", x, self.hessian, x))


@dataclass(frozen=True, eq=False)
class Table:
    """Explanations of the captures, tested on one hypothesis.

    Attributes:
        hypothesis: the assumptions so far.
        causes: the causes to test.
    """

    hypothesis: Hypothesis
    causes: frozenset[Cause]

    @cached_property
    def cost(self) -> Quadratics:
        """Expansion of the F captures' cost in z."""
        return self.hypothesis.reduced.cost

    @cached_property
    def inverse(self) -> Array:
        """(G, G) covariance of z."""
        H = self.cost.information
        scale = 1 / np.sqrt(np.diag(H))
        return np.asarray(scale[:, None] * np.linalg.inv(H * np.outer(scale, scale)) * scale)

    @cached_property
    def step(self) -> Array:
        """Step (G,) from the expansion point to the optimum."""
        return np.asarray(-self.inverse @ self.hypothesis.reduced.gradient)

    @cached_property
    def poses(self) -> Poses:
        """Derivatives of the captures' costs by the extrinsics."""
        c, at = self.cost, self.hypothesis.state.layout.cameras[self.hypothesis.mounting]
        F = np.arange(len(at))
        by_z = np.swapaxes(c.hessians[F[:, None], at], 1, 2)
        hessian = c.hessians[F[:, None, None], at[:, :, None], at[:, None]]
        gradient = c.gradients[F[:, None], at] + np.einsum("kga,g->ka", by_z, self.step)
        return Poses(gradient, by_z, hessian, self.inverse)

    def unit_without(self, row: Gain) -> float:
        """Measure the noise of single captures under an explanation, in units of the usual noise."""
        w = row.explanation.weights
        if row.cause in _OF_POSES:
            by_z = np.tensordot(w, self.poses.by_z, axes=1) @ row.value
            return self.poses.unit_without(w, by_z, self.poses.hessian @ row.value)
        along = self._columns(row.cause) @ row.value
        by_z = np.tensordot(w, self.cost.hessians, axes=1) @ along
        return self.poses.unit_without(w, by_z, np.einsum("kga,g->ka", self.poses.by_z, along))

    def rows(self) -> list[Gain]:
        """List the best explanation of each cause, the most significant first."""
        best: dict[Cause, Gain] = {}
        for explanation in self._candidates():
            is_of_poses = explanation.cause in _OF_POSES
            found = self.poses.gain(explanation) if is_of_poses else self._gain(explanation)
            held = best.get(explanation.cause)
            if held is None or found.log10_chance < held.log10_chance:
                best[explanation.cause] = found
        return sorted(best.values(), key=lambda each: each.log10_chance)

    def moves_of_rejected(self) -> list[Gain]:
        """List the moves before the last captures or after the first, half of which the estimate rejected.

        Far from the common optimum their cost is not quadratic, and (2) understates their gain.
        """
        is_further = self.hypothesis.is_further
        if "moved" not in self.causes or self.hypothesis.mounting.any() or not is_further.any():
            return []
        moves = [m for m in self.poses.moves() if 2 * (m.weights @ is_further) >= m.weights.sum()]
        found = [self.poses.gain(each) for each in moves]
        return sorted(found, key=lambda each: each.log10_chance)[:_N_REJECTED]

    def moves_beside(self, row: Gain) -> list[Gain]:
        """List the moves one capture before and after another one, or at the end at which one disagrees."""
        cut, F = row.explanation.cut, len(self.cost.gradients)
        of_ends = {0: 2, 1: 2, F - 2: F - 2, F - 1: F - 2}
        cuts = {of_ends.get(cut)} if row.cause == "alone" else {cut - 1, cut + 1}
        return [self.poses.gain(each) for each in self.poses.moves() if each.cut in cuts]

    def _candidates(self) -> Iterator[Explanation]:
        layout, F = self.hypothesis.state.layout, len(self.cost.gradients)
        for cause in _FREED:
            is_seen = {"lens": len(layout.optics(0)) > 0, "azimuths": layout.n_rings > 1}
            is_seen["elevations"] = is_seen["azimuths"]
            if cause in self.causes and is_seen.get(cause, True):
                yield Explanation(cause, np.ones(F))
        if "focus_drift" in self.causes:
            yield Explanation("focus_drift", np.linspace(-0.5, 0.5, F) * self.hypothesis.depths_m)
        cuts = range(_FEWEST_AT_END, F - _FEWEST_AT_END + 1) if "two_boards" in self.causes else ()
        for cut in cuts:
            yield Explanation("two_boards", (np.arange(F) >= cut).astype(np.float64), len(cuts), cut)
        yield from (each for each in self.poses.candidates() if each.cause in self.causes)

    def _gain(self, explanation: Explanation) -> Gain:
        """Compute (2) for a constant error."""
        c, w, D = self.cost, explanation.weights, self._columns(explanation.cause)
        sigma = next(iter(_FREED.get(explanation.cause, {"": _WIDE}).values()))
        by_z = np.tensordot(w, c.hessians, axes=1) @ D
        hessian = D.T @ np.tensordot(w**2, c.hessians, axes=1) @ D
        h = D.T @ (w @ c.gradients) + by_z.T @ self.step
        return score_test(explanation, h, hessian - by_z.T @ self.inverse @ by_z, sigma)

    def _columns(self, cause: Cause) -> Array:
        """Return D (G, n) for a constant error."""
        layout = self.hypothesis.state.layout
        every = np.eye(layout.z.size)
        if cause == "range_offset":
            return np.asarray(every[:, layout.lasers[0]].sum(axis=1, keepdims=True))
        if cause in ("azimuths", "elevations"):
            # Deviations from their mean: the mean angle is part of the extrinsics.
            angles = layout.lasers[1 if cause == "azimuths" else 2]
            L = len(angles)
            return np.asarray(every[:, angles] @ np.linalg.svd(np.eye(L) - 1 / L)[0][:, :-1])
        at: dict[Cause, Indices] = {
            "squares": layout.z.of(["squares"]),
            "pattern": layout.z.of(["pattern"]),
            "plate": layout.plate,
            "bow": layout.z.of(["bow"]),
            "lens": layout.optics(0),
            "range_scale": layout.z.of(["stretch"]),
            "range_contrast": layout.z.of(["contrast"]),
            "two_boards": layout.z.of(["squares"]),
        }
        return np.asarray(every[:, at[cause]])


def score_test(explanation: Explanation, h: Array, S: Array, sigma: float) -> Gain:
    """Compute (2) in the directions of s that captures determine better than its standard deviation."""
    information, axes = np.linalg.eigh(sigma**2 * (S + S.T) / 2)
    is_known = information > 1
    along = sigma * (axes.T @ h)[is_known] / information[is_known]
    chi2 = float(along**2 @ information[is_known])
    chance = log10_chance(chi2, len(along)) + np.log10(explanation.n_tried)
    return Gain(explanation, min(chance, 0.0), len(along), -sigma * axes[:, is_known] @ along)


def _unit(singles: Array) -> float:
    """Estimate the captures' noise from the chi-squared of single captures (`Poses.singles`): at least 1."""
    return max(float(np.median(singles)) / _MEDIAN_CHI2, 1.0)


def log10_chance(chi2: float, freedoms: int) -> float:
    """Return log10 of the probability of exceeding a chi-squared."""
    from scipy.special import chdtrc, gammaln

    if freedoms == 0:
        return 0.0
    chance = float(chdtrc(freedoms, max(chi2, 0.0)))
    if chance > 1e-250:
        return float(np.log10(chance))
    half = chi2 / 2
    return float((-half + (freedoms / 2 - 1) * np.log(half) - gammaln(freedoms / 2)) / np.log(10))


def explain(hypothesis: Hypothesis, causes: Sequence[Cause]) -> Iterator[Selected]:
    """Assume explanations one after the other until none is significant.

    Args:
        hypothesis: the assumptions of the estimate.
        causes: the causes to test.

    Yields:
        The explanations assumed, in order.
    """
    left, first, members = frozenset(causes), hypothesis, np.zeros(len(hypothesis.captures))
    failed: dict[tuple[Cause, int], float] = {}
    for _ in range(_MOST):
        table = Table(hypothesis, left)
        rows, late = table.rows(), table.moves_of_rejected()
        if not rows or (rows[0].log10_chance > _TRIED and not late):
            return
        noisy = hypothesis.with_fitted_noise
        tried = [*Table(noisy, left).rows()[:1], rows[0], *late, *_similar(rows, failed)]
        if rows[0].cause not in _UNSETTLED:
            tried = [row for row in tried if row.cause not in _UNSETTLED]
        once = {row.key: row for row in tried}
        found = {key: _assume(hypothesis, noisy, row) for key, row in once.items()}
        for key, row in once.items():
            if found[key].gain.log10_chance > _LEAST:
                failed[key] = row.log10_chance
            elif row.cause in ("moved", "alone"):
                beside = [near for near in table.moves_beside(row) if near.key not in found]
                found |= {near.key: _assume(hypothesis, noisy, near) for near in beside}
        # Far from the optimum (2) overstates the gain of many unknowns: of 5 captures with ranges 0.1 m too
        # long, the lens has -41, ranges -34, settled -6 and -18.
        constant = [row for row in rows if row.cause in CONSTANT] if rows[0].cause in CONSTANT else []
        for row in constant:
            if row.key not in found and row.log10_chance < min(map(_rank, found.values())):
                found[row.key] = _assume(hypothesis, noisy, row)
        best = min(found.values(), key=_rank)
        if best.gain.log10_chance > _LEAST:
            return
        if best.gain.cause == "alone":
            members = members + best.gain.explanation.weights
            if members.sum() >= _FEWEST_OF_GROUP:
                # Far from the others, captures of one other mounting are found one by one.
                row = Gain(Explanation("groups", members, 2.0 ** (len(members) - 1)), 0.0, 6, np.zeros(6))
                best = min(best, _assume(first, first.with_fitted_noise, row), key=_rank)
        yield best
        if best.after is hypothesis:
            return
        hypothesis = best.after
        if best.gain.cause not in MOUNTINGS:
            left -= {best.gain.cause}


def _similar(rows: Sequence[Gain], failed: Mapping[tuple[Cause, int], float]) -> Iterator[Gain]:
    """List causes that are similar at usual noise: refitted, one may be much more probable than the other.

    A constant error that is there in addition hides no change.

    Args:
        rows: of the table.
        failed: log10 of the probabilities of explanations that proved insignificant. They are listed again
            if they are ten times less probable without the error.
    """
    for alike in _ALIKE:
        likely = [row for row in rows if row.cause in alike and row.log10_chance < _TRIED]
        if likely and (likely[0] is rows[0] or "moved" in alike):
            least = _LIKELY * likely[0].log10_chance
            yield from (r for r in likely if r.log10_chance < min(least, failed.get(r.key, 0.0) - 1))


def _rank(selected: Selected) -> float:
    """Return the significance with the handicap of rarer errors."""
    return selected.gain.log10_chance + _RARER.get(selected.gain.cause, 0.0)


def _assume(now: Hypothesis, noisy: Hypothesis, row: Gain) -> Selected:
    """Refit under an explanation; compare deviances with noise fitted with and without it."""
    if row.cause in _FREED:
        after = now.under(priors=replace(now.priors, **_FREED[row.cause]))
        change = difference(after.T_in_use, now.T_in_use)
    elif row.cause in _UNSETTLED:
        # The likelihood has no such unknown: use its expansion and the noise of single captures.
        chance = row.log10_chance / Table(now, frozenset()).unit_without(row)
        change = row.value
        if row.cause in _OF_CAMERA:
            # Boards are farther or nearer by the same factor.
            share = float(row.value[2] if row.cause == "focus_drift" else row.value[0])
            change = share * float(now.depths_m.mean()) * _AXES[2]
        return Selected(row._replace(log10_chance=chance), change, now)
    else:
        after, change, divided = _split(now, row)
        weights = divided.astype(np.float64)
        row = row._replace(explanation=replace(row.explanation, weights=weights))
    left = after.with_fitted_noise
    noise, most = left.levels.largest_of_images, max(SCATTER, noisy.levels.largest_of_images)
    fall = noisy.deviance - left.with_noise_up_to(SCATTER).deviance
    if row.cause in MOUNTINGS:
        fall /= max(noise / _TAILED, 1.0) ** 2
    chance = log10_chance(fall, row.freedoms) + np.log10(row.explanation.n_tried)
    if noise > most or left.levels.of_ranges > SCATTER or not np.isfinite(fall):
        chance = 0.0
    members = row.explanation.weights > 0
    # Most captures of a group fit its mounting; those with individual errors do not.
    if row.cause in ("moved", "groups") and 2 * _misfits(after, ~members)[members].sum() >= members.sum():
        chance = 0.0
    return Selected(row._replace(log10_chance=min(chance, 0.0)), change, after)


def _split(now: Hypothesis, row: Gain) -> tuple[Hypothesis, Array, NDArray[np.bool_]]:
    """Refit with a separate mounting for some captures.

    A group is divided by costs far from their optimum. Captures that then disagree with their mounting
    change sides, until none does.

    Returns:
        The likelihood, the change (6,) of the extrinsics from before to after, or from the rest to the group,
        and the captures (F,) of the separate mounting.
    """
    members = row.explanation.weights > 0
    own, new = int(np.bincount(now.mounting[members]).argmax()), int(now.mounting.max()) + 1
    T = np.append(now.state.T_cam_lidar, now.mounting_of(members)[None], axis=0)
    others = ~members & (now.mounting == own)
    if others.any():
        T[own] = now.mounting_of(others)
    for _ in range(_N_DIVISIONS):
        kept, mounting = np.unique(np.where(members, new, now.mounting), return_inverse=True)
        after = now.under(mounting=mounting, T_cam_lidar=T[kept])
        if own not in kept:
            return after, np.zeros(6), members
        T[kept] = after.state.T_cam_lidar[: len(kept)]
        changed = members ^ (_misfits(after, ~members) & (now.mounting == own))
        n_changed = min(changed.sum(), (~changed).sum())
        if row.cause != "groups" or (changed == members).all() or n_changed < _FEWEST_OF_GROUP:
            break
        members = changed
    is_first = row.cause == "moved" and members[0]
    return after, difference(T[own], T[new]) if is_first else difference(T[new], T[own]), members


def _misfits(after: Hypothesis, others: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Find captures (F,) that disagree with their mounting, by the noise of other ones (F,)."""
    poses = Table(after, frozenset()).poses
    singles = poses.singles(poses.gradient)
    unit = _unit(singles[others])
    return np.array([log10_chance(chi2 / unit, 6) < _LEAST for chi2 in singles.tolist()])
