"""The static room in a camera's image: the costly half of rendering, computed once per session.

Ceiling lamps and soft light from all walls, with shadows.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from lce_rig.core.camera import Intrinsics
from lce_rig.core.geometry import Array
from lce_rig.simulate.room import Room
from lce_rig.simulate.scene import Hits, Raycaster, surface_colour
from lce_rig.simulate.surfaces import ROOM

_AMBIENT, _LAMP = (np.array(ROOM["light"][name]) for name in ("ambient", "lamp"))


def irradiance(lamps: Array, points: Array, normals: Array, occluders: Raycaster | None = None) -> Array:
    """Sum soft light and E = I cos(a) cos(b) / d^2 of each lamp, less where `occluders` hide it.

    Args:
        lamps: (P, 3) m, facing down.
        points: (N, 3) m.
        normals: (N, 3) unit.
        occluders: occluders of the lamps.

    Returns:
        (N, 3) linear (blue, green, red).
    """
    of_lamps = np.zeros(len(points))
    for lamp in lamps:
        way = lamp - points
        inverse = 1.0 / np.sqrt(np.maximum(np.einsum("nc,nc->n", way, way), 1e-12))
        cosine = np.einsum("nc,nc->n", way, normals) * inverse
        # A lamp has size: its light wraps a little round bodies and does not grow without bound near it.
        wrapped = np.maximum((cosine + 0.1) / 1.1, 0.0)
        share = wrapped * np.maximum(way[:, 2], 0.0) * inverse * np.minimum(inverse, 1 / 0.6) ** 2
        if occluders is not None:
            lit = np.flatnonzero(share > 0)
            # Stop short of the lamp's own housing.
            is_hidden = occluders.is_blocked(points[lit] + 2e-3 * normals[lit], lamp - [0.0, 0.0, 0.06])
            share[lit[is_hidden]] *= 0.15
        of_lamps += share
    # Surfaces that face up get a little more of the soft light.
    soft = (0.85 + 0.15 * normals[:, 2:]) * _AMBIENT
    return np.asarray(soft + of_lamps[:, None] * _LAMP)


def reached(origins: Array, directions: Array, hits: Hits) -> Array:
    """Compute the points (N, 3) that rays reach; a ray without a hit returns its origin."""
    return np.asarray(origins + np.where(np.isfinite(hits.range_m), hits.range_m, 0.0)[:, None] * directions)


_KNOT_STEP_PX = 4
_CHUNK = 1 << 18


@dataclass(frozen=True, eq=False)
class Backdrop:
    """A camera at its pose in the room, with its image of the room.

    Attributes:
        intrinsics: intrinsics of the camera.
        T_world_cam: (4, 4).
        corner_rays: (H + 1, W + 1, 3) unit rays through the pixels' corners, world.
        radiance: (H, W, 3) linear (blue, green, red).
        range_m: (H, W) along the ray through each pixel's centre.
        lamps: (P, 3) m, world.
    """

    intrinsics: Intrinsics
    T_world_cam: Array
    corner_rays: Array
    radiance: Array
    range_m: Array
    lamps: Array

    @property
    def origin(self) -> Array:
        """The camera's centre (3,), world."""
        return np.asarray(self.T_world_cam[:3, 3])


def build_backdrop(
    room: Room, T_world_cam: Array, intrinsics: Intrinsics, *, is_draft: bool = False
) -> Backdrop:
    """Render the static room from a camera at T_world_cam (4, 4); a draft at half the resolution."""
    origin = T_world_cam[:3, 3]
    corners = pixel_corner_rays(intrinsics) @ T_world_cam[:3, :3].T
    # One ray for each 2 x 2 pixels, through the corner in their middle.
    rays = corners[1::2, 1::2] if is_draft else pixel_rays(corners)
    flat, range_m = _render(room, origin, rays.reshape(-1, 3))
    radiance, range_m = flat.reshape(rays.shape), range_m.reshape(rays.shape[:2])
    if is_draft:
        radiance = _doubled(radiance, intrinsics, cv2.INTER_LINEAR)
        range_m = _doubled(range_m, intrinsics, cv2.INTER_NEAREST)
        return Backdrop(intrinsics, T_world_cam, corners, radiance, range_m, room.lamps)
    # Resample the pixels that differ from a neighbour by more than 5 % of white, by 2 x 2 rays each.
    tone = np.sqrt(np.clip(radiance.mean(axis=2), 0.0, 1.0))
    down, across = (np.abs(np.diff(tone, axis=axis)) > 0.05 for axis in (0, 1))
    rows, cols = np.nonzero(beside_changes(down, across))
    spread = sub_rays(corners, rows, cols, 2)
    sampled, _ = _render(room, origin, spread.reshape(-1, 3))
    radiance[rows, cols] = sampled.reshape(spread.shape).mean(axis=1)
    return Backdrop(intrinsics, T_world_cam, corners, radiance, range_m, room.lamps)


def _doubled(values: Array, intrinsics: Intrinsics, interpolation: int) -> Array:
    """Enlarge an image of half the resolution; of an odd size, the last row or column is repeated."""
    large = cv2.resize(values, None, fx=2, fy=2, interpolation=interpolation)
    bottom, right = intrinsics.height_px % 2, intrinsics.width_px % 2
    return np.asarray(cv2.copyMakeBorder(large, 0, bottom, 0, right, cv2.BORDER_REPLICATE))


