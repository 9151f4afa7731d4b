"""A camera of any lens model: board and carrier in front of the room, anti-aliased, blurred and noisy."""

from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from lce_rig.core.geometry import Array, invert, transform
from lce_rig.simulate.backdrop import (
    Backdrop,
    beside_changes,
    irradiance,
    pixel_rays,
    reached,
    sub_rays,
)
from lce_rig.simulate.options import CameraNoise
from lce_rig.simulate.scene import Raycaster, Scene

#: Samples per pixel along each axis, at edges.
SUBPIXELS = 5
_GAMMA = 1 / 2.2


def render_radiance(scene: Scene, backdrop: Backdrop, *, is_draft: bool = False) -> Array:
    """Compute the light at the lens: linear (H, W, 3), anti-aliased along edges of board and carrier.

    Args:
        scene: the room of the backdrop, with the board and its carrier.
        backdrop: the camera and its image of the static room.
        is_draft: one ray per pixel and no shadows of board and carrier, in a tenth of the time.
    """
    radiance: Array = backdrop.radiance.copy()
    rows, cols = _region(scene, backdrop)
    if rows.stop <= rows.start or cols.stop <= cols.start:
        return radiance
    corners = backdrop.corner_rays[rows.start : rows.stop + 1, cols.start : cols.stop + 1]
    window = _ImageWindow(corners, backdrop.radiance[rows, cols], backdrop.range_m[rows, cols])
    label, colour, light = _look_through_centres(
        scene, backdrop, window, None if is_draft else scene.occluders
    )
    painted = np.where((label >= 0)[..., None], colour * light, window.backdrop)
    if is_draft:
        radiance[rows, cols] = painted
        return radiance

    is_edge = _dilate(beside_changes(label[1:] != label[:-1], label[:, 1:] != label[:, :-1]))
    is_carrier = (label >= 0) & (label < scene.board_index)
    lights = (_spread(light, is_carrier), _spread(light, label >= scene.board_index))
    v, u = np.nonzero(is_edge)
    rays = sub_rays(corners, v, u, SUBPIXELS)
    painted[v, u] = _look_through(scene, backdrop.origin, window, lights, (v, u), rays)
    radiance[rows, cols] = painted
    return radiance


def _region(scene: Scene, backdrop: Backdrop) -> tuple[slice, slice]:
    """Bound the pixels that the board and its carrier can touch."""
    height, width = backdrop.range_m.shape
    outline = transform(scene.T_world_board, scene.board.outline())
    # Lenses bend straight edges: bound the plate by many points along them.
    along = np.linspace(0, 1, 33)[:, None, None]
    edges = (1 - along) * outline + along * np.roll(outline, -1, axis=0)
    points = np.concatenate([*(s.mesh.vertices for s in scene.moving.surfaces), edges.reshape(-1, 3)])
    pixels, is_valid = backdrop.intrinsics.project(transform(invert(backdrop.T_world_cam), points))
    if not is_valid.any():
        return slice(0, 0), slice(0, 0)
    if not is_valid.all():
        return slice(0, height), slice(0, width)
    low, high = np.floor(pixels.min(axis=0)) - 4, np.ceil(pixels.max(axis=0)) + 5
    u0, u1 = (int(np.clip(value, 0, width)) for value in (low[0], high[0]))
    v0, v1 = (int(np.clip(value, 0, height)) for value in (low[1], high[1]))
    return slice(v0, v1), slice(u0, u1)


class _ImageWindow(NamedTuple):
    """The rays (h + 1, w + 1, 3), the room's radiance (h, w, 3) and range (h, w) in a part of an image."""

    corner_rays: Array
    backdrop: Array
    backdrop_range_m: Array


