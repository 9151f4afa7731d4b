"""Images as delivered by cameras: luma and chroma of ITU-R BT.601, video range."""

import numpy as np


def to_yuv(bgr):
    """Convert (H, W, 3) BGR to (H, W, 3) Y, U, V."""
    blue, green, red = np.moveaxis(bgr.astype(float), 2, 0)
    y = 16 + (65.481 * red + 128.553 * green + 24.966 * blue) / 255
    u = 128 + (-37.797 * red - 74.203 * green + 112 * blue) / 255
    v = 128 + (112 * red - 93.786 * green - 18.214 * blue) / 255
    return np.rint(np.stack((y, u, v), 2)).astype(np.uint8)


def to_422(bgr, order):
    """Convert (H, W, 3) BGR to (H, W, 2), "uyvy" or "yuyv", each two pixels with one chroma."""
    y, u, v = np.moveaxis(to_yuv(bgr), 2, 0)
    chroma = u.copy()
    chroma[:, 1::2] = v[:, ::2]
    return np.stack((chroma, y) if order == "uyvy" else (y, chroma), axis=-1)


def to_420(bgr, order):
    """Convert (H, W, 3) BGR to (H * 3 / 2, W), "nv12" or "nv21", each four pixels with one chroma."""
    y, u, v = np.moveaxis(to_yuv(bgr), 2, 0)
    chroma = np.stack((u, v) if order == "nv12" else (v, u), axis=-1)[::2, ::2]
    return np.concatenate([y, chroma.reshape(len(y) // 2, -1)])
