"""Thumbnails on the page: small for any image, outline on the board, largest residuals first."""

import base64
import re
from dataclasses import replace

import cv2
import numpy as np
import pytest

from lce_rig.show.overlays.canvas import Thumbnail, reduced
from lce_rig.show.report.calibration_page import data_uri, worst_first
from tests.show.report.conftest import RLFS


def decoded(uri):
    return cv2.imdecode(np.frombuffer(base64.b64decode(uri.partition(",")[2]), np.uint8), cv2.IMREAD_COLOR)


@pytest.mark.parametrize("shape", [(1200, 1920, 3), (260, 346), (3000, 200), (40, 30)])
def test_a_picture_is_small_and_of_its_image_s_shape(shape):
    pixels = np.random.default_rng(0).integers(0, 256, shape, dtype=np.uint8)
    uri = data_uri(reduced(pixels), np.array([[np.nan, 1.0], [1e9, -1e9]]))
    height, width = decoded(uri).shape[:2]
    assert max(height, width) <= 320
    assert width / height == pytest.approx(shape[1] / shape[0], rel=0.05)


def test_outline_agrees_with_the_board():
    square = np.array([[400.0, 200.0], [800.0, 200.0], [800.0, 500.0], [400.0, 500.0]])
    drawn = decoded(data_uri(reduced(np.zeros((720, 1280, 3), np.uint8)), square)).astype(int)
    v, u = np.nonzero(drawn.sum(axis=2) > 150)
    assert (u.min(), v.min(), u.max(), v.max()) == pytest.approx((100, 50, 200, 125), abs=3)


def test_the_capture_that_stands_out_comes_first():
    order = worst_first([0.004, 0.005, 0.006, float("nan")], [0.01, 0.05, 0.01, 0.01])
    assert order[0][0] == 1 and order[0][1] == pytest.approx(5.0)
    assert sorted(k for k, _ in order) == [0, 1, 2, 3]
    assert worst_first([], []) == []


def test_page_shows_captures_and_the_worst(one, page):
    residuals = list(one.residuals)
    residuals[3] = residuals[3]._replace(plane_mean_m=0.2)
    text = page(RLFS, replace(one, residuals=tuple(residuals)))
    shown = re.findall(r'alt="Capture ([^"]+)"', text)
    assert sorted(shown) == sorted(r.capture for r in residuals)
    assert shown[0] == residuals[3].capture
    assert f"--without {shown[0]}" in text
    assert text.count("data:image/jpeg") == len(residuals)


def test_known_thumbnails_replace_their_images_only(one, page):
    name = one.residuals[0].capture
    known = {(name, "cam", "frames"): Thumbnail(np.zeros((90, 160, 3), np.uint8), 1280)}
    shown, decoded_anew = (
        {capture: uri for uri, capture in re.findall(r'src="(data:[^"]+)" alt="Capture ([^"]+)"', text)}
        for text in (page(RLFS, one, thumbnails=known), page(RLFS, one))
    )
    assert decoded(shown.pop(name)).shape == (90, 160, 3)
    assert decoded(decoded_anew.pop(name)).shape != (90, 160, 3)
    assert shown == decoded_anew
