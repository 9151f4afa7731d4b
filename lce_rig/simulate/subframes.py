"""Grey images of the moving board: hundreds per second, smooth enough for event pixels.

`render_radiance` draws single images with shadows on the board, and its carrier. Here the room is one fixed
image, and the board alone is drawn in it, analytically. Edges are smoothed by their distance in units of the
pixel's own spread, not by sampling: intensities change without steps as the board moves.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lce_rig.core.board import Board
from lce_rig.core.geometry import Array, invert, transform
from lce_rig.core.pattern import is_dark
from lce_rig.simulate.backdrop import Backdrop, irradiance, pixel_rays
from lce_rig.simulate.event_camera import EventCamera
from lce_rig.simulate.image_rendering import sensor_gain
from lce_rig.simulate.options import CameraNoise
from lce_rig.simulate.placements import Trajectory
from lce_rig.simulate.scene import INK, PLATE, PLATE_BACK

GREY = np.array([0.114, 0.587, 0.299])
"""Weights of blue, green and red in a grey value (ITU-R BT.601), as OpenCV's."""
Window = tuple[slice, slice]
Float = NDArray[np.float32]
# Motion of the board between sub-frames, px, as long as their interval is within `_STEP_NS`: below a pixel,
# so that edges cross each one gradually.
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
        trajectory: poses of the board over time.
        lens: the camera's errors; blur and vignetting count.
    """

    backdrop: Backdrop
    board: Board
    trajectory: Trajectory
    lens: CameraNoise

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
        outline = transform(T_world_board, self.board.outline())
        edges = ((1 - _ALONG) * outline + _ALONG * np.roll(outline, -1, axis=0)).reshape(-1, 3)
        window = _window(edges, self.backdrop)
        if window is not None:
            radiance, cover = self._board(window, T_world_board)
            seen[window] += cover * (radiance - seen[window])
        return np.asarray(seen * self._gain)

    def step_ns(self, t_ns: int) -> int:
        """Choose how long after t_ns the next sub-frame is due."""
        speed = speed_px_s(self.trajectory, self.board, self.backdrop, t_ns)
        return int(np.clip(1e9 * _STEP_PX / max(speed, 1e-3), *_STEP_NS))

    def _board(self, window: Window, T_world_board: Array) -> tuple[Float, Float]:
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
        light = _light_on_board(self.board, T_world_board, self.backdrop)
        shade = light[0] + light[1] * x + light[2] * y + light[3] * x * y
        if eye[2] > 0:
            white, ink = (np.float32(np.dot(GREY, colour)) for colour in (PLATE.colour, INK.colour))
            shade *= white + (ink - white) * self._print(x, y, spread_x, spread_y)
        else:
            shade *= np.float32(np.dot(GREY, PLATE_BACK.colour))
        return np.nan_to_num(shade.astype(np.float32)), np.nan_to_num(cover)

    def _print(self, x: Float, y: Float, spread_x: Float, spread_y: Float) -> Float:
        """Compute the inked share (h, w) of each pixel.

        Along each axis the squares are a wave of +-1, smoothed at its sign changes; the pattern is dark where
        both waves have the same sign. For a smoothing that is round in the image, their product equals the
        smoothed pattern, unless the board is seen at a grazing angle.
        """
        board, offset_m = self.board, self.board.pattern_offset_m
        if board.has_markers:
            # Markers are no product of waves: average points over the kernel's width.
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


def film(view: MovingView, camera: EventCamera, start_ns: int, end_ns: int) -> None:
    """Feed the motion after start_ns, up to end_ns, to an event camera.

    The steps are so short that edges move by a fraction of a pixel in each.
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


def _window(points: Array, backdrop: Backdrop) -> Window | None:
    """Bound the pixels of points (N, 3), world, with a margin; None if they are outside the image."""
    pixels, is_valid = backdrop.intrinsics.project(transform(invert(backdrop.T_world_cam), points))
    if not is_valid.any():
        return None
    height, width = backdrop.range_m.shape
    bounds = np.stack([pixels[is_valid].min(axis=0) - 4, pixels[is_valid].max(axis=0) + 5])
    (u0, v0), (u1, v1) = np.clip(np.rint(bounds), 0, [width, height]).astype(int)
    return (slice(int(v0), int(v1)), slice(int(u0), int(u1))) if u1 > u0 and v1 > v0 else None


def _light_on_board(board: Board, T_world_board: Array, backdrop: Backdrop) -> Array:
    """Fit light = a + b x + c y + d x y over the side of the board that the camera sees, unshadowed."""
    x, y = (
        grid.ravel()
        for grid in np.meshgrid(*(np.linspace(-0.5, 0.5, 3) * s for s in (board.width_m, board.height_m)))
    )
    points = transform(T_world_board, np.stack([x, y, np.zeros(9)], axis=1))
    side = np.sign((backdrop.origin - T_world_board[:3, 3]) @ T_world_board[:3, 2])
    light = irradiance(backdrop.lamps, points, np.tile(side * T_world_board[:3, 2], (9, 1))) @ GREY
    terms = np.stack([np.ones(9), x, y, x * y], axis=1)
    return np.asarray(np.linalg.lstsq(terms, light, rcond=None)[0], dtype=np.float32)


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
