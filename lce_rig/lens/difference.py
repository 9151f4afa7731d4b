"""Pixel difference of two lens models after the rotation of the camera that minimises it.

A shift of the principal point is nearly a small rotation of the camera. Two sets of intrinsics may therefore
differ in their values and still project alike. The relevant figures are the pixel displacement after the best
rotation, and that rotation.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from lce_rig.core.camera import Intrinsics
from lce_rig.core.geometry import Array, exp_so3, log_so3, project_to_so3, skew
from lce_rig.lens.models import LensModel, model_of

_GRID = 40
_STEPS = 10
# Fewer pixels covered by both models do not determine a rotation.
_LEAST_ALIGNED = 10


class LensDifference(NamedTuple):
    """Pixel distance between two lens models for the same rays, at board positions.

    Attributes:
        rms_px: rms distance; infinite if the first model projects none of the pixels.
        sigma_px: root of the mean variance of the displacement.
        turn_rad: (3,) rotation vector from the first camera's rays to the second's.
        cov_turn: (3, 3) covariance of `turn_rad`, rad^2.
    """

    rms_px: float
    sigma_px: float
    turn_rad: Array
    cov_turn: Array


@dataclass(frozen=True, eq=False)
class LensCertainty:
    """Standard deviation per pixel of a lens model, after the rotation that minimises it.

    Attributes:
        sigma_px: (N,) at N pixels of a grid, root of the summed variances of both coordinates; NaN for pixels
            without a ray.
        is_covered: (N,) whether boards were seen there.
    """

    sigma_px: Array
    is_covered: NDArray[np.bool_]

    @property
    def covered(self) -> float:
        """Fraction of the image in which boards were detected."""
        return float(self.is_covered.mean())

    @property
    def image_sigma_px(self) -> float:
        """Standard deviation that 98 % of the image's pixels do not exceed; infinite if they have no ray."""
        sigma_px = np.where(np.isnan(self.sigma_px), np.inf, self.sigma_px)
        return float(np.percentile(sigma_px, 98.0, method="higher"))


def compare_lenses(
    first: Intrinsics, second: Intrinsics, corners_px: Array, cov: Array, model: LensModel
) -> LensDifference:
    """Measure the pixel displacement between two intrinsics after the best rotation between their rays.

    The rotation minimises sum |project_2(R ray_1(u)) - u|^2 over the pixels u in the corners' convex hull.

    Args:
        first, second: intrinsics for images of the same size.
        corners_px: (n, 2) detected board corners.
        cov: (P, P) covariance of the second's parameters.
        model: lens model of the second, with these parameters.

    References:
        D. Kogan, mrcal: projection difference and implied transformation.
    """
    pixels = _grid(first).reshape(-1, 2)
    pixels = pixels[_inside_hull(pixels, corners_px)]
    rays, backward = first.unproject(pixels), second.unproject(pixels)
    aligned = np.isfinite(rays).all(axis=1) & np.isfinite(backward).all(axis=1)
    if np.count_nonzero(aligned) < _LEAST_ALIGNED:
        return LensDifference(np.inf, 0.0, np.zeros(3), np.zeros((3, 3)))
    vector = model.vector(second)
    R = project_to_so3(backward[aligned].T @ rays[aligned])
    for _ in range(_STEPS):
        predicted, J, _ = _by_turn(model, vector, rays[aligned] @ R.T)
        phi = -np.linalg.lstsq(J, (predicted - pixels[aligned]).ravel(), rcond=None)[0]
        R = exp_so3(np.asarray(phi)) @ R
    squares = np.sum((second.project(rays @ R.T)[0] - pixels) ** 2, axis=1)
    rms_px = float(np.sqrt(np.nanmean(squares))) if np.isfinite(squares).any() else np.inf
    turn, left = _best_turn(model, vector, rays[aligned] @ R.T)
    variances = np.einsum("ni,ij,nj->n", left, cov, left)
    sigma_px = float(np.sqrt(2 * np.mean(variances)))
    return LensDifference(rms_px, sigma_px, log_so3(R), turn @ cov @ turn.T)


