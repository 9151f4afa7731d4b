"""Images as the page gets them."""

import cv2
import numpy as np
import pytest

from lce_rig.show.phone.pages import MAX_WIDTH_PX, encode_picture


@pytest.mark.parametrize(
    ("shape", "size"),
    [
        ((720, 1280), (540, 960)),
        ((260, 346), (260, 346)),
        ((2048, 2448, 3), (683, 816)),
        ((1, 5000), (1, 833)),
    ],
)
def test_images_are_reduced_for_a_phone(shape, size):
    pixels = np.zeros(shape, np.uint8)
    pixels[: shape[0] // 2] = 200
    decoded = cv2.imdecode(np.frombuffer(encode_picture(pixels), np.uint8), cv2.IMREAD_GRAYSCALE)
    assert decoded.shape == size
    assert decoded.shape[1] <= MAX_WIDTH_PX
    assert abs(decoded.mean() - pixels.mean()) < 2
