"""Images for event pixels agree in geometry and brightness with rendered images."""

import numpy as np
import pytest

from lce_rig.core.geometry import invert, transform
from lce_rig.simulate.image_rendering import render_radiance
from lce_rig.simulate.placements import hold_board
from lce_rig.simulate.scene import Scene
from lce_rig.simulate.subframes import GREY, MovingView

from .conftest import PERFECT, render_image
from .test_camera import PLACEMENTS, refined

T_NS = 1_700_000_000_123_000_000


def view_and_scene(room, board, backdrop, T_world_board):
    view = MovingView(backdrop, board, hold_board(T_world_board), PERFECT)
    return view, Scene(room.raycaster, (), board, T_world_board)


@pytest.mark.parametrize("T_world_board", PLACEMENTS, ids=["near", "middle", "side"])
def test_corners_agree_with_truth_and_images(room, board, backdrop, T_world_board):
    view, scene = view_and_scene(room, board, backdrop, T_world_board)
    seen = view.at(T_NS)
    subframe = np.rint(255 * np.clip(seen, 0, 1) ** (1 / 2.2)).astype(np.uint8)
    picture = render_image(scene, backdrop, PERFECT, np.random.default_rng(0)).grey
    corners_cam = transform(invert(backdrop.T_world_cam) @ T_world_board, board.corners())
    truth, _ = backdrop.intrinsics.project(corners_cam)
    in_subframe, in_picture = refined(subframe, truth), refined(picture, truth)
    assert np.sqrt(np.mean((in_subframe - truth) ** 2)) < 0.04
    assert np.abs(in_subframe - in_picture).max() < 0.1


def test_board_is_as_bright_as_in_images(room, board, backdrop):
    import cv2

    view, scene = view_and_scene(room, board, backdrop, PLACEMENTS[0])
    radiance = (render_radiance(scene, backdrop) @ GREY).astype(np.float32)
    expected = cv2.GaussianBlur(radiance, (0, 0), PERFECT.blur_px)
    error = np.abs(view.at(T_NS) - expected)
    assert np.mean(error > 0.1) < 0.001
    T_cam_board = invert(backdrop.T_world_cam) @ PLACEMENTS[0]
    pixels, _ = backdrop.intrinsics.project(transform(T_cam_board, board.corners()))
    (u0, v0), (u1, v1) = pixels.min(axis=0).astype(int), pixels.max(axis=0).astype(int)
    assert np.median(error[v0:v1, u0:u1]) < 0.02
