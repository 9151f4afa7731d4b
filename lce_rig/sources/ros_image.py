"""sensor_msgs/Image and CompressedImage as grey or BGR images.

References:
    https://docs.ros.org/en/noetic/api/sensor_msgs/html/image__encodings_8h_source.html
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from lce_rig.core import limits
from lce_rig.sources.image_file import decode_image, to_8_bit

# Encoding: bytes of one channel, channels, name of OpenCV's conversion to BGR ("" where none is needed).
_ENCODINGS = {
    "mono8": (1, 1, ""),
    "8uc1": (1, 1, ""),
    "mono16": (2, 1, ""),
    "16uc1": (2, 1, ""),
    "bgr8": (1, 3, ""),
    "8uc3": (1, 3, ""),
    "bgr16": (2, 3, ""),
    "rgb8": (1, 3, "COLOR_RGB2BGR"),
    "rgb16": (2, 3, "COLOR_RGB2BGR"),
    "bgra8": (1, 4, "COLOR_BGRA2BGR"),
    "8uc4": (1, 4, "COLOR_BGRA2BGR"),
    "rgba8": (1, 4, "COLOR_RGBA2BGR"),
    "yuv422": (1, 2, "COLOR_YUV2BGR_UYVY"),
    "uyvy": (1, 2, "COLOR_YUV2BGR_UYVY"),
    "yuv422_yuy2": (1, 2, "COLOR_YUV2BGR_YUY2"),
    "yuyv": (1, 2, "COLOR_YUV2BGR_YUY2"),
    **{f"bayer_{m}8": (1, 1, f"COLOR_Bayer{m.upper()}2BGR") for m in ("rggb", "bggr", "gbrg", "grbg")},
    **{f"bayer_{m}16": (2, 1, f"COLOR_Bayer{m.upper()}2BGR") for m in ("rggb", "bggr", "gbrg", "grbg")},
}


def decode_ros_image(message: Any) -> NDArray[np.uint8]:
    """Decode sensor_msgs/Image.

    Returns:
        (H, W) grey or (H, W, 3) BGR.

    Raises:
        ValueError: an unknown encoding, or sizes that contradict each other.
    """
    encoding = str(message.encoding).lower()
    if encoding not in _ENCODINGS:
        raise ValueError(f"its encoding {message.encoding!r} is not known; known are {', '.join(_ENCODINGS)}")
    n_bytes, n_channels, conversion = _ENCODINGS[encoding]
    width, height = int(message.width), int(message.height)
    if width * height > limits.MAX_PIXELS:
        raise ValueError(f"it declares {width}x{height} pixels, at most {limits.MAX_PIXELS} are read")
    n_row = width * n_channels * n_bytes
    step = int(message.step) or n_row
    data = np.ascontiguousarray(message.data, dtype=np.uint8)
    if width * height == 0 or step < n_row or len(data) < (height - 1) * step + n_row:
        raise ValueError(
            f"{len(data)} bytes are no {width}x{height} picture in {encoding} with rows of {step} bytes"
        )
    kind = np.dtype(f"{'>' if message.is_bigendian else '<'}u{n_bytes}")
    rows = np.ndarray((height, width, n_channels), kind, data.data, 0, (step, n_channels * n_bytes, n_bytes))
    pixels = rows[:, :, 0] if n_channels == 1 else rows
    return _convert(to_8_bit(pixels.astype(kind.newbyteorder("="))), conversion)


def decode_ros_compressed_image(message: Any) -> NDArray[np.uint8]:
    """Decode sensor_msgs/CompressedImage.

    Returns:
        (H, W) grey or (H, W, 3) BGR.

    Raises:
        ValueError: it is damaged, or no image.
    """
    form = str(message.format).lower()
    if "compresseddepth" in form:
        raise ValueError("it is a depth image, not a picture")
    pixels = decode_image(bytes(message.data))
    mosaic = form.split(";")[0].strip()
    # A camera's raw mosaic may have been compressed as if it were grey.
    if mosaic.startswith("bayer_") and mosaic in _ENCODINGS and pixels.ndim == 2:
        return _convert(pixels, _ENCODINGS[mosaic][2])
    return pixels


def _convert(pixels: NDArray[np.uint8], conversion: str) -> NDArray[np.uint8]:
    if not conversion:
        return pixels
    import cv2

    return np.asarray(cv2.cvtColor(pixels, getattr(cv2, conversion)), dtype=np.uint8)