def profile_errors(fitted: Intrinsics, corners_px: Array, cov: Array, model: LensModel) -> Array:
    """Convert the covariance of intrinsics to the four errors that a profile states.

    As the parameters are correlated, the four errors are fitted to the pixel displacements at the corners.

    Args:
        fitted: the intrinsics.
        corners_px: (n, 2) detected board corners.
        cov: (P, P) covariance of the parameters of the intrinsics.
        model: the lens model with these parameters.

    Returns:
        Covariance (4, 4) of the relative error of the focal length, of the principal point's x and y, px, and
        of the outward displacement of the image's corner by the cubic distortion term, px.
    """
    vector, rays = model.vector(fitted), fitted.unproject(corners_px)
    _, _, by_lens = model.project(vector, rays[np.isfinite(rays).all(axis=1)])
    by_lens = by_lens.reshape(-1, model.size)
    radius = np.hypot(fitted.width_px, fitted.height_px) / 2 / fitted.fx_px
    to_lens = np.zeros((model.size, 4))
    to_lens[:2, 0], to_lens[[2, 3], [1, 2]] = vector[:2], 1.0
    to_lens[4, 3] = 1 / (fitted.fx_px * radius**3)
    to_errors = np.linalg.pinv(by_lens @ to_lens) @ by_lens
    return np.asarray(to_errors @ cov @ to_errors.T)


def turn_of_lens(intrinsics: Intrinsics) -> Array:
    """Find the camera rotation (3, P) with the same effect on pixels as a change of each lens parameter."""
    model, rays = model_of(intrinsics), intrinsics.unproject(_grid(intrinsics).reshape(-1, 2))
    turn, _ = _best_turn(model, model.vector(intrinsics), rays[np.isfinite(rays).all(axis=1)])
    return -turn


def certainty_of(intrinsics: Intrinsics, corners_px: Array, cov: Array, model: LensModel) -> LensCertainty:
    """Propagate the covariance of intrinsics to the image's pixels.

    Args:
        intrinsics: the lens.
        corners_px: (n, 2) where boards were seen; the rotation minimises the deviation there.
        cov: (P, P) covariance of its parameters.
        model: lens model with these parameters.
    """
    pixels = _grid(intrinsics).reshape(-1, 2)
    rays = intrinsics.unproject(pixels)
    is_covered, is_drawn = _inside_hull(pixels, corners_px), np.isfinite(rays).all(axis=1)
    vector = model.vector(intrinsics)
    turn, _ = _best_turn(model, vector, rays[is_covered & is_drawn])
    _, J, A = _by_turn(model, vector, rays[is_drawn])
    left = (A + J @ turn).reshape(-1, 2, model.size)
    sigma_px = np.full(len(pixels), np.nan)
    sigma_px[is_drawn] = np.sqrt(np.einsum("nai,ij,naj->n", left, cov, left))
    return LensCertainty(sigma_px, is_covered)


def _by_turn(model: LensModel, vector: Array, rays: Array) -> tuple[Array, Array, Array]:
    """Project rays (n, 3); derivatives (2 n, 3) by a rotation of them and (2 n, P) by the parameters."""
    pixels, by_point, by_lens = model.project(vector, rays)
    return pixels, (-by_point @ skew(rays)).reshape(-1, 3), by_lens.reshape(-1, model.size)


def _best_turn(model: LensModel, vector: Array, rays: Array) -> tuple[Array, Array]:
    """Find the rotation (3, P) that best compensates each parameter's change, and the remainder (2 n, P)."""
    _, J, A = _by_turn(model, vector, rays)
    turn = np.asarray(-np.linalg.lstsq(J, A, rcond=None)[0])
    return turn, np.asarray(A + J @ turn)


def _grid(intrinsics: Intrinsics) -> Array:
    """Return a grid of points (H, W, 2) over the image, `_GRID` along its longer side."""
    width, height = intrinsics.width_px, intrinsics.height_px
    step = max(width, height) / _GRID
    u, v = (np.arange(step / 2, length, step) - 0.5 for length in (width, height))
    return np.stack(np.meshgrid(u, v), axis=-1)


def _inside_hull(pixels: Array, corners_px: Array) -> NDArray[np.bool_]:
    from scipy.spatial import Delaunay

    return np.asarray(Delaunay(corners_px).find_simplex(pixels) >= 0)
