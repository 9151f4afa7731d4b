"""The cameras and the cloud in 3D."""

import cv2
import numpy as np
import pytest

from lce_rig.core.camera import Intrinsics
from lce_rig.core.errors import SourceError
from lce_rig.core.geometry import exp_so3, pose, transform
from lce_rig.show.overlays.view_3d import CameraIn3D, CaptureIn3D, draw_picture, show_window

# The camera looks along the LiDAR's x axis.
FORWARD = pose(np.array([[0.0, -1, 0], [0, 0, -1], [1, 0, 0]]), np.array([0.1, -0.05, 0.0]))
LENS = Intrinsics(300.0, 300.0, 159.5, 119.5, 320, 240)


def _wall():
    y, z = np.meshgrid(np.linspace(-1, 1, 200), np.linspace(-1, 1, 200))
    points = np.stack([np.full(y.size, 2.0), y.ravel(), z.ravel()], axis=1).astype(np.float32)
    return CaptureIn3D("000000", points, np.full((y.size, 3), (255, 0, 0), np.uint8), points[:, 1] > 0)


@pytest.mark.parametrize("model", ["radtan", "equidistant"])
def test_a_frustum_projects_onto_the_image_s_corners(model):
    lens = Intrinsics(300.0, 300.0, 159.5, 119.5, 320, 240, model, (0.01, 0.0, 0.0, 0.0))
    T = pose(exp_so3(np.array([0.1, 0.2, -0.3])), np.array([0.1, 0.2, 0.3])) @ FORWARD
    corners, edges = CameraIn3D(lens, T).frustum()
    pixels, _ = lens.project(transform(T, corners[1:]))
    assert pixels == pytest.approx(np.array([[0, 0], [319, 0], [0, 239], [319, 239]]), abs=1e-3)
    assert transform(T, corners[:1]) == pytest.approx(np.zeros((1, 3)), abs=1e-12)
    assert edges.shape == (8, 2) and edges.max() == 4


def test_view_without_display_is_an_error(monkeypatch):
    monkeypatch.setattr("sys.platform", "linux")
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    with pytest.raises(SourceError) as raised:
        show_window([_wall()], [CameraIn3D(LENS, FORWARD)])
    assert raised.value.exit_code == 5 and "--output" in raised.value.hint


@pytest.mark.long
def test_view_unseen_points_are_grey(tmp_path):
    path = tmp_path / "view.png"
    try:
        draw_picture(path, _wall(), [CameraIn3D(LENS, FORWARD)])
    except SourceError as error:
        pytest.skip(str(error))
    picture = cv2.imread(str(path)).astype(int)
    is_red = (picture[..., 2] > 200) & (picture[..., 1] < 60)
    is_grey = (np.ptp(picture, axis=2) < 25) & (picture.mean(axis=2) > 90)
    # +y of the LiDAR is to the left of a camera that looks along x.
    assert is_red.sum() > 5000 and is_grey.sum() > 5000
    assert np.nonzero(is_red)[1].mean() < np.nonzero(is_grey)[1].mean()
