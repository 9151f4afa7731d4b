"""The brightness of surfaces: ceiling lamps, diffuse light from all walls, shadows and reflections."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lce_rig.core.geometry import Array
from lce_rig.simulate.scene import Hits, Raycaster, Surface, surface_colour

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
