"""Extrinsics from a scene's edges in all six axes and a prior such as a board's, with a covariance."""

from collections.abc import Sequence
from statistics import NormalDist

import numpy as np
from numpy.typing import NDArray

from lce_rig.core.camera import Intrinsics
from lce_rig.core.geometry import Array, difference, perturb
from lce_rig.scene.alignment import IS_ROTATION, Alignment, SceneView

BIAS = np.array([0.005, 0.005, 0.010, *np.radians([0.10, 0.05, 0.15])])
"""What one scene's maximum is off by beyond the scatter of its parts: sigmas in the order of MOTIONS."""

_UNIT = np.where(IS_ROTATION, np.radians(1.0), 0.03)  # Either moves an edge 2 m away by about as much.
_MAX_STEPS, _LEAST_GAIN = 20, 0.01
_CELL_RAD, _CELL_LOG = 0.1, 0.15  # A part of the scene: an upright object, by azimuth and logarithm of range.
_SHIFTS = (0.0, 0.25, 0.5, 0.75)  # of the grids of cells, in cells
_MAX_LEVERAGE = 0.9  # A part that decides a direction alone counts with at most ten times its gradient.
_CHANCE = 2.0  # A direction needs a curvature of more than the root of so many variances over the parts.
# Other maxima are looked for along the two least certain directions, in units of _UNIT.
_N_WEAK, _OFFSETS = 2, (-1.4, -0.7, 0.7, 1.4)
_LEAST_REACH = 0.3
_SAME = 0.15  # Maxima so close are one.


def estimate(
    views: Sequence[SceneView], intrinsics: Intrinsics, T_prior: Array, cov_prior: Array
) -> tuple[Array, Array]:
    """Estimate extrinsics from the edges of a scene and a prior.

    With the gradient g of the score by the tangent, H minus its curvature at the scale of its peak, and J the
    sum of g g^T over parts of the scene, the scene's maximum has the covariance H^-1 J H^-1 + B, B its bias.
    With a prior (x0, P) the estimate solves W g(x) + P^-1 (x0 - x) = 0, W = H (J + H B H)^-1, and has the
    covariance (W H + P^-1)^-1. A part of the scene counts once, however many captures show it.

    Args:
        views: captures.
        intrinsics: of the camera.
        T_prior: (4, 4) extrinsics, where the search starts.
        cov_prior: (6, 6) of their tangent.

    Returns:
        T_cam_lidar (4, 4), and the covariance (6, 6) of its tangent (translation m, rotation rad), axes of
        the camera. In directions that the scene does not show it is the prior's.
    """
    if not any(len(view.edges) for view in views):
        return T_prior, cov_prior
    held = np.linalg.inv(cov_prior / np.outer(_UNIT, _UNIT))
    alignment = Alignment(views, intrinsics, T_prior)
    maxima = _search(alignment, T_prior, held)
    # The parts of the scene that points (N, 3) belong to, (N,) each: cells of shifted grids.
    x, y, _ = alignment.points.T
    log_range = np.log(np.linalg.norm(alignment.points, axis=1))
    grid = np.stack([np.arctan2(y, x) / _CELL_RAD, log_range / _CELL_LOG], axis=1)
    cells = [
        np.unique(np.floor(grid + shift), axis=0, return_inverse=True)[1].ravel().astype(np.intp)
        for shift in _SHIFTS
    ]
    T, information = _balance(alignment, cells, maxima[0], T_prior, held)
    cov = np.linalg.inv(information + held) + _rivalry(alignment, cells, maxima)
    return T, np.outer(_UNIT, _UNIT) * cov


def _search(alignment: Alignment, T_prior: Array, held: Array) -> list[Array]:
    """Find maxima of the score and the prior, the highest first."""
    coarse = alignment.coarser()
    found = [_climb(alignment, T_prior, T_prior, held)]
    T = T_prior
    for blunt in (coarse.coarser(), coarse, alignment):
        T, height = _climb(blunt, T, T_prior, held)
    found.append((T, height))
    T = max(found, key=lambda each: each[1])[0]
    _, curvatures = alignment.expand(T)
    bend = _positive(-curvatures.sum(axis=0) * np.outer(_UNIT, _UNIT)) + held
    for direction in np.linalg.eigh(bend)[1].T[:_N_WEAK]:
        reach = min(1.0, 2.0 / float(np.sqrt(direction @ held @ direction)))
        if reach > _LEAST_REACH:
            starts = [perturb(T, offset * reach * direction * _UNIT) for offset in _OFFSETS]
            found.extend(_climb(alignment, start, T_prior, held) for start in starts)
    return [T for T, _ in sorted(found, key=lambda each: -each[1])]


def _rivalry(alignment: Alignment, cells: list[NDArray[np.intp]], maxima: list[Array]) -> Array:
    """Sum the covariance that lower maxima add, each by the chance that it is the right one."""
    best, met, added = alignment.shares(maxima[0]), maxima[:1], np.zeros((6, 6))
    for T in maxima[1:]:
        if any(np.linalg.norm(difference(T, other) / _UNIT) < _SAME for other in met):
            continue
        met.append(T)
        gain = (best - alignment.shares(T))[:, None]
        sigma = np.sqrt(np.mean([np.sum(_sums(gain, cell) ** 2) for cell in cells]))
        off = difference(T, maxima[0]) / _UNIT
        added += NormalDist().cdf(-float(gain.sum() / max(sigma, 1e-12))) * np.outer(off, off)
    return added


