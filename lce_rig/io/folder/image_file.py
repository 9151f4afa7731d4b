"""Images from files, unchanged: no rotation by EXIF, no colour management."""

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lce_rig.core.errors import reading
from lce_rig.core.image_codec import decode_pixels

SUFFIXES = frozenset({".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".pgm", ".ppm", ".webp"})

_MAX_SAMPLED = 1 << 24


def read_image(path: Path) -> NDArray[np.uint8]:
    """Read an image.

    Returns:
        (H, W) grey or (H, W, 3) BGR.

    Raises:
        SourceError: the file is missing, empty, truncated or no image.
    """
    with reading(path):
        return decode_image(path.read_bytes())


def decode_image(data: bytes) -> NDArray[np.uint8]:
    """Decode a PNG, JPEG or other image file held in memory.

    Raises:
        ValueError: what is wrong with it.
    """
    import cv2

    flags = cv2.IMREAD_ANYCOLOR | cv2.IMREAD_ANYDEPTH | cv2.IMREAD_IGNORE_ORIENTATION
    return to_8_bit(decode_pixels(data, flags))


@np.errstate(invalid="ignore")  # of signalling NaN
def to_8_bit(pixels: NDArray[Any]) -> NDArray[np.uint8]:
    """Bring pixels to 8 bits; deeper ones are stretched by their darkest and brightest percent.

    Twelve-bit sensors leave the upper bits of 16 empty: a plain shift would give black images.

    Raises:
        ValueError: pixels of a kind no camera delivers.
    """
    if pixels.dtype == np.uint8:
        return np.ascontiguousarray(pixels)
    if pixels.dtype not in (np.uint16, np.float32):
        raise ValueError(f"its pixels are {pixels.dtype}, not 8 or 16 bit")
    # Every k-th pixel has the same shares, and no copies of a large image are made.
    sample = pixels.ravel()[:: 1 + pixels.size // _MAX_SAMPLED].astype(np.float64)
    sample = sample[np.isfinite(sample)]
    if not len(sample):
        raise ValueError("none of its pixels is finite")
    low, high = np.percentile(sample, (1, 99))
    stretched = np.empty(pixels.shape, dtype=np.uint8)
    for row, values in zip(stretched, pixels, strict=True):
        scaled = (values.astype(np.float64) - low) * (255.0 / max(float(high - low), 1e-6))
        row[...] = np.nan_to_num(np.clip(np.rint(scaled), 0, 255))
    return stretched
