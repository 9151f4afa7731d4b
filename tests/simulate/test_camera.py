"""Rendered images agree with the lens model at sub-pixel level, and their noise with its parameters."""

from dataclasses import replace

import numpy as np
import pytest

from lce_rig.core.geometry import exp_so3, invert, pose, transform
from lce_rig.simulate.backdrop import lens_reach, pixel_corner_rays, pixel_rays
from lce_rig.simulate.options import CameraNoise
from lce_rig.simulate.room import build_carrier
from lce_rig.simulate.scene import Scene

from .conftest import FACING_LIDAR, LENSES, PERFECT, render_image


def placed(distance_m, left_m, up_m, tilt_deg, roll_deg):
    turn = exp_so3(np.radians(np.array([[0.6 * tilt_deg, 0.8 * tilt_deg, 0.0], [0.0, 0.0, roll_deg]])))
    return pose(FACING_LIDAR @ turn[0] @ turn[1], np.array([distance_m, left_m, 1.05 + up_m]))


PLACEMENTS = [placed(1.5, 0.1, 0.0, 10, 45), placed(1.9, -0.4, 0.2, -30, 52), placed(2.4, 0.9, -0.2, 35, 38)]


def refined(picture, truth):
    """Find corners (N, 2) px in an image, starting near the true ones."""
    import cv2

    start = truth.astype(np.float32).reshape(-1, 1, 2) + np.float32(0.3)
    return np.asarray(cv2.cornerSubPix(picture, start, (4, 4), (-1, -1), (3, 50, 1e-4)).reshape(-1, 2))


@pytest.mark.parametrize("T_world_board", PLACEMENTS, ids=["near", "middle", "side"])
def test_corners_agree_with_projected_truth(room, board, backdrop, T_world_board):
    scene = Scene(
        room.raycaster,
        build_carrier("stand", board, T_world_board, np.random.default_rng(0)),
        board,
        T_world_board,
    )
    picture = render_image(scene, backdrop, PERFECT, np.random.default_rng(0)).grey
    corners_cam = transform(invert(backdrop.T_world_cam) @ T_world_board, board.corners())
    truth, is_valid = backdrop.intrinsics.project(corners_cam)
    assert is_valid.all()
    error = refined(picture, truth) - truth
    assert np.sqrt(np.mean(error**2)) < 0.04
    assert np.abs(error.mean(axis=0)).max() < 0.02


@pytest.mark.parametrize("model", sorted(LENSES))
def test_rays_through_pixels_project_back_onto_them(model):
    lens = LENSES[model]
    rays = pixel_rays(pixel_corner_rays(lens))
    assert np.isfinite(rays).all()
    v, u = np.mgrid[0 : lens.height_px, 0 : lens.width_px]
    pixels, is_valid = lens.project(rays)
    # Towards the radius where the polynomial folds back no ray is exact; no board is ever placed there.
    offset = (np.stack([u, v], axis=-1) - [lens.cx_px, lens.cy_px]) / [lens.fx_px, lens.fy_px]
    is_valid &= np.linalg.norm(offset, axis=-1) < 0.97 * lens_reach(lens)
    assert is_valid.mean() > 0.8
    assert np.abs(pixels - np.stack([u, v], axis=-1))[is_valid].max() < 2e-3


def test_noise_follows_shot_and_read_noise(room, board, backdrop):
    scene = Scene(room.raycaster, [], board, PLACEMENTS[0])
    noise = CameraNoise(blur_px=0.0, vignetting=0.0)
    clean = replace(noise, full_well_e=float("inf"))
    quiet = render_image(scene, backdrop, clean, np.random.default_rng(0)).pixels.astype(float)
    noisy = render_image(scene, backdrop, noise, np.random.default_rng(1)).pixels.astype(float)
    for tone in (40, 120, 160):
        at = np.abs(quiet - tone) <= 2
        linear = (tone / 255) ** 2.2
        sigma = np.sqrt(linear * noise.full_well_e + noise.read_noise_e**2) / noise.full_well_e
        slope = 255 / 2.2 * linear ** (1 / 2.2 - 1)
        assert at.sum() > 300
        assert (noisy - quiet)[at].std() == pytest.approx(slope * sigma, rel=0.15)
