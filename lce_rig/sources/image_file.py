"""Pictures from files, as they were taken: no rotation by EXIF, no colour management."""

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lce_rig.core.errors import SourceError

SUFFIXES = frozenset({".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".pgm", ".ppm", ".webp"})


def read_image(path: Path) -> NDArray[np.uint8]:
    """Read a picture.

    Returns:
        (H, W) grey or (H, W, 3) BGR.

    Raises:
        SourceError: the file is missing, empty, truncated or no picture.
    """
    try:
        return decode_image(path.read_bytes())
    except OSError as error:
        raise SourceError(f"{path}: cannot be read: {error.strerror}") from None
    except ValueError as error:
        raise SourceError(f"{path}: {error}") from None


def decode_image(data: bytes) -> NDArray[np.uint8]:
    """Decode a PNG, JPEG or other picture file held in memory.

    Raises:
        ValueError: what is wrong with it.
    """
    import cv2

    if not data:
        raise ValueError("it is empty")
    # Older OpenCV fills what is missing from a torn JPEG or PNG with grey and says nothing.
    if data.startswith(b"\x89PNG") and b"IEND" not in data[-64:]:
        raise ValueError("it is a truncated PNG picture")
    if data.startswith(b"\xff\xd8") and b"\xff\xd9" not in data[-1024:]:
        raise ValueError("it is a truncated JPEG picture")
    flags = cv2.IMREAD_ANYCOLOR | cv2.IMREAD_ANYDEPTH | cv2.IMREAD_IGNORE_ORIENTATION
    try:
        pixels = cv2.imdecode(np.frombuffer(data, dtype=np.uint8), flags)
    except cv2.error:
        pixels = None
    if pixels is None:
        raise ValueError("it is damaged, or no picture this program reads")
    return to_8_bit(pixels)


def to_8_bit(pixels: NDArray[Any]) -> NDArray[np.uint8]:
    """Bring pixels to 8 bits; deeper ones are stretched by their darkest and brightest percent.

    Twelve-bit sensors leave the upper bits of 16 empty: a plain shift would give black pictures.

    Raises:
        ValueError: pixels of a kind no camera delivers.
    """
    if pixels.dtype == np.uint8:
        return np.ascontiguousarray(pixels)
    if pixels.dtype not in (np.uint16, np.float32):
        raise ValueError(f"its pixels are {pixels.dtype}, not 8 or 16 bit")
    low, high = np.nanpercentile(pixels, (1, 99))
    scaled = (pixels.astype(np.float32) - low) * (255.0 / max(float(high - low), 1e-6))
    return np.asarray(np.clip(np.nan_to_num(np.rint(scaled)), 0, 255), dtype=np.uint8)