def pixel_corner_rays(intrinsics: Intrinsics) -> Array:
    """Find the rays (H + 1, W + 1, 3) through the corners of all pixels, frame camera optical.

    Newton's method on a grid of knots, with cubic splines between them: within 2e-3 px of
    `Intrinsics.unproject` at a twentieth of its time.
    """
    from scipy.interpolate import RectBivariateSpline

    height, width = intrinsics.height_px, intrinsics.width_px
    v, u = (np.linspace(-0.5, size - 0.5, int(np.ceil(size / _KNOT_STEP_PX)) + 1) for size in (height, width))
    knots = _rays_beyond_the_lens(intrinsics, np.stack(np.meshgrid(u, v), axis=-1))
    rows, cols = np.arange(height + 1) - 0.5, np.arange(width + 1) - 0.5
    rays = np.stack([RectBivariateSpline(v, u, knots[..., k])(rows, cols) for k in range(3)], axis=-1)
    return unit(rays)


def _rays_beyond_the_lens(intrinsics: Intrinsics, pixels: Array) -> Array:
    """Unproject; where the lens model has folded back, continue outwards in proportion to the distance.

    Real images are not black there: only the polynomial ends, not the lens.
    """
    centre = np.array([intrinsics.cx_px, intrinsics.cy_px])
    focal = np.array([intrinsics.fx_px, intrinsics.fy_px])
    rays = intrinsics.unproject(pixels)
    radius = np.linalg.norm((pixels - centre) / focal, axis=-1)
    limit = lens_reach(intrinsics)
    beyond = radius > limit
    if not beyond.any():
        return rays
    inner = intrinsics.unproject(centre + (pixels[beyond] - centre) * (limit / radius[beyond])[:, None])
    angle = np.arccos(np.clip(inner[:, 2], -1.0, 1.0)) * radius[beyond] / limit
    side = inner[:, :2] / np.linalg.norm(inner[:, :2], axis=1, keepdims=True)
    rays[beyond] = np.concatenate([np.sin(angle)[:, None] * side, np.cos(angle)[:, None]], axis=1)
    return rays


def lens_reach(intrinsics: Intrinsics) -> float:
    """Find the |(pixel - c) / f| up to which images follow the lens model.

    The polynomial's slope falls to zero just before it folds: images end a little earlier.
    """
    widest = 0.999 * intrinsics.max_radius
    if intrinsics.model == "equidistant":
        rays = np.sin(widest) * np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]) + [0.0, 0.0, np.cos(widest)]
    else:
        rays = np.array([[widest, 0.0, 1.0], [0.0, widest, 1.0]])
    pixels, _ = intrinsics.project(np.concatenate([rays, rays * [-1.0, -1.0, 1.0]]))
    offset = (pixels - [intrinsics.cx_px, intrinsics.cy_px]) / [intrinsics.fx_px, intrinsics.fy_px]
    return 0.96 * float(np.linalg.norm(offset, axis=-1).min())


def unit(rays: Array) -> Array:
    """Scale rays (..., 3) to length 1."""
    return np.asarray(rays / np.sqrt(np.einsum("...c,...c->...", rays, rays))[..., None])


def pixel_rays(corners: Array) -> Array:
    """Find the unit rays (H, W, 3) through the pixels' centres from those through their corners."""
    return unit(corners[:-1, :-1] + corners[:-1, 1:] + corners[1:, :-1] + corners[1:, 1:])


def sub_rays(corners: Array, rows: NDArray[np.intp], cols: NDArray[np.intp], n: int) -> Array:
    """Spread pixels (M,) into unit rays (M, n * n, 3) on a regular grid within each."""
    f = (np.arange(n) + 0.5) / n
    fv, fu = (grid.ravel()[:, None] for grid in np.meshgrid(f, f, indexing="ij"))
    a, b = corners[rows, cols][:, None], corners[rows, cols + 1][:, None]
    c, d = corners[rows + 1, cols][:, None], corners[rows + 1, cols + 1][:, None]
    return unit((1 - fv) * ((1 - fu) * a + fu * b) + fv * ((1 - fu) * c + fu * d))


def beside_changes(changes_down: NDArray[np.bool_], changes_across: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Mark pixels (H, W) on either side of changes between rows (H - 1, W) or columns (H, W - 1)."""
    edge = np.zeros((changes_across.shape[0], changes_down.shape[1]), dtype=np.bool_)
    edge[1:] |= changes_down
    edge[:-1] |= changes_down
    edge[:, 1:] |= changes_across
    edge[:, :-1] |= changes_across
    return edge


def _render(room: Room, origin: Array, rays: Array) -> tuple[Array, Array]:
    """Compute the radiance, linear (N, 3), and range (N,), m, of the static room along rays (N, 3).

    Pieces that fit the cache and the memory are rendered one after the other.
    """
    surfaces = room.raycaster.surfaces
    pieces = []
    for start in range(0, len(rays), _CHUNK):
        directions = rays[start : start + _CHUNK]
        hits = room.raycaster.cast(origin, directions)
        points = reached(origin, directions, hits)
        light = irradiance(room.lamps, points, hits.normals, room.raycaster)
        radiance = np.zeros((len(points), 3))
        for index in np.unique(hits.surface[hits.surface >= 0]):
            rows = np.flatnonzero(hits.surface == index)
            colour = surface_colour(surfaces[index], points[rows], hits.normals[rows])
            radiance[rows] = colour * (light[rows] + surfaces[index].material.emission)
        pieces.append((radiance, hits.range_m))
    radiances, ranges_m = zip(*pieces, strict=True)
    return np.concatenate(radiances), np.concatenate(ranges_m)
