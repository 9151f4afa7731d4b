"""Density, score and information of the distance from a ring's last return on the board to the edge.

In units of the step to the next ray, let x be the distance of the last return inside the edge, less half a
step, beam width included. Without noise x is uniform in -1/2..1/2: the edge lies between the last ray that
hit the board and the first that did not. Three effects blur that:

    p(x) = (1 - a - b) core + a lost + b stray                                                           (1)

core   the uniform interval, its ends blurred by t (pattern, width of the beam); it determines the edge
       better than a normal distribution of the same variance;
lost   the last returns on the board are missing (weak, or merged with the person behind it): an
       exponential tail inwards, for few ring ends with a stand, for a fifth with a person behind the board;
stray  anything else (the neighbouring ray hit an object just behind the board), a Cauchy distribution.
"""

from collections.abc import Sequence
from functools import lru_cache

import numpy as np

from lce_rig.calibrate.likelihood.layout import Indices
from lce_rig.calibrate.likelihood.rays import EdgeRows
from lce_rig.core.geometry import Array

STRAY = 0.01
"""Fraction b of (1), from simulated and recorded captures; a is estimated."""
_LOST_STEPS = 1.1
"""Mean of `lost` of (1), steps: about one return. With less, ends short of several returns are stray."""
# Range of blurs and lost fractions in the information table. Narrower ones count as the narrowest; wider
# ones leave a normal density.
_NARROWEST = 0.01
_BLURS = np.geomspace(_NARROWEST, 30.0, 60)
_SHARES = np.array([0.001, 0.02, 0.05, 0.1, 0.2, 0.35, 0.6])


def density(x: Array, blur: Array, lost_share: float) -> tuple[Array, Array]:
    """Compute (1) and its derivative.

    Args:
        x: (M,) steps.
        blur: (M,) t, steps.
        lost_share: a.

    Returns:
        p and dp/dx, (M,) each.
    """
    return _mixed(*_parts(x, blur), lost_share)


def _mixed(densities: Sequence[Array], slopes: Sequence[Array], lost_share: float) -> tuple[Array, Array]:
    """Sum `_parts` with their shares."""
    shares = (1 - lost_share - STRAY, lost_share, STRAY)
    p, slope = (
        sum(share * part for share, part in zip(shares, parts, strict=True)) for parts in (densities, slopes)
    )
    return np.asarray(p), np.asarray(slope)


def _parts(x: Array, blur: Array) -> tuple[Sequence[Array], Sequence[Array]]:
    """Compute core, lost and stray of (1), and their derivatives."""
    from scipy.special import ndtr

    t = np.maximum(blur, _NARROWEST)
    low, high = (x + 0.5) / t, (x - 0.5) / t
    core, core_slope = ndtr(low) - ndtr(high), (_normal(low) - _normal(high)) / t
    lost = _exponential_with_noise(x, t)
    lost_slope = (_normal(x / t) / t - lost) / _LOST_STEPS
    width = np.maximum(t, 1.0)
    stray = 1 / (np.pi * width * (1 + (x / width) ** 2))
    stray_slope = -2 * x * np.pi / width * stray**2
    return (core, lost, stray), (core_slope, lost_slope, stray_slope)


def _exponential_with_noise(x: Array, t: Array) -> Array:
    """Compute the density of an exponential error of mean `_LOST_STEPS` plus a normal one of deviation t."""
    from scipy.special import erfcx, ndtr

    s = t / _LOST_STEPS
    z = x / t - s
    # Both forms are equal; choose the one that does not overflow.
    below = np.exp(-0.5 * (x / t) ** 2) * erfcx(-np.minimum(z, 0.0) / np.sqrt(2)) / 2
    above = np.exp(np.minimum(s**2 / 2 - x / _LOST_STEPS, 0.0)) * ndtr(z)
    return np.asarray(np.where(z < 0, below, above) / _LOST_STEPS)


def information(blur: Array, lost_share: float) -> Array:
    """Compute Fisher's information (M,) on the edge's position, the mean of (d ln p / dx)^2, per step^2."""
    table = _log_informations()
    row = float(np.interp(lost_share, _SHARES, np.arange(len(_SHARES))))
    low = min(int(row), len(_SHARES) - 2)
    between = table[low] + (row - low) * (table[low + 1] - table[low])
    inside = np.exp(np.interp(np.log(np.maximum(blur, _NARROWEST)), np.log(_BLURS), between))
    return np.asarray(inside * np.minimum(_BLURS[-1] / np.maximum(blur, _NARROWEST), 1.0) ** 2)


def edge_products(
    edges: EdgeRows, edge_rad: float, backed_rad: float, lost_share: float
) -> tuple[Indices, Array]:
    """Expand -2 ln p of the ring ends to second order, by capture and ring.

    With J a row without its residual: J J^T times the information, J times the score in the last column, and
    -2 ln p itself in the corner. The information is the mean over all ring ends of such a blur, as that of a
    single one is zero in the middle of its interval and unusable as a Hessian.

    Returns:
        Numbers (n,) of pairs of capture and ring, `EdgeRows.group`, and the products (n, 25, 25) of each.
    """
    D, blur = edges.step_m, edges.blur_m(edge_rad, backed_rad) / edges.step_m
    p, slope = density(edges.rows[:, -1] / D, blur, lost_share)
    weight, score = information(blur, lost_share) / D**2, -slope / p / D
    J = edges.rows[:, :-1]
    weighted = np.concatenate([J * weight[:, None], score[:, None]], axis=1)
    group = edges.group
    first = np.flatnonzero(np.diff(group, prepend=-1))
    counts = np.diff(first, append=len(J))
    products = np.zeros((len(first), J.shape[1] + 1, J.shape[1] + 1))
    # A ring has two ends on a board, and more on a partly hidden one.
    for n in np.unique(counts).tolist():
        at = first[counts == n, None] + np.arange(n)
        products[counts == n, :-1] = np.swapaxes(J[at], 1, 2) @ weighted[at]
    products[:, -1, :-1] = products[:, :-1, -1]
    if len(J):
        products[:, -1, -1] = np.add.reduceat(-2 * np.log(p / D), first)
    return group[first], products


@lru_cache(maxsize=1)
def _log_informations() -> Array:
    """Tabulate ln of the information by lost fraction and blur."""
    x = np.linspace(-1.0, 1.0, 2001)[:, None]
    # Finest where the core rises and falls.
    at = np.sign(x) * np.abs(x) ** 2 * (12.0 + 8.0 * _BLURS)
    blurs = np.broadcast_to(_BLURS, at.shape)
    parts = _parts(at, blurs)
    both = (_mixed(*parts, float(share)) for share in _SHARES)
    return np.array([np.log(np.trapezoid(slope**2 / p, at, axis=0)) for p, slope in both])


def _normal(z: Array) -> Array:
    return np.asarray(np.exp(-0.5 * z**2) / np.sqrt(2 * np.pi))
