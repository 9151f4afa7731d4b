"""What explains the captures but their noise: a table of explanations on the estimate's own likelihood.

The likelihood (`calibrate.likelihood.hypothesis`) is expanded to second order at its optimum. An explanation
adds unknowns s to the unknowns z that all captures share: capture k is seen with

    z + w_k D s                                                                                          (1)

A constant error has w_k = 1 and D the columns of its unknowns: s has no prior, so that the error is freed of
the profile's. A sensor that moved has D the columns of the extrinsics, and w_k = 1 for the later captures.
With g_k and H_k half the gradient and half the Hessian of the captures' costs, H that of all with the priors
and g its gradient, the cost falls by

    chi2 = h^T S^-1 h,    h = g_s - H_sz H^-1 g,    S = H_ss - H_sz H^-1 H_zs,
    g_s = sum_k w_k D^T g_k,    H_sz = sum_k w_k D^T H_k,    H_ss = sum_k w_k^2 D^T H_k D                 (2)

which is chi-squared without the error. The most significant explanation is assumed, the likelihood settles
under it, and the others are tested again, until none is significant. What is no longer significant then
follows from what was assumed. Larger errors of the images than usual explain captures that disagree, too: an
explanation is assumed if the likelihood is significantly larger with it where these are fitted in both cases.

References:
    Rao, "Large sample tests of statistical hypotheses", 1948 (the score test).
"""

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, Literal, NamedTuple

import numpy as np

from lce_rig.calibrate.likelihood.hypothesis import Hypothesis
from lce_rig.calibrate.likelihood.layout import Indices
from lce_rig.calibrate.likelihood.levels import OF_IMAGES, Levels  # noqa
from lce_rig.calibrate.quadratics import Quadratics
from lce_rig.core.geometry import Array, difference, perturb

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
]

# Logarithm of the probability below which an explanation is significant, among all of its kind.
_LEAST = -4.0
# Deviations of constant errors that are freed of their priors: as large as a user may bring about.
_FREED: dict[Cause, dict[str, Any]] = {
    "squares": {"squares": 0.2},
    "pattern": {"pattern_m": 0.2},
    "plate": {"plate_m": 0.2},
    "bow": {"bow_m": 0.1},
    "lens": {"optics": 100.0},
    "range_offset": {"offset_m": 0.5},
    "range_scale": {"stretch": 0.2},
    "range_contrast": {"contrast_m": 0.2},
    "azimuths": {"azimuth_rad": 0.1, "known": None},
    "elevations": {"elevation_rad": 0.1, "known": None},
}
# Deviation of a change of the extrinsics, m and rad.
_CHANGE = 1.0
_FEWEST_IN_GROUPS, _FEWEST_AT_END, _FEWEST_OF_GROUP = 8, 2, 3
_MOST = 8
_N_STARTS, _N_ROUNDS = 24, 10


class Columns(NamedTuple):
    """Derivatives of the captures' costs by n unknowns s of (1), with w_k.

    Attributes:
        gradient: (n,) g_s.
        by_z: (G, n) H_zs.
        hessian: (n, n) H_ss.
    """

    gradient: Array
    by_z: Array
    hessian: Array


@dataclass(frozen=True, eq=False)
class Explanation:
    """A cause that may explain what captures disagree on.

    Attributes:
        cause: its kind.
        weights: (F,) w of (1); None for 1.
        n_tried: how many of its kind are tried.
        cut: of "moved", the index of the first capture after it.
    """

    cause: Cause
    weights: Array | None = None
    n_tried: float = 1.0
    cut: int | None = None

    @property
    def is_of_mounting(self) -> bool:
        """Whether the extrinsics change."""
        return self.cause in ("moved", "groups", "alone", "drift")


class Gain(NamedTuple):
    """What an explanation explains.

    Attributes:
        explanation: the explanation.
        log10_chance: of a fall of the cost of this size without the error, in one of those tried.
        freedoms: of its distribution.
        value: (n,) estimate of s.
    """

    explanation: Explanation
    log10_chance: float
    freedoms: int
    value: Array


class Selected(NamedTuple):
    """An explanation that was assumed.

    Attributes:
        gain: when it was.
        change: (6,) tangent (translation m, rotation rad) by which it changes the extrinsics in use; of a
            mounting, from one to the other.
        after: the likelihood under it.
    """

    gain: Gain
    change: Array
    after: Hypothesis


