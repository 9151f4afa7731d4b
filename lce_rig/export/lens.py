"""Camera models with the coefficients that a format has room for."""

from dataclasses import dataclass, replace

import numpy as np

from lce_rig.core.camera import Intrinsics
from lce_rig.core.geometry import Array
from lce_rig.export.findings import LENS_FITTED
from lce_rig.export.job import ExportJob

# Points of the grid over the image to which another model is fitted.
_GRID = 24
# A pixel that a trial model cannot draw counts as this far off.
_UNDRAWN_PX = 100.0
# Above this the error is visible in matching and colouring.
_COARSE_PX = 0.5


@dataclass(frozen=True)
class FittedLens:
    """A camera model that stands for another one.

    Attributes:
        intrinsics: the model.
        rms_px, max_px: its distance from the other over the image; 0 if it is the same.
    """

    intrinsics: Intrinsics
    rms_px: float = 0.0
    max_px: float = 0.0


def fit_coefficients(intrinsics: Intrinsics, n_coefficients: int) -> FittedLens:
    """Find the model with four or five radtan coefficients that draws the whole image as another does.

    Minimises the sum over a grid of pixels of |project(ray) - pixel|^2 over camera matrix and coefficients.

    Args:
        intrinsics: any model; one that needs no more coefficients is returned as it is, filled with zeros.
        n_coefficients: 4 (k1 k2 p1 p2) or 5 (and k3).
    """
    coefficients = intrinsics.distortion
    if intrinsics.model == "equidistant":
        return FittedLens(intrinsics)
    if not any(coefficients[n_coefficients:]):
        filled = (*coefficients, *(0.0,) * n_coefficients)[:n_coefficients]
        return FittedLens(replace(intrinsics, distortion=filled))
    from scipy.optimize import least_squares

    u = np.linspace(0.0, intrinsics.width_px - 1.0, _GRID)
    v = np.linspace(0.0, intrinsics.height_px - 1.0, _GRID)
    pixels = np.stack(np.meshgrid(u, v), axis=-1).reshape(-1, 2)
    rays = intrinsics.unproject(pixels)
    is_seen = np.isfinite(rays).all(axis=1)
    pixels, rays = pixels[is_seen], rays[is_seen]

    def off(x: Array) -> Array:
        drawn, _ = _model(intrinsics, x).project(rays)
        return np.nan_to_num(drawn - pixels, nan=_UNDRAWN_PX).ravel()

    start = np.array(
        [intrinsics.fx_px, intrinsics.fy_px, intrinsics.cx_px, intrinsics.cy_px, *(0.0,) * n_coefficients]
    )
    scale = np.array([intrinsics.fx_px] * 4 + [0.1, 0.1, 0.01, 0.01, 0.1][:n_coefficients])
    x = least_squares(off, start, x_scale=scale, method="trf", xtol=1e-14, ftol=1e-14, gtol=1e-14).x
    miss_px = np.linalg.norm(off(x).reshape(-1, 2), axis=1)
    return FittedLens(_model(intrinsics, x), float(np.sqrt(np.mean(miss_px**2))), float(miss_px.max()))


def _model(intrinsics: Intrinsics, x: Array) -> Intrinsics:
    fx, fy, cx, cy, *distortion = (float(value) for value in x)
    return replace(intrinsics, fx_px=fx, fy_px=fy, cx_px=cx, cy_px=cy, distortion=tuple(distortion))


def lens_for(job: ExportJob, name: str, camera: str, n_coefficients: int) -> FittedLens:
    """Give a camera's model with the coefficients of a format, and say so where it had to be fitted.

    Args:
        job: which notes it.
        name: the format.
        camera: its name.
        n_coefficients: of radtan that the format has room for.
    """
    lens = fit_coefficients(job.rig.cameras[camera].to_intrinsics(), n_coefficients)
    if lens.max_px:
        fitted = LENS_FITTED(
            camera,
            severity="note" if lens.max_px < _COARSE_PX else "warning",
            format=name,
            n_coefficients=n_coefficients,
            rms_px=lens.rms_px,
            max_px=lens.max_px,
        )
        job.findings.append(fitted)
    return lens


def lens_lines(lens: FittedLens) -> list[str]:
    """Say at the head of a file that its camera model is a fit; empty where it is not."""
    if not lens.max_px:
        return []
    return [
        f"camera model fitted to that of the profile, which has more coefficients: {lens.rms_px:.3g} px rms, "
        f"{lens.max_px:.3g} px at most over the image"
    ]
