"""Sub-pixel corners: a blurred checkerboard crossing fitted to the grey values around each corner."""

from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from lce_rig.core.geometry import Array

# Reach of the fitted patch towards the neighbouring corners: less than half way, so that blurred edges of the
# next corners stay outside.
REACH = 0.42
_MAX_SAMPLES_PER_SIDE = 25
# Samples per side and steps of a first, coarse fit; it saves steps of the slower final one.
_COARSE_SAMPLES = 9
_COARSE_STEPS = 6
# Spacing of samples above which the image is blurred first, px.
_FAR_APART_PX = 1.3
_STEPS = 12
_MIN_SIGMA_PX = 0.25
# Relative decrease of the cost below which a fit is finished: corners then move less than their noise.
_SETTLED = 1e-5


@dataclass(frozen=True, eq=False)
class Crossings:
    """The crossings fitted to a grid of corners.

    Attributes:
        grid_px: (rows, cols, 2) corners; the given ones if a fit failed.
        is_fitted: (rows, cols) whether the fit succeeded.
        contrast: (rows, cols) white minus black, grey values; its sign is that of the quadrants' colours.
        edge_sigma_px: (rows, cols, 2) blur across the edges that run down the columns and along the rows.
        misfit: (rows, cols) rms of the grey values about the model.
    """

    grid_px: Array
    is_fitted: NDArray[np.bool_]
    contrast: Array
    edge_sigma_px: Array
    misfit: Array


class Patches(NamedTuple):
    """The surroundings of corners of boards with markers.

    Attributes:
        e1_px: (rows, cols, 2) one unit of length to the right on the board, as `REACH` counts it.
        e2_px: (rows, cols, 2) one unit down on the board.
        clear: distance from an edge, in units, up to which there are no other marks.
    """

    e1_px: Array
    e2_px: Array
    clear: float


def fit_crossings(
    grey: NDArray[np.uint8],
    grid_px: Array,
    most_samples: int = _MAX_SAMPLES_PER_SIDE,
    patches: Patches | None = None,
) -> Crossings:
    """Fit I(a, b) = m + c g(f1 / s1) g(f2 / s2) around every corner at once, by Levenberg-Marquardt.

    (a, b) are coordinates along the sides of the squares at the corner; f1 = (a - a0) - alpha (b - b0) and
    f2 = (b - b0) - beta (a - a0) vanish on the two edges; g(x) = tanh(0.85 x) is within 2 % of the
    profile erf(x / sqrt 2) of an edge under Gaussian blur. The two blurs are separate: motion blurs one more.

    Unlike `cv2.cornerSubPix`, whose window must be square and hold one corner, the patch follows the squares
    down to the few pixels of tilted and distant ones.

    Args:
        grey: (H, W).
        grid_px: (rows, cols, 2) corners to within a third of a square.
        most_samples: maximum number of samples per side of a patch; fewer make a fit faster and noisier.
        patches: for patterns other than checkerboards.
    """
    n_coarse = min(_COARSE_SAMPLES, most_samples)
    coarse, parameters = _fit_patches(grey, grid_px, n_coarse, None, patches, _COARSE_STEPS)
    if not coarse.is_fitted.all():
        # Patches are independent: one that slips from its corner does not affect the others.
        return _fit_patches(grey, grid_px, most_samples, None, patches)[0]
    return _fit_patches(grey, coarse.grid_px, most_samples, parameters, patches)[0]


def _fit_patches(
    grey: NDArray[np.uint8],
    grid_px: Array,
    most_samples: int,
    start: Array | None,
    patches: Patches | None,
    n_steps: int = _STEPS,
) -> tuple[Crossings, Array]:
    """Fit patches of at most most_samples per side; parameters (K, 8) serve finer patches as a start."""
    if patches is None:
        patches = Patches(np.gradient(grid_px, axis=1), np.gradient(grid_px, axis=0), REACH)
    e1, e2, clear = patches
    area = np.abs(e1[..., 0] * e2[..., 1] - e1[..., 1] * e2[..., 0])
    # Distance between opposite edges of a square, px: the length of one unit of a and of b.
    height_px = np.stack([area / np.linalg.norm(e2, axis=-1), area / np.linalg.norm(e1, axis=-1)], axis=-1)
    longest_px = float(np.median(np.maximum(np.linalg.norm(e1, axis=-1), np.linalg.norm(e2, axis=-1))))
    n = int(np.clip(2 * round(REACH * longest_px) + 1, 7, most_samples))
    # A strip along the edges has samples on either side.
    n = max(n, 2 * int(np.ceil(2 * REACH / clear)) + 1 if clear < REACH else n)
    axis = np.linspace(-REACH, REACH, n)
    b, a = (grid.ravel() for grid in np.meshgrid(axis, axis, indexing="ij"))
    is_clear = np.minimum(np.abs(a), np.abs(b)) <= clear + 1e-9
    a, b = a[is_clear], b[is_clear]
    pixels = grid_px[..., None, :] + a[:, None] * e1[..., None, :] + b[:, None] * e2[..., None, :]
    # Widely spaced samples would let a sharp edge jump between them, leaving the corner undetermined.
    step_px = 2 * REACH * longest_px / (n - 1)
    blur_px = 0.4 * step_px if step_px > _FAR_APART_PX else 0.0
    values = _sample_smooth(grey, pixels, blur_px).reshape(-1, len(a))

    flat_height = height_px.reshape(-1, 2)
    parameters, residuals = _fit(
        values, a, b, flat_height, start, n_steps, float(np.hypot(_MIN_SIGMA_PX, blur_px))
    )
    shift = parameters[:, :2].reshape(grid_px.shape)
    blurred_px = np.exp(parameters[:, 6:8]) * flat_height
    sigma_px = np.sqrt(np.maximum(blurred_px**2 - blur_px**2, _MIN_SIGMA_PX**2))
    parameters[:, 6:8] = np.log(sigma_px / flat_height)
    noise = np.sqrt(np.mean(residuals**2, axis=1))
    contrast = 2.0 * parameters[:, 5]
    is_fitted = (np.abs(parameters[:, :2]).max(axis=1) < 0.35) & (np.abs(contrast) > 2.0 * noise)
    is_fitted &= np.abs(parameters[:, 2:4]).max(axis=1) < 0.7
    is_fitted = is_fitted.reshape(grid_px.shape[:2])
    moved = grid_px + shift[..., :1] * e1 + shift[..., 1:] * e2
    crossings = Crossings(
        grid_px=np.where(is_fitted[..., None], moved, grid_px),
        is_fitted=is_fitted,
        contrast=contrast.reshape(is_fitted.shape),
        edge_sigma_px=sigma_px.reshape(grid_px.shape),
        misfit=noise.reshape(is_fitted.shape),
    )
    return crossings, parameters