def _look_through_centres(
    scene: Scene, backdrop: Backdrop, window: _ImageWindow, occluders: Raycaster | None
) -> tuple[NDArray[np.int32], Array, Array]:
    """Cast one ray per pixel: label (h, w) of its surface, -1 the backdrop; its colour, light (h, w, 3)."""
    shape = window.backdrop.shape
    rays = pixel_rays(window.corner_rays).reshape(-1, 3)
    hits = scene.cast_moving(backdrop.origin, rays)
    label = np.where(hits.range_m < window.backdrop_range_m.ravel(), hits.surface, -1).astype(np.int32)
    seen = np.flatnonzero(label >= 0)
    kept = hits.select(seen)
    points = reached(backdrop.origin, rays[seen], kept)
    colour, light = np.zeros((len(rays), 3)), np.zeros((len(rays), 3))
    colour[seen] = scene.colour(kept, points)
    light[seen] = irradiance(backdrop.lamps, points, kept.normals, occluders)
    # Dark squares count as a surface of their own, so that edges of the pattern are found as edges.
    label[seen] += (kept.surface == scene.board_index) & scene.is_dark(points)
    return label.reshape(shape[:2]), colour.reshape(shape), light.reshape(shape)


def _look_through(
    scene: Scene,
    origin: Array,
    window: _ImageWindow,
    lights: tuple[Array, Array],
    pixels: tuple[NDArray[np.intp], NDArray[np.intp]],
    rays: Array,
) -> Array:
    """Average n rays (M, n, 3) per pixel: (M, 3), with the light on carrier and board from `lights`."""
    v, u = (np.repeat(index, rays.shape[1]) for index in pixels)
    flat = rays.reshape(-1, 3)
    hits = scene.cast_moving(origin, flat)
    near = np.flatnonzero(hits.range_m < window.backdrop_range_m[v, u])
    kept = hits.select(near)
    on_carrier, on_board = (light[v[near], u[near]] for light in lights)
    light = np.where((kept.surface == scene.board_index)[:, None], on_board, on_carrier)
    samples = window.backdrop[v, u]
    samples[near] = scene.colour(kept, reached(origin, flat[near], kept)) * light
    return np.asarray(samples.reshape(rays.shape).mean(axis=1))


def _dilate(mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Grow a mask (H, W) by one pixel, diagonals included."""
    import cv2

    return np.asarray(cv2.dilate(mask.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0)


def _spread(light: Array, mask: NDArray[np.bool_]) -> Array:
    """Carry the light (H, W, 3) within a mask over its border, for samples beyond it."""
    import cv2

    weight = mask.astype(np.float64)
    window = (7, 7)
    total = cv2.boxFilter(weight, -1, window, normalize=False)
    summed = cv2.boxFilter(light * weight[..., None], -1, window, normalize=False)
    return np.asarray(summed / np.maximum(total, 1e-9)[..., None])


@lru_cache(maxsize=8)
def sensor_gain(height_px: int, width_px: int, noise: CameraNoise) -> Array:
    """Compute the factor on each pixel's radiance (H, W): vignetting.

    It is the same for all images of a camera and read-only.
    """
    v, u = np.mgrid[0:height_px, 0:width_px]
    radius2 = ((u - (width_px - 1) / 2) ** 2 + (v - (height_px - 1) / 2) ** 2) / (
        ((width_px - 1) ** 2 + (height_px - 1) ** 2) / 4
    )
    gain = np.asarray(1 - noise.vignetting * radius2)
    gain.setflags(write=False)
    return gain


def expose(radiance: Array, noise: CameraNoise, rng: np.random.Generator) -> NDArray[np.uint8]:
    """Turn linear radiance (H, W, 3) into an image: vignetting, point spread, shot and read noise, gamma."""
    import cv2

    linear = (radiance * sensor_gain(*radiance.shape[:2], noise)[..., None]).astype(np.float32)
    if noise.blur_px > 0:
        soft = cv2.GaussianBlur(linear, (0, 0), noise.blur_px, borderType=cv2.BORDER_REPLICATE)
        linear = np.asarray(soft, dtype=np.float32)
    if np.isfinite(noise.full_well_e):
        electrons = np.clip(linear, 0, None) * noise.full_well_e
        sigma_e = np.sqrt(electrons + noise.read_noise_e**2)
        linear = linear + sigma_e * rng.standard_normal(linear.shape, dtype=np.float32) / noise.full_well_e
    tone = 255.0 * np.clip(linear, 0.0, 1.0) ** _GAMMA
    return np.asarray(np.rint(tone), dtype=np.uint8)
