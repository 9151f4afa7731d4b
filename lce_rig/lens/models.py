"""Lens models as vectors of parameters, with the derivatives for fitting."""

from dataclasses import dataclass
from typing import Literal

import numpy as np

from lce_rig.core.camera import Intrinsics
from lce_rig.core.geometry import Array
from lce_rig.rig import BoardSettings, CameraSettings

# Models are compared on the rays of a grid of this many points across the image.
_GRID = 24
_STEPS = 20
# Angle beyond the outermost ray, and the least growth of the radius over it, of a converted model: it then
# still projects rays farther out.
_RIM_RAD, _RISE_PX = 2e-3, 1e-3
_HOLDS = 1e4


@dataclass(frozen=True)
class LensModel:
    """A lens model: [fx, fy, cx, cy, distortion ...], in pixels, ordered as `Intrinsics.distortion`.

    Attributes:
        name: its name on the command line.
        family: corresponding model of `Intrinsics`.
        coefficients: names of the distortion coefficients.
        prior_sigma: standard deviation a priori of each coefficient about zero; inf if there is none. The
            rational model's numerator and denominator are interchangeable; the prior resolves this.
    """

    name: str
    family: Literal["radtan", "equidistant"]
    coefficients: tuple[str, ...]
    prior_sigma: tuple[float, ...]

    @property
    def parameters(self) -> tuple[str, ...]:
        """Names of the parameters with their unit, in order."""
        return ("fx_px", "fy_px", "cx_px", "cy_px", *self.coefficients)

    @property
    def size(self) -> int:
        """Number of parameters."""
        return 4 + len(self.coefficients)

    def vector(self, intrinsics: Intrinsics) -> Array:
        """List the parameters (P,) of intrinsics of this family; coefficients they lack are zero.

        Raises:
            ValueError: the intrinsics have more coefficients, or are of the other family.
        """
        given = intrinsics.distortion
        if intrinsics.model != self.family or len(given) > len(self.coefficients):
            raise ValueError(f"{intrinsics.model} with {len(given)} coefficients is not {self.name}")
        padded = (*given, *(0.0,) * (len(self.coefficients) - len(given)))
        return np.array([intrinsics.fx_px, intrinsics.fy_px, intrinsics.cx_px, intrinsics.cy_px, *padded])

    def intrinsics(self, vector: Array, width_px: int, height_px: int) -> Intrinsics:
        """Build intrinsics from parameters (P,)."""
        fx, fy, cx, cy, *distortion = (float(value) for value in vector)
        return Intrinsics(fx, fy, cx, cy, width_px, height_px, self.family, tuple(distortion))

    def project(self, vector: Array, points_camera: Array) -> tuple[Array, Array, Array]:
        """Project points and differentiate the pixels.

        Args:
            vector: (P,) parameters.
            points_camera: (..., 3) m in front of the camera; validity is not checked.

        Returns:
            Pixels (..., 2), their derivative by the point (..., 2, 3) and by the parameters (..., 2, P).
        """
        lens, focal = self.intrinsics(vector, 0, 0), vector[:2]
        xy = lens.distort(points_camera)
        by_parameter = np.zeros((*xy.shape, self.size))
        by_parameter[..., 0, 0], by_parameter[..., 1, 1] = xy[..., 0], xy[..., 1]
        by_parameter[..., 0, 2] = by_parameter[..., 1, 3] = 1.0
        by_coefficient = _by_equidistant if self.family == "equidistant" else _by_radtan
        by_parameter[..., 4:] = focal[:, None] * by_coefficient(vector[4:], points_camera)
        return xy * focal + vector[2:4], lens.differentiate(points_camera), by_parameter

    def project_points(self, vector: Array, points_camera: Array) -> tuple[Array, Array]:
        """Project points and differentiate the pixels by the points alone, as `project`."""
        lens = self.intrinsics(vector, 0, 0)
        return lens.distort(points_camera) * vector[:2] + vector[2:4], lens.differentiate(points_camera)


_NO_PRIOR = float("inf")
MODELS = {
    model.name: model
    for model in (
        LensModel("radtan4", "radtan", ("k1", "k2", "p1", "p2"), (_NO_PRIOR,) * 4),
        LensModel("radtan5", "radtan", ("k1", "k2", "p1", "p2", "k3"), (_NO_PRIOR,) * 5),
        LensModel(
            "rational",
            "radtan",
            ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"),
            (_NO_PRIOR,) * 4 + (0.3,) * 4,  # k3 to k6; wider ones leave the polynomials' ratio undetermined
        ),
        LensModel("equidistant", "equidistant", ("k1", "k2", "k3", "k4"), (_NO_PRIOR,) * 4),
    )
}


