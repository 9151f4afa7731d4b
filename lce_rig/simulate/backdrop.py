"""The static room in a camera's image: the costly half of rendering, computed once per session.

Ceiling lamps and soft light from all walls, with shadows and reflections.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from lce_rig.core.camera import Intrinsics
from lce_rig.core.geometry import Array
from lce_rig.simulate.room import Room
from lce_rig.simulate.scene import Hits, Raycaster, Surface, join_rows, surface_colour

#: Linear (blue, green, red) of light that comes from everywhere, and of one lamp at 1 m.
_AMBIENT = np.array([0.400, 0.395, 0.385])
_LAMP = np.array([1.50, 1.58, 1.62])


def lamp_light(lamps: Array, points: Array, normals: Array) -> Array:
    """Compute each lamp's unshadowed share E = I cos(a) cos(b) / d^2 of the irradiance.

    Args:
        lamps: (P, 3) m, facing down.
        points: (N, 3) m.
        normals: (N, 3) unit.

    Returns:
        (N, P), in units of a lamp at 1 m.
    """
    share = np.empty((len(points), len(lamps)))
    for k, lamp in enumerate(lamps):
        way = lamp - points
        inverse = 1.0 / np.sqrt(np.maximum(np.einsum("nc,nc->n", way, way), 1e-12))
        cosine = np.einsum("nc,nc->n", way, normals) * inverse
        # A lamp has size: its light wraps a little round bodies and does not grow without bound near it.
        wrapped = np.maximum((cosine + 0.1) / 1.1, 0.0)
        share[:, k] = wrapped * np.maximum(way[:, 2], 0.0) * inverse * np.minimum(inverse, 1 / 0.6) ** 2
    return share


def ambient_light(normals: Array) -> Array:
    """Compute the soft light (N, 3); what looks up gets a little more."""
    return np.asarray((0.85 + 0.15 * normals[:, 2:]) * _AMBIENT)


def irradiance(lamps: Array, points: Array, normals: Array, occluders: Raycaster | None = None) -> Array:
    """Sum soft and lamp light (N, 3) at points (N, 3), without lamps hidden by `occluders`."""
    share = lamp_light(lamps, points, normals)
    if occluders is not None:
        lifted = points + 2e-3 * normals
        for k, lamp in enumerate(lamps):
            lit = np.flatnonzero(share[:, k] > 0)
            # Stop short of the lamp's own housing.
            share[lit[occluders.is_blocked(lifted[lit], lamp - [0.0, 0.0, 0.06])], k] *= 0.15
    return np.asarray(ambient_light(normals) + share.sum(axis=1, keepdims=True) * _LAMP)


@dataclass(frozen=True, eq=False)
class Mirrors:
    """The rays that hit a shiny surface, and their reflection of the static room.

    Attributes:
        index: (M,) of the rays.
        starts: (M, 3) m, world.
        directions: (M, 3) unit, world.
        weight: (M, 1) of the mirror image.
        image: (M, 3) linear radiance of the mirror image.
        range_m: (M,) how far away the mirrored surface is.
    """

    index: NDArray[np.intp]
    starts: Array
    directions: Array
    weight: Array
    image: Array
    range_m: Array


def static_radiance(
    room: Raycaster, lamps: Array, origin: Array, directions: Array
) -> tuple[Array, Hits, Mirrors]:
    """Compute what rays (N, 3) see of the standing room: linear (N, 3), what they hit, mirrors."""
    hits = room.cast(origin, directions)
    points = reached(origin, directions, hits)
    light = irradiance(lamps, points, hits.normals, room)
    radiance = _surface_radiance(room.surfaces, hits, points, light)
    gloss = np.array([*(s.material.gloss for s in room.surfaces), 0.0])[hits.surface]
    shiny = np.flatnonzero(gloss > 0)
    weight = mirror_weight(gloss[shiny], hits.normals[shiny], directions[shiny])
    mirrored = mirror(directions[shiny], hits.normals[shiny])
    starts = points[shiny] + 1e-3 * hits.normals[shiny]
    again = room.cast(starts, mirrored)
    there = reached(starts, mirrored, again)
    image = _surface_radiance(room.surfaces, again, there, irradiance(lamps, there, again.normals))
    radiance[shiny] = (1 - weight) * radiance[shiny] + weight * image
    return radiance, hits, Mirrors(shiny, starts, mirrored, weight, image, again.range_m)


def reached(origins: Array, directions: Array, hits: Hits) -> Array:
    """Compute the points (N, 3) that rays reach; their origins where they meet nothing."""
    return np.asarray(origins + np.where(np.isfinite(hits.range_m), hits.range_m, 0.0)[:, None] * directions)


def mirror(directions: Array, normals: Array) -> Array:
    """Mirror directions (N, 3) at surfaces with unit normals (N, 3)."""
    along = np.einsum("nc,nc->n", directions, normals)
    return np.asarray(directions - 2 * along[:, None] * normals)


def mirror_weight(gloss: Array, normals: Array, directions: Array) -> Array:
    """Weigh the mirror image (N, 1) by Schlick's approximation of Fresnel's law.

    References:
        C. Schlick, An inexpensive BRDF model for physically-based rendering, CGF 13(3), 1994.
    """
    cosine = np.abs(np.einsum("nc,nc->n", normals, directions))
    return np.asarray((gloss * (0.12 + 0.88 * (1 - cosine) ** 5))[:, None])


def _surface_radiance(surfaces: tuple[Surface, ...], hits: Hits, points: Array, light: Array) -> Array:
    out = np.zeros((len(points), 3))
    for index in np.unique(hits.surface):
        if index < 0:
            continue
        rows = np.flatnonzero(hits.surface == index)
        surface = surfaces[index]
        colour = surface_colour(surface, points[rows], hits.normals[rows])
        out[rows] = colour * (light[rows] + surface.material.emission)
    return out


SHADOW_STEP_PX = 4
_KNOT_STEP_PX = 4
_EDGE_TONE, _EDGE_SAMPLES = 0.05, 2
_CHUNK = 1 << 18


@dataclass(frozen=True, eq=False)
class Backdrop:
    """A camera at its pose in the room, with its image of the room.

    Attributes:
        intrinsics: of the camera.
        T_world_cam: (4, 4).
        corner_rays: (H + 1, W + 1, 3) unit rays through the pixels' corners, world.
        radiance: (H, W, 3) linear (blue, green, red).
        range_m: (H, W) along the ray through each pixel's centre.
        mirrors: shiny surfaces, indexed by row-major pixel.
        lamps: (P, 3) m, world.
        shadow_points: (h, w, 3) m, seen by every fourth pixel, world.
        shadow_share: (h, w, P) each lamp's share of the light there.
    """

    intrinsics: Intrinsics
    T_world_cam: Array
    corner_rays: Array
    radiance: Array
    range_m: Array
    mirrors: Mirrors
    lamps: Array
    shadow_points: Array
    shadow_share: Array

    @property
    def origin(self) -> Array:
        """The camera's centre (3,), world."""
        return np.asarray(self.T_world_cam[:3, 3])


