"""Pixel formats of cameras, by their four-character codes, as BGR or grey images.

References:
    https://docs.kernel.org/userspace-api/media/v4l/pixfmt.html
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lce_rig.io.folder.image_file import decode_image

Pixels = NDArray[np.uint8]


@dataclass(frozen=True)
class PixelFormat:
    """How an image lies in memory.

    Attributes:
        n_channels: values per pixel in a row; 1 for the planes of 4:2:0.
        bits: of a value; above 8 it lies in two bytes, little end first.
        conversion: name of OpenCV's conversion to BGR; "" where none is needed.
        n_chroma_planes: planes of quarter size behind the first: 2 apart, 1 with both in turn; 0 without.
        is_split: whether a device hands each plane over in memory of its own.
    """

    n_channels: int
    bits: int = 8
    conversion: str = ""
    n_chroma_planes: int = 0
    is_split: bool = False

    @property
    def n_memory_planes(self) -> int:
        """How many pieces of memory an image lies in."""
        return 1 + self.n_chroma_planes if self.is_split else 1

    @property
    def is_compressed(self) -> bool:
        """Whether images are JPEG files of any length."""
        return self.n_channels == 0


FORMATS = {
    "GREY": PixelFormat(1),
    "Y10 ": PixelFormat(1, 10),
    "Y12 ": PixelFormat(1, 12),
    "Y16 ": PixelFormat(1, 16),
    "UYVY": PixelFormat(2, 8, "COLOR_YUV2BGR_UYVY"),
    "YUYV": PixelFormat(2, 8, "COLOR_YUV2BGR_YUY2"),
    "YVYU": PixelFormat(2, 8, "COLOR_YUV2BGR_YVYU"),
    "NV12": PixelFormat(1, 8, "COLOR_YUV2BGR_NV12", 1),
    "NV21": PixelFormat(1, 8, "COLOR_YUV2BGR_NV21", 1),
    "YU12": PixelFormat(1, 8, "COLOR_YUV2BGR_I420", 2),
    "YV12": PixelFormat(1, 8, "COLOR_YUV2BGR_YV12", 2),
    "NM12": PixelFormat(1, 8, "COLOR_YUV2BGR_NV12", 1, is_split=True),
    "NM21": PixelFormat(1, 8, "COLOR_YUV2BGR_NV21", 1, is_split=True),
    "YM12": PixelFormat(1, 8, "COLOR_YUV2BGR_I420", 2, is_split=True),
    "YM21": PixelFormat(1, 8, "COLOR_YUV2BGR_YV12", 2, is_split=True),
    "BGR3": PixelFormat(3),
    "RGB3": PixelFormat(3, 8, "COLOR_RGB2BGR"),
    "BGR4": PixelFormat(4, 8, "COLOR_BGRA2BGR"),
    # OpenCV's newer names of the mosaics begin, like these codes, with the image's first row.
    **{
        code: PixelFormat(1, bits, f"COLOR_Bayer{mosaic}2BGR")
        for mosaic, codes in {
            "RGGB": ("RGGB", "RG10", "RG12", "RG16"),
            "GRBG": ("GRBG", "BA10", "BA12", "GR16"),
            "GBRG": ("GBRG", "GB10", "GB12", "GB16"),
            "BGGR": ("BA81", "BG10", "BG12", "BYR2"),
        }.items()
        for code, bits in zip(codes, (8, 10, 12, 16), strict=True)
    },
    "MJPG": PixelFormat(0),
    "JPEG": PixelFormat(0),
}
"""By four-character code, padded with blanks as the kernel does."""

_OTHER_NAMES = {
    "YUY2": "YUYV",
    "Y800": "GREY",
    "Y8": "GREY",
    "I420": "YU12",
    "BGGR": "BA81",
    "BGR": "BGR3",
    "BGR8": "BGR3",
    "RGB": "RGB3",
    "BGRX": "BGR4",
    "BGRA": "BGR4",
    "MJPEG": "MJPG",
}


def find_format(name: str) -> str | None:
    """Find the code of a pixel format by that or by what GStreamer and others call it; None if unknown."""
    code = _OTHER_NAMES.get(name.strip().upper(), name.strip().upper()).ljust(4)
    return code if code in FORMATS else None


class PixelDecoder:
    """Makes images from the bytes of one stream.

    Args:
        code: one of FORMATS.
        width, height: px.
        stride: bytes from row to row; 0 where rows follow each other closely.
    """

    def __init__(self, code: str, width: int, height: int, stride: int = 0) -> None:
        import cv2  # takes a second: now, not when the first image waits to be fetched

        self.code = code
        self._cv2 = cv2
        self._form = FORMATS[code]
        self._conversion: int = getattr(cv2, self._form.conversion) if self._form.conversion else -1
        self._size = width, height
        self._value = np.dtype("<u2" if self._form.bits > 8 else "u1")
        self._row = width * self._form.n_channels * self._value.itemsize
        self._stride = max(stride, self._row)
        self._is_high_aligned = False

    @property
    def n_bytes(self) -> int:
        """Least number of bytes of a whole image; 1 where it is compressed."""
        if self._form.is_compressed:
            return 1
        height = self._size[1]
        if self._form.n_chroma_planes:
            return self._stride * height + self._chroma_stride * (height // 2) * self._form.n_chroma_planes
        return self._stride * (height - 1) + self._row

    def join(self, planes: Sequence[bytes]) -> bytes:
        """Join the planes of an image, each without what its memory holds behind it.

        Raises:
            ValueError: a plane is torn or missing.
        """
        if not self._form.is_split:
            return planes[0]
        height = self._size[1]
        n_bytes = [self._stride * height] + [self._chroma_stride * (height // 2)] * self._form.n_chroma_planes
        sizes = [len(plane) for plane in planes]
        if len(sizes) != len(n_bytes) or any(size < n for size, n in zip(sizes, n_bytes, strict=True)):
            raise ValueError(f"planes of {sizes} bytes came, of {n_bytes} bytes were expected")
        return b"".join(plane[:n] for plane, n in zip(planes, n_bytes, strict=True))

    def decode(self, data: bytes | bytearray | memoryview) -> Pixels:
        """Decode one image.

        Returns:
            (H, W) grey or (H, W, 3) BGR.

        Raises:
            ValueError: it is torn, damaged or of another size.
        """
        width, height = self._size
        if len(data) < self.n_bytes:
            raise ValueError(f"{len(data)} of the {self.n_bytes} bytes of an image came")
        if self._form.is_compressed:
            pixels = decode_image(bytes(data))
            if pixels.shape[:2] != (height, width):
                raise ValueError(f"it is {pixels.shape[1]}x{pixels.shape[0]} px, not {width}x{height} px")
            return pixels
        if self._form.n_chroma_planes:
            return self._convert(self._planes(np.frombuffer(data, np.uint8)))
        n_channels, n_value = self._form.n_channels, self._value.itemsize
        strides = self._stride, n_channels * n_value, n_value
        rows: NDArray[Any] = np.ndarray((height, width, n_channels), self._value, data, 0, strides)
        pixels = rows[:, :, 0] if n_channels == 1 else rows
        return self._convert(self._to_8_bit(pixels) if n_value == 2 else pixels)

    @property
    def _chroma_stride(self) -> int:
        return self._stride if self._form.n_chroma_planes == 1 else self._stride // 2

    def _planes(self, data: Pixels) -> Pixels:
        """Lay the planes (3/2 H, W) of 4:2:0 close together, as OpenCV wants them."""
        width, height = self._size
        n_luma = self._stride * height
        luma = data[:n_luma].reshape(height, self._stride)[:, :width]
        n_rows = self._form.n_chroma_planes * (height // 2)
        chroma = data[n_luma : n_luma + self._chroma_stride * n_rows].reshape(n_rows, self._chroma_stride)
        n_across = width // (1 if self._form.n_chroma_planes == 1 else 2)
        return np.concatenate((luma, chroma[:, :n_across].reshape(height // 2, width)))

    def _to_8_bit(self, values: NDArray[Any]) -> Pixels:
        # Most drivers right-align, Xavier's VI left-aligns; once seen to be so, it stays so in dark images.
        if self._form.bits < 16 and not self._is_high_aligned:
            self._is_high_aligned = bool(values.max() >> self._form.bits)
        shift = 8 if self._is_high_aligned else self._form.bits - 8
        return np.asarray(values >> shift, dtype=np.uint8)

    def _convert(self, pixels: NDArray[Any]) -> Pixels:
        if not self._form.conversion:
            return np.array(pixels, dtype=np.uint8)
        return np.asarray(self._cv2.cvtColor(pixels, self._conversion), dtype=np.uint8)