def sample(grey: NDArray[np.uint8] | NDArray[np.float32], pixels: Array) -> Array:
    """Interpolate grey values bilinearly at (..., 2) px; outside the image the border value is used."""
    # cv2.remap takes at most 32766 rows and columns.
    maps = np.asarray(pixels, dtype=np.float32).reshape(-1, pixels.shape[-2], 2)
    values = cv2.remap(grey, maps[..., 0], maps[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(values, dtype=np.float64).reshape(pixels.shape[:-1])


def _sample_smooth(grey: NDArray[np.uint8], pixels: Array, blur_px: float) -> Array:
    """Sample the image after Gaussian blur; only the part around the pixels is blurred."""
    if not blur_px:
        return sample(grey, pixels)
    reach = np.ceil(4 * blur_px) + 1
    axes = tuple(range(pixels.ndim - 1))
    low = np.maximum(np.floor(pixels.min(axis=axes) - reach), 0).astype(int)
    high = np.maximum(np.ceil(pixels.max(axis=axes) + reach).astype(int), low + 1)
    part = grey[low[1] : high[1], low[0] : high[0]]
    if not part.size:
        return sample(grey, pixels)
    smooth = np.asarray(
        cv2.GaussianBlur(part.astype(np.float32), (0, 0), blur_px, borderType=cv2.BORDER_REPLICATE),
        dtype=np.float32,
    )
    return sample(smooth, pixels - low)


def _fit(
    values: Array,
    a: Array,
    b: Array,
    height_px: Array,
    start: Array | None,
    n_steps: int,
    least_sigma_px: float,
) -> tuple[Array, Array]:
    """Fit all patches (K, n): parameters (K, 8) a0 b0 alpha beta m c log(s1) log(s2), residuals (K, n).

    `start` holds parameters of an earlier fit, after which the patches were centred on their corners.
    """
    # Without a start the corners are assumed at the centres of their patches.
    mean = values.mean(axis=1)
    p, lowest = np.zeros((len(values), 8)), np.log(least_sigma_px / height_px)
    p[:, 4], p[:, 5] = mean, ((values - mean[:, None]) * np.sign(a * b)).mean(axis=1)
    p[:, 6:8] = np.log(np.clip(0.8 / height_px, 1e-3, 0.3))
    if start is not None:
        p[:, 2:] = start[:, 2:]
        p[:, 6:8] = np.clip(p[:, 6:8], lowest, 0.0)
    damping = np.full(len(p), 1e-2 if start is None else 1e-4)
    residuals, J = _model(p, values, a, b)
    cost = np.sum(residuals**2, axis=1)
    k = np.arange(len(p))  # Fits that are not done.
    for _ in range(n_steps):
        J_k = J if len(k) == len(p) else J[k]
        # Keep blurs at their bounds if a step would exceed these: the others then converge in few steps.
        gradient = (J_k @ residuals[k, :, None])[..., 0]
        is_held = np.zeros((len(k), 8), dtype=bool)
        is_held[:, 6:8] = ((p[k, 6:8] <= lowest[k]) & (gradient[:, 6:8] > 0)) | (
            (p[k, 6:8] >= 0.0) & (gradient[:, 6:8] < 0)
        )
        H = J_k @ np.swapaxes(J_k, 1, 2)
        H[is_held[:, :, None] | is_held[:, None, :]] = 0.0
        gradient[is_held] = 0.0
        diagonal = np.einsum("kii->ki", H)
        damped = (
            H
            + np.eye(8)
            * (damping[k, None] * diagonal + 1e-9 * diagonal.max(axis=1, keepdims=True) + 1e-12)[:, None, :]
        )
        damped += np.eye(8) * is_held[:, None, :]
        step = -np.linalg.solve(damped, gradient[..., None])[..., 0]
        candidate = p[k] + step
        candidate[:, :4] = np.clip(candidate[:, :4], -1.0, 1.0)
        candidate[:, 6:8] = np.clip(candidate[:, 6:8], lowest[k], 0.0)
        new_residuals, new_J = _model(candidate, values[k], a, b)
        new_cost = np.sum(new_residuals**2, axis=1)
        is_better = new_cost < cost[k]
        is_settled = np.abs(cost[k] - new_cost) <= _SETTLED * cost[k]
        better = k[is_better]
        p[better], cost[better] = candidate[is_better], new_cost[is_better]
        residuals[better], J[better] = new_residuals[is_better], new_J[is_better]
        damping[k] = np.where(is_better, damping[k] * 0.2, damping[k] * 5.0)
        k = k[~is_settled]
        if not len(k):
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
