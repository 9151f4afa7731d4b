"""Pixel formats of cameras, by their four-character codes, as BGR or grey images.

References:
    https://docs.kernel.org/userspace-api/media/v4l/pixfmt.html
"""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from lce_rig.io.decoding import decode_image

Pixels = NDArray[np.uint8]


class PixelFormat(NamedTuple):
    """Layout of an image in memory.

    Attributes:
        n_channels: values per pixel in a row; 0 for JPEG files.
        bits: bits of a value; above 8 it takes two bytes, low byte first.
        conversion: name of OpenCV's conversion to BGR; "" if not needed.
    """

    n_channels: int
    bits: int = 8
    conversion: str = ""

    @property
    def is_compressed(self) -> bool:
        """Whether images are JPEG files of any length."""
        return self.n_channels == 0

    def row_bytes(self, width: int) -> int:
        """Return the length of a row without padding."""
        return width * self.n_channels * (2 if self.bits > 8 else 1)


FORMATS = {
    "GREY": PixelFormat(1),
    "Y10 ": PixelFormat(1, 10),
    "Y12 ": PixelFormat(1, 12),
    "Y16 ": PixelFormat(1, 16),
    "UYVY": PixelFormat(2, 8, "COLOR_YUV2BGR_UYVY"),
    "YUYV": PixelFormat(2, 8, "COLOR_YUV2BGR_YUY2"),
    "BGR3": PixelFormat(3),
    "RGB3": PixelFormat(3, 8, "COLOR_RGB2BGR"),
    "BGR4": PixelFormat(4, 8, "COLOR_BGRA2BGR"),
    # OpenCV's newer names of the mosaics begin, like these codes, with the image's first row.
    **{
        code: PixelFormat(1, bits, f"COLOR_Bayer{mosaic}2BGR")
        for mosaic, codes in {
            "RGGB": ("RGGB", "RG10", "RG12"),
            "GRBG": ("GRBG", "BA10", "BA12"),
            "GBRG": ("GBRG", "GB10", "GB12"),
            "BGGR": ("BA81", "BG10", "BG12"),
        }.items()
        for code, bits in zip(codes, (8, 10, 12), strict=True)
    },
    "MJPG": PixelFormat(0),
    "JPEG": PixelFormat(0),
}
"""Formats by four-character code, padded with blanks as in the kernel."""


def find_format(name: str) -> str | None:
    """Find the code of a pixel format; None if not supported."""
    code = name.strip().upper().ljust(4)
    return code if code in FORMATS else None


class PixelDecoder:
    """Decodes images from the bytes of one stream.

    Args:
        code: one of FORMATS.
        width, height: px.
        stride: bytes from row to row; 0 if there is no padding.

    Attributes:
        n_bytes: least number of bytes of a whole image; 1 for compressed ones.
    """

    def __init__(self, code: str, width: int, height: int, stride: int = 0) -> None:
        import cv2  # takes a second, so not when the first image arrives

        self.code = code
        self._cv2 = cv2
        self._form = FORMATS[code]
        self._conversion: int = getattr(cv2, self._form.conversion) if self._form.conversion else -1
        self._size = width, height
        row = self._form.row_bytes(width)
        self._stride = max(stride, row)
        self._is_high_aligned = False
        self.n_bytes = 1 if self._form.is_compressed else self._stride * (height - 1) + row

    def decode(self, data: bytes | bytearray | memoryview) -> Pixels:
        """Decode one image.

        Returns:
            (H, W) grey or (H, W, 3) BGR.

        Raises:
            ValueError: the image is torn, damaged or of another size.
        """
        width, height = self._size
        if len(data) < self.n_bytes:
            raise ValueError(f"{len(data)} of the {self.n_bytes} bytes of an image came")
        if self._form.is_compressed:
            pixels = decode_image(bytes(data))
            if pixels.shape[:2] != (height, width):
                raise ValueError(f"it is {pixels.shape[1]}x{pixels.shape[0]} px, not {width}x{height} px")
            return pixels
        kind, n_channels = np.dtype("<u2" if self._form.bits > 8 else "u1"), self._form.n_channels
        strides = self._stride, n_channels * kind.itemsize, kind.itemsize
        values: NDArray[Any] = np.ndarray((height, width, n_channels), kind, data, 0, strides)
        values = values[:, :, 0] if n_channels == 1 else values
        if self._form.bits > 8:
            # Most drivers right-align, Xavier's VI left-aligns; seen once, it stays so in dark images.
            is_high = self._form.bits < 16 and bool(values.max() >> self._form.bits)
            self._is_high_aligned |= is_high
            values = (values >> (8 if self._is_high_aligned else self._form.bits - 8)).astype(np.uint8)
        if not self._form.conversion:
            return np.array(values, dtype=np.uint8)
        return np.asarray(self._cv2.cvtColor(values, self._conversion), dtype=np.uint8)