@dataclass(frozen=True, eq=False)
class Table:
    """Explanations of one hypothesis' captures.

    Attributes:
        hypothesis: the assumptions so far.
        assumed: causes among them.
    """

    hypothesis: Hypothesis
    assumed: frozenset[Cause] = field(default_factory=frozenset)

    @cached_property
    def cost(self) -> Quadratics:
        """Of the F captures, in z."""
        return self.hypothesis.reduced.cost

    @cached_property
    def inverse(self) -> Array:
        """(G, G) covariance of z."""
        H = self.cost.information
        scale = 1 / np.sqrt(np.diag(H))
        return np.asarray(scale[:, None] * np.linalg.inv(H * np.outer(scale, scale)) * scale)

    @cached_property
    def step(self) -> Array:
        """(G,) towards the optimum."""
        return np.asarray(-self.inverse @ self.hypothesis.reduced.gradient)

    @cached_property
    def by_pose(self) -> tuple[Array, Array, Array]:
        """Each capture's gradient (F, 6), and Hessians (F, G, 6), (F, 6, 6), by its mounting's extrinsics."""
        at = self.hypothesis.state.layout.cameras[self.hypothesis.mounting]
        F = np.arange(len(at))
        c = self.cost
        HD = np.swapaxes(c.hessians[F[:, None], at], 1, 2)
        return c.gradients[F[:, None], at], HD, c.hessians[F[:, None, None], at[:, :, None], at[:, None]]

    def directions(self, cause: Cause) -> Array:
        """Return the columns (G, n) of a constant error."""
        layout = self.hypothesis.state.layout
        every = np.eye(layout.z.size)
        if cause == "range_offset":
            return np.asarray(every[:, layout.lasers[0]].sum(axis=1, keepdims=True))
        if cause in ("azimuths", "elevations"):
            # About their mean, which is part of the extrinsics.
            angles = layout.lasers[1 if cause == "azimuths" else 2]
            L = len(angles)
            return np.asarray(every[:, angles] @ np.linalg.svd(np.eye(L) - 1 / L)[0][:, :-1])
        at: Indices = {
            "squares": layout.z.of(["squares"]),
            "pattern": layout.z.of(["pattern"]),
            "plate": layout.plate,
            "bow": layout.z.of(["bow"]),
            "lens": layout.optics(0),
            "range_scale": layout.z.of(["stretch"]),
            "range_contrast": layout.z.of(["contrast"]),
            "focus_drift": layout.z.of(["squares"]),
        }[cause]
        return np.asarray(every[:, at])

    def columns(self, explanation: Explanation) -> Columns:
        """Return the derivatives by an explanation's unknowns."""
        c, w = self.cost, explanation.weights
        w = np.ones(len(c.gradients)) if w is None else w
        if explanation.is_of_mounting:
            g, HD, DHD = self.by_pose
            return Columns(w @ g, np.tensordot(w, HD, axes=1), np.tensordot(w**2, DHD, axes=1))
        D = self.directions(explanation.cause)
        by_z = np.tensordot(w, c.hessians, axes=1) @ D
        return Columns(D.T @ (w @ c.gradients), by_z, D.T @ np.tensordot(w**2, c.hessians, axes=1) @ D)

    def gain(self, explanation: Explanation) -> Gain:
        """Compute (2)."""
        columns = self.columns(explanation)
        sigma = next(iter(_FREED.get(explanation.cause, {"": _CHANGE}).values()))
        h = sigma * (columns.gradient + columns.by_z.T @ self.step)
        S = columns.hessian - columns.by_z.T @ self.inverse @ columns.by_z
        information, axes = np.linalg.eigh(sigma**2 * (S + S.T) / 2)
        is_known = information > 1
        along = (axes.T @ h)[is_known] / information[is_known]
        chi2 = float(along**2 @ information[is_known])
        chance = log10_chance(chi2, len(along)) + np.log10(explanation.n_tried)
        return Gain(explanation, min(chance, 0.0), len(along), -sigma * axes[:, is_known] @ along)

    def candidates(self) -> Iterator[Explanation]:
        """List what is tried."""
        layout, F = self.hypothesis.state.layout, len(self.cost.gradients)
        for cause in _FREED.keys() - self.assumed:
            if cause == "lens" and len(layout.optics(0)) == 0:
                continue
            if cause in ("azimuths", "elevations") and layout.n_rings < 2:
                continue
            yield Explanation(cause)
        cuts = range(_FEWEST_AT_END, F - _FEWEST_AT_END + 1)
        order = np.arange(F)
        for cut in cuts:
            # The fewer captures are of a mounting of their own.
            is_own = order < cut if 2 * cut < F else order >= cut
            yield Explanation("moved", is_own.astype(np.float64), len(cuts), cut)
        for k in order:
            yield Explanation("alone", (order == k).astype(np.float64), F, int(k))
        if F >= _FEWEST_IN_GROUPS and np.count_nonzero(np.diff(members := self.divide())) > 1:
            yield Explanation("groups", members, 2.0 ** (F - 1))
        middle = order / max(F - 1, 1) - 0.5
        for cause in ("drift", "focus_drift"):
            yield Explanation(cause, middle)

    def divide(self) -> Array:
        """Share captures out over two extrinsics that explain them best, by k-means: (F,) of 0 and 1."""
        g, HD, H = self.by_pose
        g = g + np.einsum("kga,g->ka", HD, self.step)
        F, eye = len(g), np.eye(6)
        starts = np.random.default_rng(0).random((_N_STARTS, F)) < 0.5
        starts[0] = np.arange(F) % 2 == 0
        best, members = -np.inf, starts[0]
        for is_first in starts:
            for _ in range(_N_ROUNDS):
                x = [
                    -np.linalg.solve(np.tensordot(w, H, 1) + eye, w @ g)
                    for w in (is_first * 1.0, 1.0 - is_first)
                ]
                costs = [2 * g @ each + np.einsum("i,kij,j->k", each, H, each) for each in x]
                is_now = costs[0] < costs[1]
                if min(is_now.sum(), (~is_now).sum()) < _FEWEST_OF_GROUP or (is_now == is_first).all():
                    break
                is_first = is_now
            fall = -float(np.minimum(*costs).sum())
            if fall > best:
                best, members = fall, is_first
        smaller = members if 2 * members.sum() <= F else ~members
        return np.asarray(smaller, dtype=np.float64)

    def rows(self) -> list[Gain]:
        """List the best explanation of each cause, the most significant first."""
        best: dict[Cause, Gain] = {}
        for explanation in self.candidates():
            found = self.gain(explanation)
            held = best.get(explanation.cause)
            if held is None or found.log10_chance < held.log10_chance:
                best[explanation.cause] = found
        return sorted(best.values(), key=lambda each: each.log10_chance)