def build_backdrop(room: Room, T_world_cam: Array, intrinsics: Intrinsics) -> Backdrop:
    """Render the standing room as a camera at T_world_cam (4, 4) sees it."""
    shape = (intrinsics.height_px, intrinsics.width_px)
    origin = T_world_cam[:3, 3]
    corners = pixel_corner_rays(intrinsics) @ T_world_cam[:3, :3].T
    rays = pixel_rays(corners).reshape(-1, 3)
    flat, hits, mirrors = _render(room, origin, rays)
    radiance = flat.reshape(*shape, 3)
    # Resample the pixels that differ much from a neighbour.
    tone = np.sqrt(np.clip(radiance.mean(axis=2), 0.0, 1.0))
    down, across = (np.abs(np.diff(tone, axis=axis)) > _EDGE_TONE for axis in (0, 1))
    rows, cols = np.nonzero(beside_changes(down, across))
    spread = sub_rays(corners, rows, cols, _EDGE_SAMPLES)
    sampled, _, _ = _render(room, origin, spread.reshape(-1, 3))
    radiance[rows, cols] = sampled.reshape(spread.shape).mean(axis=1)

    coarse = (slice(None, None, SHADOW_STEP_PX), slice(None, None, SHADOW_STEP_PX))
    points = reached(origin, rays, hits).reshape(*shape, 3)[coarse]
    normals = hits.normals.reshape(*shape, 3)[coarse]
    share = lamp_light(room.lamps, points.reshape(-1, 3), normals.reshape(-1, 3))
    return Backdrop(
        intrinsics=intrinsics,
        T_world_cam=T_world_cam,
        corner_rays=corners,
        radiance=radiance,
        range_m=hits.range_m.reshape(shape),
        mirrors=mirrors,
        lamps=room.lamps,
        shadow_points=points,
        shadow_share=share.reshape(*points.shape[:2], -1),
    )


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

    Just before it folds, the polynomial's slope falls to zero: images leave it a little earlier.
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


def _render(room: Room, origin: Array, rays: Array) -> tuple[Array, Hits, Mirrors]:
    """Compute `static_radiance` in pieces that fit the cache and the memory."""
    pieces = []
    for start in range(0, len(rays), _CHUNK):
        radiance, hits, mirrors = static_radiance(
            room.raycaster, room.lamps, origin, rays[start : start + _CHUNK]
        )
        pieces.append((radiance, hits, replace(mirrors, index=mirrors.index + start)))
    radiances, hits_of, mirrors_of = zip(*pieces, strict=True)
    return np.concatenate(radiances), join_rows(hits_of), join_rows(mirrors_of)
