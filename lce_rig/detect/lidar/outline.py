"""Fit a rectangle to rays near a plate, by the likelihood of returns on the plate and beside it.

A ray that hits the plate's plane at u returns from the plate with the probability

    P(u) = eps + (1 - 2 eps) prod_e Phi(-s_e(u) / w_e)                                                    (1)

with s_e the distance beyond side e and w_e the blur across it: half the beam's width there and the noise of
directions. Rays that return from behind, or from nowhere, passed beside the plate; those that return from
before it are not used. The unknowns are the rectangle's position, rotation, and excess width and height:
wide beams return from a plate that they only graze.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from lce_rig.core.geometry import Array
from lce_rig.detect.lidar.measurement import SLACK_M
from lce_rig.detect.lidar.segments import Indices
from lce_rig.detect.lidar.template import CAP_M, Placement

N_ANGLES = 9
# Fraction of rays on the wrong side of any border; with 0, a single ray would decide.
_OUTLIERS = 0.02
# Blurs of the first rounds, m, which converge from an inaccurate start; wider ones for a rough start.
_ANNEALED_M = (0.04, 0.02)
_WIDE_M = tuple(np.geomspace(0.2, _ANNEALED_M[0], 8).tolist())
_FEW_RAYS, _SMEAR_RAYS, _MOST_RAYS = 800, 4_000, 15_000
_ROUNDS = 12
# Maximum fraction of rays that contradict the placement of a clear plate.
_MOST_CLEAR_MISSES = 0.1
STRIP_M = 0.07
"""Length of border whose place is measured on its own."""
_CORNER_M = 0.04
_SMEARS_M = np.append(0.0, np.geomspace(0.005, 0.06, 7))
_OFFSETS_M = np.linspace(-SLACK_M, SLACK_M, 41)


@dataclass(frozen=True, eq=False)
class Rays:
    """M rays that intersect a plate's plane.

    Attributes:
        uv: (M, 2) intersections with the plane, m.
        is_on: (M,) whether they return from the plane; else they passed beside the plate.
    """

    uv: Array
    is_on: NDArray[np.bool_]

    def select(self, keep: NDArray[np.bool_] | Indices) -> "Rays":
        """Keep the rays of a mask (M,) or index."""
        return Rays(self.uv[keep], self.is_on[keep])


class Outline(NamedTuple):
    """A rectangle fitted to rays.

    Attributes:
        placement: fit of the nominal size; `error_m` is the mean of -ln P over the rays near the border.
        growth_m: (2,) excess of half its width and half its height over the nominal ones.
        cov: (5, 5) of u, v, angle and growth.
    """

    placement: Placement
    growth_m: Array
    cov: Array


def thin(n: int, most: int) -> Indices:
    """Choose about `most` of n returns at random, with a fixed seed; all if there are fewer.

    A fixed step would select only a few of a LiDAR's lines, which recur in order and share errors.
    """
    if n <= most:
        return np.arange(n)
    return np.flatnonzero(np.random.default_rng(0).random(n) < most / n)


def fit_outline(
    rays: Rays,
    start: Placement,
    blur_m: Callable[[Array], Array],
    growth_m: tuple[Array, float],
    annealed_m: tuple[float, ...] = _ANNEALED_M,
) -> Outline | None:
    """Maximise (1) over position, rotation and growth by Fisher scoring.

    Args:
        rays: rays near the plate.
        start: initial placement, within a few centimetres and degrees.
        blur_m: w for unit normals (..., 2) of the plane view.
        growth_m: prior mean (2,) and standard deviation of the growth.
        annealed_m: least blurs of the first rounds.

    Returns:
        The optimum, None if no ray is near the border.
    """
    rays = rays.select(np.abs(start.distance_m(rays.uv)) < CAP_M + 3 * max(annealed_m))
    rays = rays.select(thin(len(rays.uv), _MOST_RAYS))
    expected = np.array([0.0, 0.0, 0.0, *growth_m[0]])
    x = expected + [start.u_m, start.v_m, start.angle_rad, 0.0, 0.0]
    half = np.array(start.half_m)
    prior = np.diag([0.0, 0.0, 0.0, 1.0, 1.0]) / growth_m[1] ** 2
    for k in range(_ROUNDS):
        least = annealed_m[k] if k < len(annealed_m) else 0.0
        placement = Placement(x[0], x[1], x[2], (half[0] + x[3], half[1] + x[4]))
        local = placement.local(rays.uv)
        near = np.abs(placement.beyond_m(local)) < max(CAP_M, 3 * least)
        if np.count_nonzero(near & rays.is_on) < 10:
            return None
        local = local[near]
        blur = np.maximum(blur_m(placement.axes), least)
        p, slopes = _probability(local, half + x[3:], blur)
        is_on = rays.is_on[near]
        # In the order u, v, angle, growth; the shift is along the rectangle's axes.
        right, left, top, bottom = slopes
        by_x, by_y = right - left, top - bottom
        turned = by_x * local[:, 1] - by_y * local[:, 0]
        J = np.array([-by_x, -by_y, turned, -(right + left), -(top + bottom)])
        score = J @ np.where(is_on, 1 / p, -1 / (1 - p)) - prior @ (x - expected)
        information = J @ (J / (p * (1 - p))).T + prior
        step = np.linalg.solve(information + 1e-3 * np.eye(5), score)
        step *= min(1.0, 0.05 / max(float(np.abs(step[:2]).max()), 1e-9))
        x = x + [*(step[:2] @ placement.axes), *step[2:]]
        if k > len(annealed_m) and np.abs(step).max() < 1e-4:
            break
    cost = float(np.mean(-np.log(np.where(is_on, p, 1 - p))))
    placement = Placement(float(x[0]), float(x[1]), float(x[2]), start.half_m, cost)
    return Outline(placement, x[3:], np.asarray(np.linalg.inv(information), dtype=np.float64))


def register_rays(rays: Rays, half_m: tuple[float, float]) -> list[Placement]:
    """Fit the rectangle from all angles about the origin; return the two best placements, best first.

    `error_m` is the ratio of rays that contradict the placement to returns on the plate.

    Args:
        rays: about a plate whose middle is near the origin.
        half_m: half width and half height.
    """
    placements = _from_all_angles(rays, half_m, np.zeros(2), _WIDE_M)
    if placements and placements[0].error_m > _MOST_CLEAR_MISSES:
        placements += _from_all_angles(rays, half_m, _middle_of_wide(rays, half_m), _ANNEALED_M)
    return sorted(placements, key=lambda placement: placement.error_m)[:2]


def _middle_of_wide(rays: Rays, half_m: tuple[float, float]) -> Array:
    """Find the centre (2,) of the parts wider than half the plate's short side, m: a stand is narrower.

    The middle of a patch lies towards the stand that its plate merges with.
    """
    from scipy.spatial import cKDTree

    on, beside = rays.uv[rays.is_on], rays.uv[~rays.is_on]
    if len(beside) == 0:
        return np.zeros(2)
    on = on[thin(len(on), _FEW_RAYS)]
    away_m, _ = cKDTree(beside).query(on)
    deep = on[(away_m > min(half_m) / 2) & ((on**2).sum(axis=1) < np.hypot(*half_m) ** 2)]
    return np.asarray(deep.mean(axis=0)) if len(deep) else np.zeros(2)


def _from_all_angles(
    rays: Rays, half_m: tuple[float, float], middle: Array, annealed_m: tuple[float, ...]
) -> list[Placement]:
    """Fit the rectangle from all angles about a point (2,), best first; `annealed_m` as in `fit_outline`."""
    radius_m = 1.25 * float(np.hypot(*half_m))
    about = rays.select(((rays.uv - middle) ** 2).sum(axis=1) < radius_m**2)
    few = about.select(thin(len(about.uv), _FEW_RAYS))
    placements = []
    for angle in np.arange(N_ANGLES) * np.pi / N_ANGLES:
        start = Placement(float(middle[0]), float(middle[1]), float(angle), half_m)
        fit = fit_outline(
            few, start, lambda normals: np.full(len(normals), 0.03), (np.zeros(2), 1e-3), annealed_m
        )
        if fit is not None:
            distance = fit.placement.distance_m(about.uv)
            on = about.is_on & (distance < 0.15)
            misses = np.count_nonzero(on & (distance > 0.02)) + np.count_nonzero(
                ~about.is_on & (distance < -0.02)
            )
            share = float(misses / max(np.count_nonzero(on & (distance <= 0.02)), 1))
            placements.append(replace(fit.placement, error_m=share))
    return sorted(placements, key=lambda placement: placement.error_m)


def measure_smears(rays: Rays, outline: Outline, blur_m: Callable[[Array], Array]) -> Array:
    """Measure the blur of each side's border beyond that of the beam, m.

    Args:
        rays: about the plate.
        outline: fitted to them.
        blur_m: as in `fit_outline`.

    Returns:
        (4,) smear of the right, left, top and bottom side.
    """
    placement = outline.placement
    near = rays.select(np.abs(placement.distance_m(rays.uv)) < CAP_M)
    near = near.select(thin(len(near.uv), _SMEAR_RAYS))
    local, half = placement.local(near.uv), np.array(placement.half_m) + outline.growth_m
    beam_m = blur_m(placement.axes)[[0, 0, 1, 1]]
    over = np.stack([local[:, 0], -local[:, 0], local[:, 1], -local[:, 1]]) - half[[0, 0, 1, 1], None]
    nearest = over.argmax(axis=0)
    log_p = []
    for smear_m in _SMEARS_M:
        p, _ = _probability(local, half, np.hypot(beam_m, smear_m))
        log_p.append(np.bincount(nearest, np.log(np.where(near.is_on, p, 1 - p)), 4))
    return np.asarray(_SMEARS_M[np.argmax(log_p, axis=0)])


def _probability(local: Array, half: Array, blur: Array) -> tuple[Array, Array]:
    """Compute (1) for points (M, 2) in the rectangle's axes, and its derivative (4, M) by each distance s_e.

    Sides are right, left, top and bottom; `blur` has one value per side, or one per pair of sides.
    """
    from scipy.special import ndtr

    x, y = local.T
    half, blur = half[[0, 0, 1, 1], None], (blur if len(blur) == 4 else blur[[0, 0, 1, 1]])[:, None]
    z = (half - [x, -x, y, -y]) / blur
    factors = ndtr(z)
    inside = factors[0] * factors[1] * factors[2] * factors[3]
    density = np.exp(-0.5 * z * z) / (np.sqrt(2 * np.pi) * blur)
    slopes = -(1 - 2 * _OUTLIERS) * inside * density / np.maximum(factors, 1e-12)
    return _OUTLIERS + (1 - 2 * _OUTLIERS) * inside, slopes


class Strips(NamedTuple):
    """K short pieces of the border, each measured separately.

    Attributes:
        uv: (K, 2) their middles at the end of the plate's returns, m.
        outwards: (K, 2) unit normals.
        off_m: (K,) distance outwards from the fitted outline.
        sigma_m: (K,) standard deviations.
        side: (K,) of `measure_smears`.
    """

    uv: Array
    outwards: Array
    off_m: Array
    sigma_m: Array
    side: Indices


def measure_strips(rays: Rays, outline: Outline, blur_m: Callable[[Array], Array], smears_m: Array) -> Strips:
    """Measure the position of each piece of the border: the mean outward shift under (1).

    Args:
        rays: about the plate.
        outline: fitted to them.
        blur_m: as in `fit_outline`.
        smears_m: (4,) smear of the sides' borders, beyond that blur.
    """
    from scipy.special import ndtr

    placement = outline.placement
    half = np.array(placement.half_m) + outline.growth_m
    local, axes = placement.local(rays.uv), placement.axes
    parts = []
    for axis in (0, 1):
        length = 2 * (half[1 - axis] - _CORNER_M)
        n_strips = max(int(length / STRIP_M), 1)
        width = length / n_strips
        along = (local[:, 1 - axis] + length / 2) / width
        for side, sign in ((2 * axis, 1.0), (2 * axis + 1, -1.0)):
            blur = float(np.hypot(blur_m(axes[axis][None])[0], smears_m[side]))
            beyond = sign * local[:, axis] - half[axis]
            use = (np.abs(beyond) < CAP_M) & (along >= 0) & (along < n_strips)
            strip, s, is_on = along[use].astype(np.intp), beyond[use], rays.is_on[use]
            # Without rays near the border, it may lie anywhere between the rays on its two sides.
            p = _OUTLIERS + (1 - 2 * _OUTLIERS) * ndtr((_OFFSETS_M[:, None] - s) / blur)
            log_p = np.log(np.where(is_on, p, 1 - p))
            total = np.stack([np.bincount(strip, row, n_strips) for row in log_p])
            weight = np.exp(total - total.max(axis=0))
            weight /= weight.sum(axis=0)
            off = _OFFSETS_M @ weight
            sigma_m = np.sqrt(np.maximum(_OFFSETS_M**2 @ weight - off**2, 0.0))
            n_on = np.bincount(strip[is_on], minlength=n_strips)
            n_beside = np.bincount(strip[~is_on], minlength=n_strips)
            is_seen = (n_on >= 4) & (n_beside >= 4)
            middle = (np.arange(n_strips) + 0.5) * width - length / 2
            at = np.empty((n_strips, 2))
            at[:, axis], at[:, 1 - axis] = sign * (half[axis] + off), middle
            uv = at @ axes + [placement.u_m, placement.v_m]
            outwards = np.tile(sign * axes[axis], (n_strips, 1))
            sides = np.full(n_strips, side)
            parts.append([each[is_seen] for each in (uv, outwards, off, sigma_m, sides)])
    return Strips(*(np.concatenate(part) for part in zip(*parts, strict=True)))