def log10_chance(chi2: float, freedoms: int) -> float:
    """Compute the logarithm of the probability to exceed a chi-squared."""
    from scipy.special import chdtrc, gammaln

    if freedoms == 0:
        return 0.0
    chance = float(chdtrc(freedoms, max(chi2, 0.0)))
    if chance > 1e-250:
        return float(np.log10(chance))
    half = chi2 / 2
    return float((-half + (freedoms / 2 - 1) * np.log(half) - gammaln(freedoms / 2)) / np.log(10))


def explain(hypothesis: Hypothesis) -> tuple[list[Selected], list[Gain]]:
    """Assume explanations until none is significant.

    Args:
        hypothesis: the assumptions of the estimate.

    Returns:
        The explanations assumed, and the table before any was.
    """
    selected: list[Selected] = []
    first: list[Gain] = []
    assumed: frozenset[Cause] = frozenset()
    for _ in range(_MOST):
        rows = Table(hypothesis, assumed).rows()
        first = first or rows
        if rows[0].log10_chance > _LEAST:
            break
        # Larger errors of the images explain captures that disagree, too.
        noisy = hypothesis.with_fitted_noise()
        tried = {row.explanation.cause: row for row in (*Table(noisy, assumed).rows()[:1], rows[0])}
        if rows[0].explanation.is_of_mounting:
            tried |= {row.explanation.cause: row for row in rows if row.explanation.is_of_mounting}
        best = min(
            (_assume(hypothesis, noisy, row) for row in tried.values()),
            key=lambda each: each.gain.log10_chance,
        )
        if best.gain.log10_chance > _LEAST:
            break
        selected.append(best)
        hypothesis, assumed = best.after, assumed | {best.gain.explanation.cause}
    return selected, first


def _assume(hypothesis: Hypothesis, noisy: Hypothesis, row: Gain) -> Selected:
    """Settle under an explanation, and compare deviances with noise that is fitted with and without it."""
    after, change = assume(hypothesis, row)
    fall = noisy.deviance - after.with_fitted_noise().deviance
    chance = log10_chance(fall, row.freedoms) + np.log10(row.explanation.n_tried)
    return Selected(row._replace(log10_chance=min(chance, 0.0)), change, after)


def assume(now: Hypothesis, gain: Gain) -> tuple[Hypothesis, Array]:
    """Settle the likelihood under an explanation: what it is then, and the change of the extrinsics (6,)."""
    explanation = gain.explanation
    if explanation.is_of_mounting and explanation.cause != "drift":
        assert explanation.weights is not None
        members = explanation.weights > 0
        n = int(now.mounting.max()) + 1
        own = int(np.bincount(now.mounting[members]).argmax())
        mounting = np.where(members, n, now.mounting)
        kept, mounting = np.unique(mounting, return_inverse=True)
        T = np.append(now.state.T_cam_lidar, perturb(now.state.T_cam_lidar[own], gain.value)[None], axis=0)[
            kept
        ]
        after = now.under(mounting=mounting, T_cam_lidar=T)
        names = kept.tolist()
        if own not in names:
            return after, np.zeros(6)
        before_after = after.state.T_cam_lidar[[names.index(own), names.index(n)]]
        return after, difference(before_after[1], before_after[0])
    if explanation.cause in _FREED:
        after = now.under(priors=replace(now.priors, **_FREED[explanation.cause]))
        return after, difference(after.T_cam_lidar[0], now.T_cam_lidar[0])
    return now, np.zeros(6)
