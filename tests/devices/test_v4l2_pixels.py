"""Pixel formats against the formulas they stand for, with rows of any length."""

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lce_rig.devices.pixel_formats import FORMATS, PixelDecoder
from tests.yuv import to_422

WIDTH, HEIGHT = 22, 12


def smooth_picture(seed=0):
    """A picture (H, W, 3) BGR whose neighbours differ little, so that halved chroma loses little."""
    coarse = np.random.default_rng(seed).uniform(20, 235, (3, 4, 3)).astype(np.float32)
    return cv2.resize(coarse, (WIDTH, HEIGHT), interpolation=cv2.INTER_LINEAR).astype(np.uint8)


def pad(rows, stride):
    """Lay rows (H, n bytes) out at a stride, the gaps filled with what must not be seen."""
    return np.pad(rows, ((0, 0), (0, stride - rows.shape[1])), constant_values=255).tobytes()


def encode(code, bgr, padding):
    """Write a picture in a pixel format; gives the bytes and the stride."""
    height, width = bgr.shape[:2]
    if code in ("UYVY", "YUYV"):
        rows = to_422(bgr, code.lower())
        return pad(rows.reshape(height, -1), 2 * width + padding), 2 * width + padding
    if code in ("BGR3", "RGB3", "BGR4"):
        pixels = bgr if code != "RGB3" else bgr[:, :, ::-1]
        if code == "BGR4":
            pixels = np.dstack((bgr, np.full((height, width), 7, np.uint8)))
        rows = pixels.reshape(height, -1)
        return pad(rows, rows.shape[1] + padding), rows.shape[1] + padding
    raise AssertionError(code)


@pytest.mark.parametrize("code", ["UYVY", "YUYV", "BGR3", "RGB3", "BGR4"])
@pytest.mark.parametrize("padding", [0, 5])
def test_pixel_formats_colour_round_trips(code, padding):
    picture = smooth_picture()
    data, stride = encode(code, picture, padding)
    pixels = PixelDecoder(code, WIDTH, HEIGHT, stride).decode(data)
    is_exact = code in ("BGR3", "RGB3", "BGR4")
    # Chroma of every other pixel: as wrong as neighbours differ.
    step = max(np.abs(np.diff(picture.astype(int), axis=axis)).max() for axis in (0, 1))
    assert np.abs(pixels.astype(int) - picture).max() <= (0 if is_exact else 4 + 2 * step)
    assert np.abs(pixels.astype(float).mean((0, 1)) - picture.mean((0, 1))).max() <= (0 if is_exact else 6)


@pytest.mark.parametrize(
    ("code", "red_at"), [("RGGB", (0, 0)), ("GRBG", (0, 1)), ("GBRG", (1, 0)), ("BA81", (1, 1))]
)
def test_a_mosaic_of_one_colour_gives_that_colour(code, red_at):
    mosaic = np.full((HEIGHT, WIDTH), 120, np.uint8)
    mosaic[red_at[0] :: 2, red_at[1] :: 2] = 200
    mosaic[1 - red_at[0] :: 2, 1 - red_at[1] :: 2] = 40
    pixels = PixelDecoder(code, WIDTH, HEIGHT, WIDTH + 3).decode(pad(mosaic, WIDTH + 3))
    assert (pixels[2:-2, 2:-2] == (40, 120, 200)).all()


@pytest.mark.parametrize(("code", "bits"), [("Y10 ", 10), ("Y12 ", 12), ("Y16 ", 16)])
def test_deep_grey_keeps_its_upper_bits(code, bits):
    grey = np.random.default_rng(1).integers(0, 256, (HEIGHT, WIDTH)).astype(np.uint16)
    data = pad((grey << (bits - 8)).astype("<u2").view(np.uint8), 2 * WIDTH + 6)
    assert (PixelDecoder(code, WIDTH, HEIGHT, 2 * WIDTH + 6).decode(data) == grey).all()


def test_left_aligned_bits_are_detected_once():
    decoder = PixelDecoder("Y12 ", WIDTH, HEIGHT)
    bright, dark = np.full((HEIGHT, WIDTH), 200 << 8, "<u2"), np.full((HEIGHT, WIDTH), 3 << 8, "<u2")
    assert (decoder.decode(bright.tobytes()) == 200).all()
    assert (decoder.decode(dark.tobytes()) == 3).all()


def test_a_jpeg_is_decoded_and_must_have_the_size():
    data = cv2.imencode(".jpg", smooth_picture())[1].tobytes()
    assert PixelDecoder("MJPG", WIDTH, HEIGHT).decode(data).shape == (HEIGHT, WIDTH, 3)
    with pytest.raises(ValueError):
        PixelDecoder("MJPG", WIDTH + 2, HEIGHT).decode(data)
    with pytest.raises(ValueError):
        PixelDecoder("MJPG", WIDTH, HEIGHT).decode(data[:-20])


@given(code=st.sampled_from(sorted(FORMATS)), width=st.integers(1, 20), padding=st.integers(0, 9))
def test_image_needs_exactly_declared_bytes(code, width, padding):
    width, form = 2 * width, FORMATS[code]
    row = width * form.n_channels * (2 if form.bits > 8 else 1)
    decoder = PixelDecoder(code, width, 8, row + 2 * padding)
    if not form.is_compressed:
        pixels = decoder.decode(bytes(decoder.n_bytes))
        assert pixels.shape[:2] == (8, width)
        assert pixels.dtype == np.uint8
    with pytest.raises(ValueError):
        decoder.decode(bytes(decoder.n_bytes - 1))
