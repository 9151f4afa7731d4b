"""Grey images of the moving board: hundreds per second, smooth enough for event pixels.

`render_radiance` draws single images with shadows on the board. Here the room is one fixed image, the
board is drawn analytically, and its carrier is a cut-out that shifts. Edges are smoothed by their distance
in units of the pixel's own spread, not by sampling: intensities change without steps as the board moves.
"""

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from lce_rig.core.board import Board
from lce_rig.core.geometry import Array, invert, transform
from lce_rig.core.pattern import is_dark
from lce_rig.simulate.backdrop import Backdrop, irradiance, pixel_rays, reached
from lce_rig.simulate.event_camera import EventCamera
from lce_rig.simulate.image_rendering import sensor_gain
from lce_rig.simulate.options import CameraNoise
from lce_rig.simulate.placements import Trajectory
from lce_rig.simulate.scene import PLATE, PLATE_BACK, PRINT_ALBEDO, Hits, Scene

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
    if middle is None or not scene.moving.surfaces:
        return None
    vertices = np.concatenate([surface.mesh.vertices for surface in scene.moving.surfaces])
    window = _pixel_window(vertices, backdrop, _MARGIN_PX, _MARGIN_PX)
    if window is None:
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


def _pixel_window(points: Array, backdrop: Backdrop, before_px: int, after_px: int) -> Window | None:
    """Bound the pixels of points (N, 3), world, with margins; None where the image shows none."""
    pixels, is_valid = backdrop.intrinsics.project(transform(invert(backdrop.T_world_cam), points))
    if not is_valid.any():
        return None
    low, high = pixels[is_valid].min(axis=0) - before_px, pixels[is_valid].max(axis=0) + after_px
    return clip_window(np.stack([low, high]), backdrop)


def clip_window(bounds_px: Array, backdrop: Backdrop) -> Window | None:
    """Cut bounds (2, 2) as (low, high) column and row to the image; None where nothing is left."""
    height, width = backdrop.range_m.shape
    (u0, v0), (u1, v1) = np.clip(np.rint(bounds_px), 0, [width, height]).astype(int)
    return (slice(int(v0), int(v1)), slice(int(u0), int(u1))) if u1 > u0 and v1 > v0 else None


Float = NDArray[np.float32]
_KEY_NS = 250_000_000
_STEP_PX = 0.4
_STEP_NS = (500_000, 5_000_000)
_ALONG = np.linspace(0, 1, 17)[:, None, None]
# Mean square distance of a pixel's area from its middle, px^2, along one axis.
_PIXEL_AREA_PX2 = 1 / 12


