"""Camera models: project points, and unproject pixels, with the models' range of validity."""

from dataclasses import dataclass
from functools import cached_property
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from lce_rig.core.geometry import Array

CUT_FRACTION = 0.02
"""Share of an image's rows or columns that a readout may cut off at its end; more is another mode."""

_FAMILIES: dict[str, Literal["radtan", "equidistant"]] = {
    **dict.fromkeys(("", "none", "plumb_bob", "radtan", "rational_polynomial"), "radtan"),
    **dict.fromkeys(("equidistant", "equi", "fisheye"), "equidistant"),
}
# Lengths of OpenCV's radial-tangential vector beyond plumb_bob: rational, thin prism, tilted sensor.
_LONG_RADTAN = (8, 12, 14)


@dataclass(frozen=True)
class Intrinsics:
    """A pinhole camera with distortion; pixel centres at integers.

    Attributes:
        fx_px, fy_px, cx_px, cy_px: the camera matrix.
        width_px, height_px: resolution of the images.
        model: "radtan" (k1 k2 p1 p2 [k3 [k4 k5 k6]], as OpenCV's plumb bob and rational models) or
            "equidistant" (k1..k4, as OpenCV's fisheye and Kalibr's equi).
        distortion: the coefficients, in the order above.
    """

    fx_px: float
    fy_px: float
    cx_px: float
    cy_px: float
    width_px: int
    height_px: int
    model: Literal["radtan", "equidistant"] = "radtan"
    distortion: tuple[float, ...] = ()

    @classmethod
    def from_ros(
        cls, model: str, K: Array, distortion: tuple[float, ...], size_px: tuple[int, int]
    ) -> "Intrinsics":
        """Build intrinsics from the fields of sensor_msgs/CameraInfo.

        Args:
            model: plumb_bob, rational_polynomial, equidistant, or Kalibr's and OpenCV's names of these; ""
                without distortion.
            K: (3, 3) or (9,).
            distortion: its coefficients; zeros at the end that the model lacks are dropped.
            size_px: (width, height).

        Raises:
            ValueError: a model that cannot be used, another number of coefficients, or no camera matrix.
        """
        family = _FAMILIES.get(model.lower())
        coefficients = _shorten(model.lower(), tuple(float(value) for value in distortion))
        if family is None or coefficients is None:
            known = "plumb_bob (4, 5), rational_polynomial (8), equidistant (4); any more must be zero"
            raise ValueError(
                f"{model!r} with {len(distortion)} coefficients cannot be used: models are {known}"
            )
        fx, _, cx, _, fy, cy, *_ = (float(value) for value in np.asarray(K, dtype=np.float64).ravel())
        if not (np.isfinite([fx, fy, cx, cy, *distortion]).all() and fx > 0 and fy > 0):
            what = "K is not a camera matrix" if np.any(K) else "uncalibrated, K is all zero"
            raise ValueError(f"{what} (fx {fx:g}, fy {fy:g})")
        return cls(fx, fy, cx, cy, *size_px, model=family, distortion=coefficients)

    @cached_property
    def matrix(self) -> Array:
        """The camera matrix K (3, 3)."""
        return np.array([[self.fx_px, 0, self.cx_px], [0, self.fy_px, self.cy_px], [0, 0, 1]])

    @cached_property
    def max_radius(self) -> float:
        """Largest r = tan(angle) (radtan) or angle in rad (equidistant) up to which distortion is monotonic.

        Beyond it the polynomial folds back: points outside the field of view project into the image.
        """
        limit, n = (10.0, 20001) if self.model == "radtan" else (np.pi, 6284)
        r = np.linspace(0.0, limit, n)
        growth = np.diff(self._distorted_radius(r))
        falling = np.flatnonzero(growth <= 0)
        return float(r[falling[0]]) if len(falling) else float(limit)

    def _coefficients(self, n: int) -> tuple[float, ...]:
        return (*self.distortion, *(0.0,) * (n - len(self.distortion)))

    def _distorted_radius(self, r: Array) -> Array:
        if self.model == "equidistant":
            k = self._coefficients(4)
            s = r * r
            return np.asarray(r * (1 + s * (k[0] + s * (k[1] + s * (k[2] + s * k[3])))))
        return np.asarray(r * self._radial_scale(r * r))

    def _radius_slope(self, angle: Array) -> Array:
        """Differentiate the distorted radius by the angle (equidistant only)."""
        k, s = np.multiply(self._coefficients(4), [3, 5, 7, 9]), angle * angle
        return np.asarray(1 + s * (k[0] + s * (k[1] + s * (k[2] + s * k[3]))))

    def _radial_scale(self, s: Array) -> Array:
        k1, k2, _, _, k3, k4, k5, k6 = self._coefficients(8)
        scale = (1 + s * (k1 + s * (k2 + s * k3))) / (1 + s * (k4 + s * (k5 + s * k6)))
        return np.asarray(scale)

    def _distort(self, xy: Array) -> Array:
        """Distort normalised coordinates x/z, y/z (radtan only)."""
        _, _, p1, p2, *_ = self._coefficients(8)
        x, y = xy[..., 0], xy[..., 1]
        s = x * x + y * y
        scale = self._radial_scale(s)
        distorted = np.empty((*x.shape, 2))
        distorted[..., 0] = x * scale + 2 * p1 * x * y + p2 * (s + 2 * x * x)
        distorted[..., 1] = y * scale + p1 * (s + 2 * y * y) + 2 * p2 * x * y
        return distorted

    def _distortion_slope(self, x: Array, y: Array) -> tuple[Array, Array, Array]:
        """Differentiate `_distort`: d x' / dx, d x' / dy = d y' / dx, d y' / dy."""
        k1, k2, p1, p2, k3, k4, k5, k6 = self._coefficients(8)
        s = x * x + y * y
        above, below = 1 + s * (k1 + s * (k2 + s * k3)), 1 + s * (k4 + s * (k5 + s * k6))
        scale = above / below
        growth = 2 * (k1 + s * (2 * k2 + 3 * s * k3) - scale * (k4 + s * (2 * k5 + 3 * s * k6))) / below
        return (
            scale + growth * x * x + 2 * p1 * y + 6 * p2 * x,
            growth * x * y + 2 * p1 * x + 2 * p2 * y,
            scale + growth * y * y + 6 * p1 * y + 2 * p2 * x,
        )

    def project(self, points_camera: NDArray[Any]) -> tuple[Array, NDArray[np.bool_]]:
        """Project points into the image.

        Args:
            points_camera: (..., 3) m, frame camera optical (x right, y down, z forward).

        Returns:
            Pixels (..., 2), NaN if invalid, and validity (...,): in front of the camera and within the
            radius up to which the distortion is monotonic. A valid pixel may lie outside the image.
        """
        points = np.asarray(points_camera, dtype=np.float64)
        z = points[..., 2]
        rho = np.hypot(points[..., 0], points[..., 1])
        if self.model == "equidistant":
            angle = np.arctan2(rho, z)
            is_valid = (angle < self.max_radius) & np.isfinite(rho)
            distorted = self._bend(points, rho, angle)
        else:
            is_valid = (z > 1e-6) & (rho < self.max_radius * z)
            distorted = self.distort(points)
        pixels = distorted * [self.fx_px, self.fy_px] + [self.cx_px, self.cy_px]
        pixels[~is_valid] = np.nan
        return pixels, is_valid

    def distort(self, points_camera: Array) -> Array:
        """Project points (..., 3) in units of the focal lengths: (..., 2), also where `project` gives NaN."""
        lateral, z = points_camera[..., :2], points_camera[..., 2]
        if self.model == "radtan":
            with np.errstate(all="ignore"):
                return self._distort(lateral / z[..., None])
        rho = np.hypot(lateral[..., 0], lateral[..., 1])
        return self._bend(points_camera, rho, np.arctan2(rho, z))

    def _bend(self, points: Array, rho: Array, angle: Array) -> Array:
        """Distort points (..., 3) by their distance from the axis and their angle (equidistant only)."""
        with np.errstate(all="ignore"):
            scale = np.where(rho > 1e-12, self._distorted_radius(angle) / rho, 1.0 / points[..., 2])
        return np.asarray(points[..., :2] * scale[..., None])

    def differentiate(self, points_camera: Array) -> Array:
        """Differentiate `project` by the point.

        Args:
            points_camera: (..., 3) m, frame camera optical, where `project` is valid.

        Returns:
            (..., 2, 3) px per m; without meaning where `project` is not valid.
        """
        points = np.asarray(points_camera, dtype=np.float64)
        x, y, z = points[..., 0], points[..., 1], points[..., 2]
        slope = np.empty((*x.shape, 2, 3))
        with np.errstate(divide="ignore", invalid="ignore"):
            if self.model == "equidistant":
                rho = np.maximum(np.hypot(x, y), 1e-12)
                angle, square = np.arctan2(rho, z), rho**2 + z**2
                across, growth = self._distorted_radius(angle) / rho, self._radius_slope(angle) / square
                ex, ey = x / rho, y / rho
                along = growth * z - across
                slope[..., 0, 0], slope[..., 1, 1] = across + along * ex * ex, across + along * ey * ey
                slope[..., 0, 1] = slope[..., 1, 0] = along * ex * ey
                slope[..., 0, 2], slope[..., 1, 2] = -growth * x, -growth * y
            else:
                a, b = x / z, y / z
                by_x, by_xy, by_y = self._distortion_slope(a, b)
                slope[..., 0, 0], slope[..., 1, 1] = by_x / z, by_y / z
                slope[..., 0, 1] = slope[..., 1, 0] = by_xy / z
                slope[..., 0, 2], slope[..., 1, 2] = -(by_x * a + by_xy * b) / z, -(by_xy * a + by_y * b) / z
        return np.asarray(slope * np.array([self.fx_px, self.fy_px])[:, None])

    def unproject(self, pixels: NDArray[Any]) -> Array:
        """Return the unit ray through each pixel, by Newton's method.

        Args:
            pixels: (..., 2).

        Returns:
            (..., 3) unit vectors, frame camera optical; NaN if no ray within the valid radius fits.
        """
        xy = (np.asarray(pixels, dtype=np.float64) - [self.cx_px, self.cy_px]) / [self.fx_px, self.fy_px]
        return self._unproject_equidistant(xy) if self.model == "equidistant" else self._unproject_radtan(xy)

    def _unproject_equidistant(self, xy: Array) -> Array:
        radius = np.linalg.norm(xy, axis=-1)
        angle = np.minimum(radius, 0.9 * self.max_radius)
        for _ in range(20):
            slope = self._radius_slope(angle)
            step = (self._distorted_radius(angle) - radius) / np.where(np.abs(slope) > 1e-3, slope, 1e-3)
            angle = np.clip(angle - step, 0.0, self.max_radius)
        angle = np.where(np.abs(self._distorted_radius(angle) - radius) < 1e-8, angle, np.nan)
        direction = xy / np.where(radius > 1e-12, radius, 1.0)[..., None]
        return np.concatenate([direction * np.sin(angle)[..., None], np.cos(angle)[..., None]], axis=-1)

    def _unproject_radtan(self, xy: Array) -> Array:
        guess = xy.copy()
        for _ in range(20):
            error = self._distort(guess) - xy
            if np.all(np.abs(error) < 1e-13):
                break
            by_x, by_xy, by_y = self._distortion_slope(guess[..., 0], guess[..., 1])
            det = by_x * by_y - by_xy * by_xy
            det = np.where(np.abs(det) > 1e-3, det, 1e-3)
            dx = (by_y * error[..., 0] - by_xy * error[..., 1]) / det
            dy = (by_x * error[..., 1] - by_xy * error[..., 0]) / det
            guess = guess - np.clip(np.stack([dx, dy], axis=-1), -0.5, 0.5)
        miss = np.linalg.norm(self._distort(guess) - xy, axis=-1)
        is_bad = (miss > 1e-8) | (np.linalg.norm(guess, axis=-1) >= self.max_radius)
        guess = np.where(is_bad[..., None], np.nan, guess)
        rays = np.concatenate([guess, np.ones((*guess.shape[:-1], 1))], axis=-1)
        return np.asarray(rays / np.linalg.norm(rays, axis=-1, keepdims=True))

    def is_inside(self, pixels: Array, margin_px: float = 0.0) -> NDArray[np.bool_]:
        """Find which pixels lie in the image, at least `margin_px` from its border; NaN never does."""
        u, v = pixels[..., 0], pixels[..., 1]
        inside = (u >= margin_px) & (u <= self.width_px - 1 - margin_px)
        inside &= (v >= margin_px) & (v <= self.height_px - 1 - margin_px)
        return np.asarray(inside)


def _shorten(model: str, distortion: tuple[float, ...]) -> tuple[float, ...] | None:
    """Drop trailing zeros of the coefficients; None if no supported model has that many."""
    n, n_used = len(distortion), len(np.trim_zeros(np.array(distortion), "b"))
    if model in ("", "none"):
        return () if n_used == 0 else None
    if _FAMILIES.get(model) == "equidistant":
        return distortion[:4] if n_used <= 4 <= n else None
    if n in (0, 4, 5):
        return distortion
    if n_used <= 5 < n:
        return distortion[:5]
    return distortion[:8] if n_used <= 8 and n in _LONG_RADTAN else None
