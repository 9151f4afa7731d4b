"""Boards of any pattern rendered before a camera, with exact truth."""

import cv2
import numpy as np

from lce_rig.core.board import Board
from lce_rig.core.camera import Intrinsics
from lce_rig.core.data import Image
from lce_rig.core.geometry import exp_so3, pose, transform
from lce_rig.core.pattern import is_dark

ASYMMETRIC = Board(cols=9, rows=6, square_m=0.068, width_m=0.8, height_m=0.6)
SYMMETRIC = Board(cols=8, rows=6, square_m=0.07, width_m=0.767, height_m=0.626)
TALL = Board(cols=5, rows=7, square_m=0.095, width_m=0.61, height_m=0.85, pattern_offset_m=(0.002, 0.0))
DAVIS = Intrinsics(349.57, 349.18, 172.49, 126.24, 346, 260, "radtan", (-0.365, 0.1836, 0.0007, 0.0001, 0.0))
WIDE = Intrinsics(897.5, 896.8, 635.4, 375.3, 1280, 720, "radtan", (-0.4398, 0.2329, -0.0011, 0.0002, -0.073))
FISHEYE = Intrinsics(590.0, 590.0, 480.0, 305.0, 960, 604, "equidistant", (-0.054, -0.0784, 0.096, -0.0515))


def looking(tilt_deg, about_deg, roll_deg, centre):
    """Place the board at `centre`; roll 0 shows the pattern upright."""
    about, roll = np.radians([about_deg, roll_deg])
    tilt = exp_so3(np.radians(tilt_deg) * np.array([np.cos(about), np.sin(about), 0.0]))
    upright = np.diag([1.0, -1.0, -1.0]) @ exp_so3(np.array([0.0, 0.0, roll]))
    return pose(tilt @ upright, np.array(centre))


def draw(board, camera, T_cam_board, *, black=40, white=200, blur_px=0.7, noise=2.0, seed=0):
    """Render the board on plain grey, 4 x 4 rays a pixel, with Gaussian blur and noise."""
    n, width, height = 4, camera.width_px, camera.height_px
    outline, _ = camera.project(transform(T_cam_board, board.outline()))
    u0, v0 = np.maximum(np.nanmin(outline, axis=0).astype(int) - 12, 0)
    u1, v1 = np.minimum(np.nanmax(outline, axis=0).astype(int) + 13, [width, height])
    # Rays change smoothly: every fourth is exact, those between are interpolated linearly.
    gu, gv = np.arange(u0 - 1, u1 + 5, 4.0), np.arange(v0 - 1, v1 + 5, 4.0)
    coarse = camera.unproject(np.stack(np.meshgrid(gu, gv), axis=-1))
    R, t = T_cam_board[:3, :3], T_cam_board[:3, 3]
    tables = [coarse @ axis for axis in R.T]

    def look(u, v):
        along_x, along_y, along_z = (_interpolate(k, (u - gu[0]) / 4, (v - gv[0]) / 4) for k in tables)
        distance = (R[:, 2] @ t) / along_z
        x, y = along_x * distance - R[:, 0] @ t, along_y * distance - R[:, 1] @ t
        is_plate = (np.abs(x) < board.width_m / 2) & (np.abs(y) < board.height_m / 2)
        return np.where(is_plate, np.where(is_dark(board, np.stack([x, y], axis=-1)), black, white), 110.0)

    corners = look(np.arange(u0, u1 + 1) - 0.5, (np.arange(v0, v1 + 1) - 0.5)[:, None])
    value = corners[:-1, :-1].copy()
    # Only where a pixel's corners differ does an edge run through it.
    others = corners[1:, :-1], corners[:-1, 1:], corners[1:, 1:]
    j, i = np.nonzero(np.any([value != other for other in others], axis=0))
    off_v, off_u = (each.ravel() / n - 0.5 for each in np.mgrid[:n, :n] + 0.5)
    value[j, i] = look(u0 + i[:, None] + off_u, v0 + j[:, None] + off_v).mean(axis=1)
    picture = np.full((height, width), 110.0)
    picture[v0:v1, u0:u1] = value
    picture = cv2.GaussianBlur(picture, (0, 0), blur_px)
    noisy = picture + np.random.default_rng(seed).normal(0, noise, picture.shape)
    return np.clip(np.rint(noisy), 0, 255).astype(np.uint8)


def _interpolate(table, u, v):
    """Interpolate linearly at columns u and rows v, which are broadcast against each other."""
    # cv2.remap rounds its weights to 1/32; rays need more.
    i, j = np.floor(u).astype(int), np.floor(v).astype(int)
    a, b = u - i, v - j
    above = (1 - a) * table[j, i] + a * table[j, i + 1]
    below = (1 - a) * table[j + 1, i] + a * table[j + 1, i + 1]
    return np.asarray((1 - b) * above + b * below)


def picture(pixels, channel="frames"):
    return Image("cam", channel, None, pixels)
