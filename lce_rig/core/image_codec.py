"""Image files held in memory, decoded by OpenCV."""

from typing import Any

import numpy as np
from numpy.typing import NDArray


def decode_pixels(data: bytes, flags: int) -> NDArray[Any]:
    """Decode a PNG, JPEG, BMP, TIFF, PNM or WebP image.

    OpenCV refuses images of more than OPENCV_IO_MAX_IMAGE_PIXELS (`lce_rig/__init__.py`).

    Args:
        data: the file's bytes.
        flags: OpenCV's, of `imdecode`.

    Returns:
        (H, W) or (H, W, C), as OpenCV decodes it.

    Raises:
        ValueError: it is truncated, damaged, or no image.
    """
    import cv2

    if not data:
        raise ValueError("it is empty")
    # Older OpenCV fills the missing part of a torn JPEG or PNG with grey, without an error.
    if data.startswith(b"\x89PNG") and b"IEND" not in data[-64:]:
        raise ValueError("it is a truncated PNG image")
    if data.startswith(b"\xff\xd8") and b"\xff\xd9" not in data[-1024:]:
        raise ValueError("it is a truncated JPEG image")
    try:
        pixels = cv2.imdecode(np.frombuffer(data, dtype=np.uint8), flags)
    except cv2.error:
        pixels = None
    if pixels is None:
        raise ValueError("it is damaged, too large, or no image that lce-rig reads")
    return np.asarray(pixels)
