"""The board's carrier for event cameras: rendered at intervals, shifted and blended in between."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lce_rig.core.geometry import Array, invert, transform
from lce_rig.simulate.backdrop import Backdrop, pixel_rays
from lce_rig.simulate.light import irradiance, reached
from lce_rig.simulate.scene import Hits, Raycaster, Scene

GREY = np.array([0.114, 0.587, 0.299])
#: Assumed place of the carrier's middle, m behind the board: decides how its image shifts.
_BEHIND_M = 0.15
_MARGIN_PX = 4
# Rays go through pixels' centres only: this blur stands for the pixel's area and keeps borders smooth.
_PIXEL_PX = 0.36

Window = tuple[slice, slice]


@dataclass(frozen=True, eq=False)
class CarrierLayer:
    """A cut-out image of the carrier at one time.

    Attributes:
        layers: (h, w, 4) float32: the carrier's radiance times its cover, and its cover; then both again of
            those parts alone that stand before the board.
        first_px: (2,) column and row of its first pixel.
        anchor_px: (2,) image of the carrier's middle.
        distance_m: of that middle from the camera.
    """

    layers: NDArray[np.float32]
    first_px: Array
    anchor_px: Array
    distance_m: float

    def bounds_px(self, anchor_px: Array, distance_m: float) -> Array:
        """Bound the layer (2, 2) as (first, beyond last) column and row once its middle is elsewhere."""
        scale = self.distance_m / distance_m
        size = np.array(self.layers.shape[1::-1])
        low = anchor_px + scale * (self.first_px - self.anchor_px)
        return np.stack([np.floor(low) - 1, np.ceil(low + scale * size) + 2])

    def shifted(self, window: Window, anchor_px: Array, distance_m: float) -> NDArray[np.float32]:
        """Draw the layer (h, w, 4) into a window of the image with its middle elsewhere."""
        import cv2

        scale = self.distance_m / distance_m
        corner = np.array([window[1].start, window[0].start])
        offset = anchor_px + scale * (self.first_px - self.anchor_px) - corner
        A = np.array([[scale, 0.0, offset[0]], [0.0, scale, offset[1]]])
        size = (window[1].stop - window[1].start, window[0].stop - window[0].start)
        return np.asarray(cv2.warpAffine(self.layers, A, size, flags=cv2.INTER_LINEAR))


def carrier_middle(backdrop: Backdrop, T_world_board: Array) -> tuple[Array, float] | None:
    """Find the carrier's middle in the image (2,) and its distance; None where no lens shows it."""
    middle = T_world_board[:3, 3] - _BEHIND_M * T_world_board[:3, 2]
    pixel, is_valid = backdrop.intrinsics.project(transform(invert(backdrop.T_world_cam), middle[None]))
    if not is_valid[0]:
        return None
    return pixel[0], float(np.linalg.norm(middle - backdrop.origin))


def render_carrier(scene: Scene, backdrop: Backdrop, blur_px: float) -> CarrierLayer | None:
    """Cut the carrier out of the scene as a lens of this blur shows it; None where it does not."""
    import cv2

    middle = carrier_middle(backdrop, scene.T_world_board)
    window = _window(scene.moving, backdrop)
    if middle is None or window is None:
        return None
    rows, cols = window
    corners = backdrop.corner_rays[rows.start : rows.stop + 1, cols.start : cols.stop + 1]
    rays = pixel_rays(corners).reshape(-1, 3)
    hits = scene.moving.cast(backdrop.origin, rays)
    seen = np.flatnonzero(hits.range_m < backdrop.range_m[window].ravel())
    kept = Hits(hits.range_m[seen], hits.surface[seen] + len(scene.static.surfaces), hits.normals[seen])
    points = reached(backdrop.origin, rays[seen], kept)
    light = irradiance(backdrop.lamps, points, kept.normals, scene.occluders)
    layers = np.zeros((len(rays), 4), dtype=np.float32)
    layers[seen, 0] = (scene.colour(kept, points) * light) @ GREY
    layers[seen, 1] = 1.0
    ahead = seen[kept.range_m < scene.cast_board(backdrop.origin, rays[seen]).range_m]
    layers[ahead, 2:] = layers[ahead, :2]
    shape = (rows.stop - rows.start, cols.stop - cols.start, 4)
    sigma_px = float(np.hypot(blur_px, _PIXEL_PX))
    soft = cv2.GaussianBlur(layers.reshape(shape), (0, 0), sigma_px, borderType=cv2.BORDER_REPLICATE)
    return CarrierLayer(
        np.asarray(soft, dtype=np.float32), np.array([cols.start, rows.start], dtype=np.float64), *middle
    )


def _window(moving: Raycaster, backdrop: Backdrop) -> Window | None:
    """Bound the pixels that the carrier covers."""
    if not moving.surfaces:
        return None
    vertices = np.concatenate([surface.mesh.vertices for surface in moving.surfaces])
    pixels, is_valid = backdrop.intrinsics.project(transform(invert(backdrop.T_world_cam), vertices))
    if not is_valid.any():
        return None
    low, high = pixels[is_valid].min(axis=0) - _MARGIN_PX, pixels[is_valid].max(axis=0) + _MARGIN_PX
    return clip_window(np.stack([low, high]), backdrop)


def clip_window(bounds_px: Array, backdrop: Backdrop) -> Window | None:
    """Cut bounds (2, 2) as (low, high) column and row to the image; None where nothing is left."""
    height, width = backdrop.range_m.shape
    (u0, v0), (u1, v1) = np.clip(np.rint(bounds_px), 0, [width, height]).astype(int)
    return (slice(int(v0), int(v1)), slice(int(u0), int(u1))) if u1 > u0 and v1 > v0 else None