@dataclass(eq=False)
class MovingView:
    """One camera's view of the moving board.

    Attributes:
        backdrop: the camera and the standing room.
        board: the board.
        trajectory: where it is.
        scene_at: the scene at a time of the rig's clock, ns: for the carrier.
        lens: the camera's errors; blur, exposure and vignetting count.
    """

    backdrop: Backdrop
    board: Board
    trajectory: Trajectory
    scene_at: Callable[[int], Scene]
    lens: CameraNoise
    _keys: dict[int, tuple[CarrierLayer | None, Array]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        import cv2

        grey = (self.backdrop.radiance @ GREY).astype(np.float32)
        if self.lens.blur_px > 0:
            soft = cv2.GaussianBlur(grey, (0, 0), self.lens.blur_px, borderType=cv2.BORDER_REPLICATE)
            grey = np.asarray(soft, dtype=np.float32)
        self._room: Float = grey
        height_px, width_px = grey.shape
        self._gain = sensor_gain(height_px, width_px, self.lens).astype(np.float32)
        self._rays = pixel_rays(self.backdrop.corner_rays).astype(np.float32)
        self._room_range_m = self.backdrop.range_m.astype(np.float32)

    def at(self, t_ns: int) -> Float:
        """Render the linear intensity (H, W) that the sensor sees at a time of the rig's clock."""
        seen = self._room.copy()
        T_world_board = self.trajectory.at(t_ns)
        layers = self._carrier(t_ns, T_world_board)
        if layers is not None:
            window, both = layers
            seen[window] += both[..., 0] - both[..., 1] * seen[window]
        outline = transform(T_world_board, self.board.outline())
        edges = ((1 - _ALONG) * outline + _ALONG * np.roll(outline, -1, axis=0)).reshape(-1, 3)
        board_window = _pixel_window(edges, self.backdrop, 4, 5)
        if board_window is not None:
            k, weight = divmod(t_ns, _KEY_NS)
            before, after = self._key(k)[1], self._key(k + 1)[1]
            radiance, cover = self._board(
                board_window,
                T_world_board,
                np.asarray(before + (weight / _KEY_NS) * (after - before), dtype=np.float32),
            )
            seen[board_window] += cover * (radiance - seen[board_window])
        if layers is not None:
            seen[window] += both[..., 2] - both[..., 3] * seen[window]
        seen *= self._gain
        return np.asarray(seen)

    def step_ns(self, t_ns: int) -> int:
        """Choose how long after t_ns the next sub-frame is due."""
        speed = speed_px_s(self.trajectory, self.board, self.backdrop, t_ns)
        return int(np.clip(1e9 * _STEP_PX / max(speed, 1e-3), *_STEP_NS))

    def _board(self, window: Window, T_world_board: Array, light: Array) -> tuple[Float, Float]:
        """Compute the board's radiance and its cover (h, w) of each pixel, 0..1."""
        R = T_world_board[:3, :3].astype(np.float32)
        eye = transform(invert(T_world_board), self.backdrop.origin[None])[0]
        rays = self._rays[window]
        with np.errstate(divide="ignore", invalid="ignore"):
            range_m = np.float32(-eye[2]) / (rays @ R[:, 2])
            x = np.float32(eye[0]) + range_m * (rays @ R[:, 0])
            y = np.float32(eye[1]) + range_m * (rays @ R[:, 1])
        is_before = (range_m > 0) & (range_m < self._room_range_m[window])
        sigma_px = np.float32(np.sqrt(self.lens.blur_px**2 + _PIXEL_AREA_PX2))
        spread_x, spread_y = (sigma_px * _slope(along) for along in (x, y))
        cover = _inside(self.board.width_m / 2, x, spread_x) * _inside(self.board.height_m / 2, y, spread_y)
        cover *= is_before
        shade = light[0] + light[1] * x + light[2] * y + light[3] * x * y
        if eye[2] > 0:
            white, ink = (np.float32(np.dot(GREY, colour)) for colour in (PLATE.colour, (PRINT_ALBEDO,) * 3))
            shade *= white + (ink - white) * self._print(x, y, spread_x, spread_y)
        else:
            shade *= np.float32(np.dot(GREY, PLATE_BACK.colour))
        return np.nan_to_num(shade.astype(np.float32)), np.nan_to_num(cover)

    def _print(self, x: Float, y: Float, spread_x: Float, spread_y: Float) -> Float:
        """Compute the share (h, w) of each pixel that is inked.

        Along each axis the squares are a wave of +-1, smoothed where it changes sign; where both waves have
        the same sign the pattern is dark. For a smoothing that is round in the image this product is what
        smoothing the whole pattern would give, as long as the board is not seen at a grazing angle.
        """
        board, offset_m = self.board, self.board.pattern_offset_m
        if board.has_markers:
            # No product of waves: the mean of points over the kernel's width.
            shifts = np.sqrt(5) * np.array([-0.6, -0.2, 0.2, 0.6])
            dark = [
                is_dark(board, np.stack([x + across * spread_x, y + along * spread_y], axis=-1))
                for across in shifts
                for along in shifts
            ]
            return np.asarray(np.mean(dark, axis=0), dtype=np.float32)
        axes = ((x - offset_m[0], board.cols, spread_x), (offset_m[1] - y, board.rows, spread_y))
        inside, wave = np.float32(1.0), np.float32(1.0)
        for from_middle_m, n_inner, spread_m in axes:
            half = (n_inner + 1) / 2
            place, sigma = from_middle_m / board.square_m + half, spread_m / board.square_m
            edge = np.clip(np.rint(place), 1, n_inner)
            sign = 1 - 2 * np.mod(edge, 2)
            wave = wave * sign * (2 * _smooth_step(place - edge, sigma) - 1)
            inside = inside * _inside(half, place - half, sigma)
        return np.asarray(inside * (1 + wave) / 2, dtype=np.float32)

    def _carrier(self, t_ns: int, T_world_board: Array) -> tuple[Window, Float] | None:
        """Draw the carrier (h, w, 4) as blended from the images before and after this time."""
        middle = carrier_middle(self.backdrop, T_world_board)
        k, weight = divmod(t_ns, _KEY_NS)
        first, second = self._key(k)[0], self._key(k + 1)[0]
        if middle is None or first is None or second is None:
            return None
        bounds = np.stack([first.bounds_px(*middle), second.bounds_px(*middle)])
        window = clip_window(np.stack([bounds[:, 0].min(axis=0), bounds[:, 1].max(axis=0)]), self.backdrop)
        if window is None:
            return None
        before, after = first.shifted(window, *middle), second.shifted(window, *middle)
        share = np.float32(weight / _KEY_NS)
        return window, before + share * (after - before)

    def _key(self, k: int) -> tuple[CarrierLayer | None, Array]:
        """Render the carrier, None where it is not visible, and the light (4,) on the board."""
        if k not in self._keys:
            for old in [j for j in self._keys if j < k - 1]:
                del self._keys[old]
            scene = self.scene_at(k * _KEY_NS)
            carrier = render_carrier(scene, self.backdrop, self.lens.blur_px)
            self._keys[k] = carrier, _light_on_board(scene, self.backdrop)
        return self._keys[k]


def film(view: MovingView, camera: EventCamera, start_ns: int, end_ns: int) -> None:
    """Feed an event camera the motion after start_ns, which it has seen already, up to end_ns.

    The steps are short enough that an edge crosses no more than a part of a pixel in each.
    """
    t_ns = start_ns
    while t_ns < end_ns:
        t_ns = min(t_ns + view.step_ns(t_ns), end_ns)
        camera.see(view.at(t_ns), t_ns)


def speed_px_s(trajectory: Trajectory, board: Board, backdrop: Backdrop, t_ns: int) -> float:
    """Measure how fast the board's outline moves through the image at most."""
    step_ns = 1_000_000
    outlines = transform(trajectory.at(np.array([t_ns, t_ns + step_ns])), board.outline())
    pixels, is_valid = backdrop.intrinsics.project(transform(invert(backdrop.T_world_cam), outlines))
    way_px = np.linalg.norm(pixels[1] - pixels[0], axis=-1)[is_valid.all(axis=0)]
    return float(way_px.max(initial=0.0)) / (1e-9 * step_ns)


def _light_on_board(scene: Scene, backdrop: Backdrop) -> Array:
    """Fit light = a + b x + c y + d x y over the side of the board that the camera sees, unshadowed."""
    x, y = (
        grid.ravel()
        for grid in np.meshgrid(
            *(np.linspace(-0.5, 0.5, 3) * s for s in (scene.board.width_m, scene.board.height_m))
        )
    )
    points = transform(scene.T_world_board, np.stack([x, y, np.zeros(9)], axis=1))
    side = np.sign((backdrop.origin - scene.T_world_board[:3, 3]) @ scene.T_world_board[:3, 2])
    normals = np.tile(side * scene.T_world_board[:3, 2], (9, 1))
    light = irradiance(backdrop.lamps, points, normals) @ GREY
    terms = np.stack([np.ones(9), x, y, x * y], axis=1)
    return np.asarray(np.linalg.lstsq(terms, light, rcond=None)[0])


def _slope(values: Float) -> Float:
    """Measure |gradient| (h, w) of an image, per px."""
    down, across = np.empty_like(values), np.empty_like(values)
    if min(values.shape) < 3:
        return np.zeros_like(values)
    down[1:-1], across[:, 1:-1] = values[2:] - values[:-2], values[:, 2:] - values[:, :-2]
    down[0], down[-1], across[:, 0], across[:, -1] = down[1], down[-2], across[:, 1], across[:, -2]
    return np.asarray(np.float32(0.5) * np.sqrt(down * down + across * across))


def _smooth_step(distance: Float, sigma: Float) -> Float:
    """Integrate a parabolic kernel of deviation sigma from -inf to distance: 0..1.

    The kernel 3/(4h) (1 - (d/h)^2) on |d| < h has the variance h^2 / 5.
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        d = np.clip(distance / (np.float32(np.sqrt(5)) * sigma), -1, 1)
    return np.asarray(np.float32(0.5) + d * (np.float32(0.75) - np.float32(0.25) * d * d))


def _inside(half: float, place: Float, sigma: Float) -> Float:
    """Compute how much of each pixel lies within +-half of a place: 0..1."""
    return _smooth_step(np.float32(half) - np.abs(place), sigma)