def model_of(intrinsics: Intrinsics) -> LensModel:
    """Choose the smallest model that represents these intrinsics; without distortion, radtan4."""
    if intrinsics.model == "equidistant":
        return MODELS["equidistant"]
    n = len(intrinsics.distortion)
    return MODELS["radtan4" if n <= 4 else "radtan5" if n == 5 else "rational"]


def convert(intrinsics: Intrinsics, model: LensModel) -> Array:
    """Find the parameters (P,) of another model with nearly the same projection.

    Exact where the new model contains the old one; else least squares over a grid of pixels, within the field
    of view where the old model is valid. There the new one must not fold back: a free fit can do so next to
    the outermost ray, which the model then cannot project.
    """
    if intrinsics.model == model.family and len(intrinsics.distortion) <= len(model.coefficients):
        return model.vector(intrinsics)
    pixels, rays = grid_rays(intrinsics)
    vector = np.concatenate(
        [
            [intrinsics.fx_px, intrinsics.fy_px, intrinsics.cx_px, intrinsics.cy_px],
            np.zeros(model.size - 4),
        ]
    )
    ridge = np.concatenate([np.zeros(4), np.ones(model.size - 4)])
    # Half the difference of opposite sides cancels decentring, which does not make a lens fold.
    angle = np.arccos(rays[:, 2].min())
    rim = [[side * np.sin(a), 0.0, np.cos(a)] for side in (1, -1) for a in (angle + _RIM_RAD, angle)]
    half = np.array([0.5, -0.5, -0.5, 0.5])
    for _ in range(_STEPS):
        predicted, _, J = model.project(vector, rays)
        J = J.reshape(-1, model.size)
        H = J.T @ J + np.diag(ridge)
        g = J.T @ (predicted - pixels).ravel() + ridge * vector
        at_rim, _, J = model.project(vector, np.array(rim))
        lack_px, slope = half @ at_rim[:, 0] - _RISE_PX, half @ J[:, 0]
        if lack_px < 0:
            H += _HOLDS**2 * np.outer(slope, slope)
            g += _HOLDS**2 * slope * lack_px
        vector = vector - np.linalg.solve(H, g)
    return vector


# Default standard deviations of a profile's intrinsics, in focal lengths; the last is of a pixel in the
# image's corner. Chosen for the best repeatability on some rigs' recordings, they are best on others, too.
_FOCAL, _PRINCIPAL_POINT, _DISTORTION = 2.5e-3, 4e-3, 2.5e-3
# Standard deviation of the ratio of both focal lengths.
_ASPECT = 5e-4
# Ratio of the rms over the image to the value in its corner, of a cubic displacement.
_OF_CORNER = 0.4
# Share of the whole distortion by which decentring displaces a pixel in the corner. Boards hardly separate it
# from a shift of the principal point; its coefficients p1, p2 are the tangential ones of the radtan models.
_DECENTRING = 0.4
# Standard deviations of intrinsics stated as exact.
_EXACT, _EXACT_PX = 1e-7, 1e-4


