"""Camera models: pixels, rays and the range in which both hold."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lce_rig.core.camera import Intrinsics

PINHOLE = Intrinsics(640.5, 640.5, 640.5, 360.5, 1280, 720)
RADTAN = Intrinsics(
    897.4566, 896.7992, 635.4040, 375.3149, 1280, 720, "radtan", (-0.4398, 0.2329, -0.0011, 0.00021, -0.073)
)
FISHEYE = Intrinsics(
    1176.93, 1177.72, 962.275, 612.725, 1920, 1208, "equidistant", (-0.054, -0.0784, 0.096, -0.0515)
)
CAMERAS = pytest.mark.parametrize("camera", [PINHOLE, RADTAN, FISHEYE], ids=["pinhole", "radtan", "fisheye"])


@CAMERAS
@given(st.floats(0.12, 0.88), st.floats(0.12, 0.88), st.floats(0.3, 30.0))
def test_projecting_a_pixels_ray_gives_the_pixel(camera, u, v, distance_m):
    # Without the border: this radtan polynomial folds before the image's corners.
    pixel = np.array([u * (camera.width_px - 1), v * (camera.height_px - 1)])
    projected, is_valid = camera.project(camera.unproject(pixel) * distance_m)
    assert is_valid
    np.testing.assert_allclose(projected, pixel, atol=1e-4)


@pytest.mark.parametrize("camera", [RADTAN, FISHEYE], ids=["radtan", "fisheye"])
def test_projection_agrees_with_opencv(camera):
    import cv2

    rng = np.random.default_rng(0)
    points = np.column_stack([rng.uniform(-0.5, 0.5, (50, 2)), np.ones(50)]) * rng.uniform(1, 5, (50, 1))
    D = np.array(camera.distortion)
    zero = np.zeros(3)
    if camera.model == "radtan":
        expected = cv2.projectPoints(points, zero, zero, camera.matrix, D)[0]
    else:
        expected = cv2.fisheye.projectPoints(points[:, None], zero, zero, camera.matrix, D)[0]
    np.testing.assert_allclose(camera.project(points)[0], expected.reshape(-1, 2), atol=1e-6)


@CAMERAS
def test_points_behind_camera_are_not_projected(camera):
    pixels, is_valid = camera.project(np.array([[0.1, 0.2, -2.0], [0.0, 0.0, -1e-9], [0.0, 0.0, 2.0]]))
    assert is_valid.tolist() == [False, False, True]
    assert np.isnan(pixels[:2]).all()


def test_camera_folded_points_are_excluded():
    import cv2

    outside = np.array([[3.0, 0.3, 1.0]])
    D = np.array([-0.4398, 0.2329, 0, 0, -0.25])
    camera = Intrinsics(897.0, 897.0, 635.0, 375.0, 1280, 720, "radtan", tuple(D))
    folded = cv2.projectPoints(outside, np.zeros(3), np.zeros(3), camera.matrix, D)[0]
    assert not camera.project(outside)[1][0], folded
    near_the_fold = camera.max_radius - 1e-3
    assert camera.project(np.array([[near_the_fold, 0, 1.0]]))[1][0]


def test_unreachable_pixel_has_no_ray():
    camera = Intrinsics(500.0, 500.0, 320.0, 240.0, 640, 480, "radtan", (-0.5,))
    assert np.isnan(camera.unproject(np.array([3000.0, 240.0]))).all()
    assert np.isfinite(camera.unproject(np.array([320.0, 240.0]))).all()


def test_is_inside_respects_margin():
    pixels = np.array([[0.0, 0.0], [1279.0, 719.0], [1279.5, 3.0], [5.0, 5.0], [np.nan, 3.0]])
    assert PINHOLE.is_inside(pixels).tolist() == [True, True, False, True, False]
    assert PINHOLE.is_inside(pixels, margin_px=5).tolist() == [False, False, False, True, False]


RATIONAL = Intrinsics(
    900.0, 905.0, 640.0, 360.0, 1280, 720, "radtan", (0.3, -0.1, 1e-3, -5e-4, 0.02, 0.6, -0.05, 0.01)
)


@pytest.mark.parametrize("camera", [PINHOLE, RADTAN, FISHEYE, RATIONAL])
def test_projection_derivative_matches_differences(camera):
    rng = np.random.default_rng(1)
    points = np.column_stack([rng.uniform(-0.4, 0.4, (50, 2)), np.ones(50)]) * rng.uniform(1, 5, (50, 1))
    points[0, :2] = 0.0
    step = 1e-5 * np.eye(3)
    differences = [(camera.project(points + h)[0] - camera.project(points - h)[0]) / 2e-5 for h in step]
    np.testing.assert_allclose(
        camera.differentiate(points), np.stack(differences, axis=-1), rtol=1e-5, atol=1e-4
    )
