"""Sub-pixel corners: a blurred checkerboard crossing fitted to the grey values around each corner."""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from lce_rig.core.geometry import Array

# Reach of the fitted patch towards the neighbouring corners: less than half way, so that blurred edges of the
# next corners stay outside.
_REACH = 0.42
_MAX_SAMPLES_PER_SIDE = 25
_STEPS = 12
_MIN_SIGMA_PX = 0.25
# Fits that gain no more than this share of their cost in a step are done: corners rest to 1e-3 px.
_SETTLED = 1e-6


@dataclass(frozen=True, eq=False)
class Crossings:
    """The crossings fitted to a grid of corners.

    Attributes:
        grid_px: (rows, cols, 2) corners; where a fit failed, as they were given.
        is_fitted: (rows, cols) whether the fit succeeded.
        contrast: (rows, cols) white minus black, grey values; the sign tells the colour of the quadrants.
        edge_sigma_px: (rows, cols, 2) blur across the edges that run down the columns and along the rows.
        noise: rms of the grey values about the model, whole board.
    """

    grid_px: Array
    is_fitted: NDArray[np.bool_]
    contrast: Array
    edge_sigma_px: Array
    noise: float


def fit_crossings(
    grey: NDArray[np.uint8], grid_px: Array, most_samples: int = _MAX_SAMPLES_PER_SIDE
) -> Crossings:
    """Fit I(a, b) = m + c g(f1 / s1) g(f2 / s2) around every corner at once, by Levenberg-Marquardt.

    (a, b) are coordinates along the sides of the squares at the corner; f1 = (a - a0) - alpha (b - b0) and
    f2 = (b - b0) - beta (a - a0) vanish on the two edges; g(x) = tanh(0.85 x) is within 2 % of the
    profile erf(x / sqrt 2) of an edge under Gaussian blur. The two blurs are separate: motion blurs one more.

    Unlike `cv2.cornerSubPix`, whose window must be square and hold one corner, the patch follows the squares
    down to the few pixels of tilted and far ones.

    Args:
        grey: (H, W).
        grid_px: (rows, cols, 2) corners to within a third of a square.
        most_samples: per side of a patch; of fewer a fit is faster and noisier.
    """
    e1, e2 = _sides(grid_px)
    area = np.abs(e1[..., 0] * e2[..., 1] - e1[..., 1] * e2[..., 0])
    # Width of a square across its edges: what one unit of a and of b is in px.
    height_px = np.stack([area / np.linalg.norm(e2, axis=-1), area / np.linalg.norm(e1, axis=-1)], axis=-1)
    longest_px = float(np.median(np.maximum(np.linalg.norm(e1, axis=-1), np.linalg.norm(e2, axis=-1))))
    n = int(np.clip(2 * round(_REACH * longest_px) + 1, 7, most_samples))
    axis = np.linspace(-_REACH, _REACH, n)
    b, a = (grid.ravel() for grid in np.meshgrid(axis, axis, indexing="ij"))
    pixels = grid_px[..., None, :] + a[:, None] * e1[..., None, :] + b[:, None] * e2[..., None, :]
    values = sample(grey, pixels).reshape(-1, n * n)

    flat_height = height_px.reshape(-1, 2)
    parameters, residuals = _fit(values, a, b, flat_height)
    shift = parameters[:, :2].reshape(grid_px.shape)
    sigma_px = np.exp(parameters[:, 6:8]) * flat_height
    noise = np.sqrt(np.mean(residuals**2, axis=1))
    contrast = 2.0 * parameters[:, 5]
    is_fitted = (np.abs(parameters[:, :2]).max(axis=1) < 0.35) & (np.abs(contrast) > 2.0 * noise)
    is_fitted &= np.abs(parameters[:, 2:4]).max(axis=1) < 0.7
    is_fitted = is_fitted.reshape(grid_px.shape[:2])
    moved = grid_px + shift[..., :1] * e1 + shift[..., 1:] * e2
    return Crossings(
        grid_px=np.where(is_fitted[..., None], moved, grid_px),
        is_fitted=is_fitted,
        contrast=contrast.reshape(is_fitted.shape),
        edge_sigma_px=sigma_px.reshape(grid_px.shape),
        noise=float(np.median(noise)),
    )