def _climb(alignment: Alignment, T: Array, T_prior: Array, held: Array) -> tuple[Array, float]:
    """Find the nearest maximum of the score and the prior by Newton's method, damped."""

    def value(T: Array) -> float:
        off = difference(T, T_prior) / _UNIT
        return float(alignment.shares(T).sum() - 0.5 * off @ held @ off)

    best, damping = value(T), 0.1
    for _ in range(_MAX_STEPS):
        gradients, curvatures = alignment.expand(T)
        pull = gradients.sum(axis=0) * _UNIT - held @ (difference(T, T_prior) / _UNIT)
        bend = _positive(-curvatures.sum(axis=0) * np.outer(_UNIT, _UNIT)) + held
        gain = 0.0
        while damping < 1e3:
            step = np.linalg.solve(bend + damping * np.diag(np.diag(bend)), pull)
            tried = perturb(T, step * _UNIT)
            gain = value(tried) - best
            if gain > 0:
                T, best, damping = tried, best + gain, max(damping / 4, 1e-3)
                break
            damping *= 4
        if gain < _LEAST_GAIN:
            break
    return T, best


def _balance(
    alignment: Alignment, cells: list[NDArray[np.intp]], T: Array, T_prior: Array, held: Array
) -> tuple[Array, Array]:
    """Weigh the scene against the prior by what it knows; (extrinsics, the scene's information)."""
    gradients, curvatures = alignment.expand(T)
    gradients, curvatures = gradients * _UNIT, -curvatures * np.outer(_UNIT, _UNIT)
    parts = [
        (_sums(gradients, cell), _sums(curvatures.reshape(-1, 36), cell).reshape(-1, 6, 6)) for cell in cells
    ]
    curvature = _certain([curvatures for _, curvatures in parts])
    scatter = np.mean([_scatter(*each, curvature + held) for each in parts], axis=0)
    bias = np.diag((BIAS / _UNIT) ** 2)
    weight = curvature @ np.linalg.pinv(scatter + curvature @ bias @ curvature, rcond=1e-9, hermitian=True)
    information = weight @ curvature
    off = difference(T, T_prior) / _UNIT
    step = np.linalg.solve(information + held, weight @ gradients.sum(axis=0) - held @ off)
    return perturb(T, step * _UNIT), _symmetric(information)


def _sums(values: Array, cell: NDArray[np.intp]) -> Array:
    """Sum values (N, K) by cell, (P, K)."""
    order = np.argsort(cell, kind="stable")
    first = np.flatnonzero(np.diff(cell[order], prepend=-1))
    return np.asarray(np.add.reduceat(values[order], first, axis=0))


def _scatter(gradients: Array, curvatures: Array, total: Array) -> Array:
    """Estimate the covariance of the sum of the parts' gradients by leaving out each part.

    A part that alone decides a direction pulls the maximum to where its own gradient vanishes: each gradient
    is enlarged to what it would be at the maximum of the others, by (1 - C_part C^-1)^-1.

    Args:
        gradients: (P, 6) of the parts.
        curvatures: (P, 6, 6) of the parts.
        total: (6, 6) curvature of all and of the prior.
    """
    root = np.linalg.cholesky(total)
    whiten = np.linalg.inv(root)
    leverage, axes = np.linalg.eigh(whiten @ _symmetric(curvatures) @ whiten.T)
    along = np.einsum("pji,pj->pi", axes, gradients @ whiten.T)
    others = np.einsum("pi,pji->pj", along / (1 - np.clip(leverage, 0.0, _MAX_LEVERAGE)), axes)
    return np.asarray(root @ (others.T @ others) @ root.T)


def _certain(by_cell: list[Array]) -> Array:
    """Take from a curvature summed over parts (P, 6, 6) what their scatter leaves certain.

    Directions with a curvature that may have arisen by chance fade.
    """
    values, vectors = np.linalg.eigh(_symmetric(by_cell[0].sum(axis=0)))
    along = [np.einsum("ik,pij,jk->pk", vectors, parts, vectors) for parts in by_cell]
    variance = np.mean([np.sum(parts**2, axis=0) for parts in along], axis=0)
    share = np.maximum(0.0, 1.0 - _CHANCE * variance / np.maximum(values, 1e-12) ** 2)
    return np.asarray((vectors * np.maximum(values, 0.0) * share) @ vectors.T)


def _symmetric(matrix: Array) -> Array:
    return 0.5 * (matrix + np.swapaxes(matrix, -1, -2))


def _positive(matrix: Array) -> Array:
    """Replace negative eigenvalues by their size."""
    values, vectors = np.linalg.eigh(_symmetric(matrix))
    return np.asarray((vectors * np.abs(values)) @ vectors.T)