@dataclass(frozen=True)
class LensPrior:
    """A profile's intrinsics and their standard deviations.

    Attributes:
        lens: the intrinsics.
        focal_length: standard deviation of both focal lengths alike, relative.
        principal_point_px: standard deviation of each coordinate.
        distortion_px: standard deviation of a pixel's displacement in the image's corner.
        is_board_exact: whether the board has its nominal shape.
    """

    lens: Intrinsics
    focal_length: float
    principal_point_px: float
    distortion_px: float
    is_board_exact: bool = False

    @classmethod
    def read(cls, camera: CameraSettings, board: BoardSettings) -> "LensPrior":
        """Read a profile's camera and board; defaults replace missing values."""
        stated, focal_px = camera.intrinsics, camera.intrinsics.fx_px

        def sigma_px(value: float | None, usual: float) -> float:
            return usual * focal_px if value is None else value

        return cls(
            lens=camera.to_intrinsics(),
            focal_length=sigma_px(stated.focal_sigma_px, _FOCAL) / focal_px,
            principal_point_px=sigma_px(stated.principal_point_sigma_px, _PRINCIPAL_POINT),
            distortion_px=sigma_px(stated.distortion_sigma_px, _DISTORTION),
            is_board_exact=board.bow_sigma_m == 0,
        )

    @property
    def is_exact(self) -> bool:
        """Whether the profile states lens and board as exact."""
        return self.is_board_exact and not any(
            (self.focal_length, self.principal_point_px, self.distortion_px)
        )

    @property
    def decentring_px(self) -> float:
        """Standard deviation of the displacement of a pixel in the image's corner by p1 and by p2, each."""
        return _DECENTRING * self.distortion_px

    def of(self, model: LensModel) -> tuple[Array, Array]:
        """Return mean (P,) and information (P, P) of a model's parameters.

        Distortion of any shape has the same standard deviation over the image: with D the derivative of
        the n pixels of a grid by the coefficients, its information is D^T D / (n sigma^2). Decentring, which
        displaces by 3 p r^2 focal lengths at radius r, is smaller.
        """
        vector, focal_px = convert(self.lens, model), self.lens.fx_px
        rays = grid_rays(self.lens)[1]
        _, _, by_lens = model.project(vector, rays)
        D = by_lens[..., 4:].reshape(-1, model.size - 4)
        information = np.zeros((model.size, model.size))
        sigma_px = max(_OF_CORNER * self.distortion_px, _EXACT_PX)
        information[4:, 4:] = D.T @ D / (len(rays) * sigma_px**2)
        if model.family == "radtan":
            corner = (self.lens.width_px**2 + self.lens.height_px**2) / (2 * focal_px) ** 2
            sigma_px = max(self.decentring_px, _EXACT_PX)
            tangential = [4 + model.coefficients.index(name) for name in ("p1", "p2")]
            information[tangential, tangential] += (3 * corner * focal_px / sigma_px) ** 2
        information[[2, 3], [2, 3]] = max(self.principal_point_px, _EXACT_PX) ** -2
        aspect = min(_ASPECT, self.focal_length)
        for row, sigma in (([0.5, 0.5], self.focal_length), ([1.0, -1.0], aspect)):
            information[:2, :2] += np.outer(row, row) / (max(sigma, _EXACT) * focal_px) ** 2
        return vector, information


def grid_rays(lens: Intrinsics) -> tuple[Array, Array]:
    """List pixels (n, 2) of a grid over the image and their rays (n, 3), where the model is valid.

    A pinhole polynomial cannot project points beside or behind the camera.
    """
    u, v = np.meshgrid(np.linspace(0, lens.width_px - 1, _GRID), np.linspace(0, lens.height_px - 1, _GRID))
    pixels = np.stack([u.ravel(), v.ravel()], axis=1)
    rays = lens.unproject(pixels)
    is_seen = np.isfinite(rays).all(axis=1) & (rays[:, 2] > 0.2)
    return pixels[is_seen], rays[is_seen]


def _by_radtan(coefficients: Array, points: Array) -> Array:
    """Differentiate distorted x/z, y/z by the coefficients: (..., 2, n)."""
    k1, k2, _, _, k3, k4, k5, k6 = np.pad(coefficients, (0, 8 - len(coefficients)))
    x, y = points[..., 0] / points[..., 2], points[..., 1] / points[..., 2]
    s = x * x + y * y
    lower = 1 + s * (k4 + s * (k5 + s * k6))
    scale = (1 + s * (k1 + s * (k2 + s * k3))) / lower
    by_coefficient = np.empty((*s.shape, 2, 8))
    power = 1 / lower
    for column in (0, 1, 4):
        power = power * s
        by_coefficient[..., 0, column], by_coefficient[..., 1, column] = x * power, y * power
    by_coefficient[..., 0, 2] = by_coefficient[..., 1, 3] = 2 * x * y
    by_coefficient[..., 0, 3], by_coefficient[..., 1, 2] = s + 2 * x * x, s + 2 * y * y
    by_coefficient[..., 5:] = -scale[..., None, None] * by_coefficient[..., [0, 1, 4]]
    return by_coefficient[..., : len(coefficients)]


def _by_equidistant(_coefficients: Array, points: Array) -> Array:
    """Differentiate the distorted coordinates by the coefficients: (..., 2, 4)."""
    lateral = points[..., :2]
    rho = np.maximum(np.linalg.norm(lateral, axis=-1, keepdims=True), 1e-12)
    angle = np.arctan2(rho, points[..., 2:])
    return np.asarray((lateral / rho)[..., None] * (angle ** (2 * np.arange(1, 5) + 1))[..., None, :])