def sample(grey: NDArray[np.uint8], pixels: Array) -> Array:
    """Interpolate grey values bilinearly at (..., 2) px; beyond the border its value is kept."""
    # cv2.remap takes at most 32766 rows and columns.
    maps = np.asarray(pixels, dtype=np.float32).reshape(-1, pixels.shape[-2], 2)
    values = cv2.remap(grey, maps[..., 0], maps[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(values, dtype=np.float64).reshape(pixels.shape[:-1])


def _sides(grid_px: Array) -> tuple[Array, Array]:
    """Measure the local side vectors along rows and columns, (rows, cols, 2) each."""
    return np.gradient(grid_px, axis=1), np.gradient(grid_px, axis=0)


def _fit(values: Array, a: Array, b: Array, height_px: Array) -> tuple[Array, Array]:
    """Fit all patches (K, n): parameters (K, 8) a0 b0 alpha beta m c log(s1) log(s2), residuals (K, n)."""
    count = len(values)
    mean = values.mean(axis=1)
    swing = ((values - mean[:, None]) * np.sign(a * b)).mean(axis=1)
    p = np.zeros((count, 8))
    p[:, 4], p[:, 5] = mean, swing
    p[:, 6:8] = np.log(np.clip(0.8 / height_px, 1e-3, 0.3))
    lowest = np.log(_MIN_SIGMA_PX / height_px)
    damping = np.full(count, 1e-2)
    residuals, J = _model(p, values, a, b)
    cost = np.sum(residuals**2, axis=1)
    for _ in range(_STEPS):
        H = J @ np.swapaxes(J, 1, 2)
        diagonal = np.einsum("kii->ki", H)
        damped = (
            H
            + np.eye(8)
            * (damping[:, None] * diagonal + 1e-9 * diagonal.max(axis=1, keepdims=True) + 1e-12)[:, None, :]
        )
        step = -np.linalg.solve(damped, J @ residuals[..., None])[..., 0]
        candidate = p + step
        candidate[:, :4] = np.clip(candidate[:, :4], -1.0, 1.0)
        candidate[:, 6:8] = np.clip(candidate[:, 6:8], lowest, 0.0)
        new_residuals, new_J = _model(candidate, values, a, b)
        new_cost = np.sum(new_residuals**2, axis=1)
        is_better = new_cost < cost
        is_settled = np.all(np.abs(cost - new_cost) <= _SETTLED * cost)
        p[is_better], cost[is_better] = candidate[is_better], new_cost[is_better]
        residuals[is_better], J[is_better] = new_residuals[is_better], new_J[is_better]
        damping = np.where(is_better, damping * 0.2, damping * 5.0)
        if is_settled:
            break
    return p, residuals


def _model(p: Array, values: Array, a: Array, b: Array) -> tuple[Array, Array]:
    """Evaluate the model's residuals (K, n) and their derivatives (K, 8, n)."""
    a0, b0, alpha, beta, m, c, log_s1, log_s2 = (column[:, None] for column in p.T)
    from_a, from_b = a - a0, b - b0
    f1, f2 = from_a - alpha * from_b, from_b - beta * from_a
    k1, k2 = 0.85 * np.exp(-log_s1), 0.85 * np.exp(-log_s2)
    g1, g2 = np.tanh(k1 * f1), np.tanh(k2 * f2)
    d1, d2 = c * k1 * (1 - g1**2) * g2, c * k2 * (1 - g2**2) * g1
    J = np.empty((len(p), 8, values.shape[1]))
    J[:, 0] = d2 * beta - d1
    J[:, 1] = d1 * alpha - d2
    J[:, 2] = -d1 * from_b
    J[:, 3] = -d2 * from_a
    J[:, 4] = 1.0
    J[:, 5] = g1 * g2
    J[:, 6] = -d1 * f1
    J[:, 7] = -d2 * f2
    return m + c * J[:, 5] - values, J
