"""Captures as small pictures for a page: the image with the board's outline, as a data URI."""

import base64
from collections.abc import Sequence
from contextlib import suppress

import cv2
import numpy as np
from numpy.typing import NDArray

from lce_rig.core.board import Board
from lce_rig.core.calibration import Calibration
from lce_rig.core.camera import Intrinsics
from lce_rig.core.data import Events
from lce_rig.core.errors import LceRigError
from lce_rig.core.geometry import Array
from lce_rig.detect.events.figures import outline_px
from lce_rig.session import Capture

MOST_BYTES = 12_000
"""Of one picture's data URI."""
_WIDTH_PX, _OUTLINE_BGR = 320, (0, 140, 255)
_QUALITIES = (75, 60, 45, 30, 15)
# Events of this long make a picture in which the board's edges can be seen.
_EVENTS_NS = 20_000_000


def picture_of(capture: Capture, c: Calibration, board: Board, lens: Intrinsics) -> str:
    """Draw a capture's image with the board's outline; raw events where it holds no image.

    Args:
        capture: with the data.
        c: the result, whose channels are looked at in their order.
        board: of the outline.
        lens: of the camera.

    Returns:
        A data URI of at most `MOST_BYTES`; "" where the capture holds no picture, or a damaged one.
    """
    observation = c.observations.get(capture.name)
    outline, stamp_ns = np.empty((0, 2)), None
    if observation is not None:
        outline = outline_px(observation.image.T_cam_board, board, lens)
        stamp_ns = observation.image.stamp_ns
    with suppress(LceRigError):
        for channel in c.channels:
            if capture.has_image(c.camera, channel):
                return data_uri(capture.image(c.camera, channel).pixels, outline)
        if c.camera in capture.event_cameras:
            return data_uri(_accumulated(capture.events(c.camera), stamp_ns), outline)
    return ""


def data_uri(pixels: NDArray[np.uint8], outline: Array) -> str:
    """Shrink an image and draw an outline into it.

    Args:
        pixels: (H, W) grey or (H, W, 3) BGR.
        outline: (N, 2) px; points that are not finite are left out.

    Returns:
        A JPEG of at most `MOST_BYTES` as a data URI.
    """
    height, width = pixels.shape[:2]
    scale = min(1.0, _WIDTH_PX / width, _WIDTH_PX / height)
    for shrink in (1.0, 0.7, 0.5, 0.3):
        size = max(1, round(shrink * scale * width)), max(1, round(shrink * scale * height))
        small = cv2.resize(pixels, size, interpolation=cv2.INTER_AREA)
        drawn = small if small.ndim == 3 else cv2.cvtColor(small, cv2.COLOR_GRAY2BGR)
        line = outline[np.isfinite(outline).all(axis=1)]
        if len(line):
            # Pixel centres are at whole numbers, before and after; 4 bits of fraction.
            at = (line + 0.5) * size[0] / width - 0.5
            points = np.round(16 * np.clip(at, -1e4, 1e4)).astype(np.int32)
            cv2.polylines(drawn, [points], True, _OUTLINE_BGR, 2, cv2.LINE_AA, 4)
        for quality in _QUALITIES:
            content = cv2.imencode(".jpg", drawn, [cv2.IMWRITE_JPEG_QUALITY, quality])[1].tobytes()
            uri = "data:image/jpeg;base64," + base64.b64encode(content).decode()
            if len(uri) <= MOST_BYTES:
                return uri
    return ""


def _accumulated(events: Events, stamp_ns: int | None) -> NDArray[np.uint8]:
    """Draw the events about a time, or the last ones, bright on dark."""
    end_ns = int(events.t_ns[-1]) if len(events) else 0
    middle_ns = end_ns - _EVENTS_NS // 2 if stamp_ns is None else stamp_ns
    near = events.between(middle_ns - _EVENTS_NS // 2, middle_ns + _EVENTS_NS // 2)
    counts = np.zeros((events.height_px, events.width_px))
    np.add.at(counts, (near.y, near.x), 1.0)
    return np.asarray(np.clip(40 + 70 * counts, 0, 255), dtype=np.uint8)


def worst_first(planes_m: Sequence[float], edges_m: Sequence[float]) -> list[tuple[int, float]]:
    """Order captures by their residuals, the largest first.

    Returns:
        The index of each, and how many times the median its planes or edges lie apart.
    """
    ratios = np.zeros(len(planes_m))
    for values in (np.nan_to_num(np.array(planes_m)), np.nan_to_num(np.array(edges_m))):
        middle = float(np.median(values)) if len(values) else 0.0
        if middle > 0:
            ratios = np.maximum(ratios, values / middle)
    return [(int(k), float(ratios[k])) for k in np.argsort(-ratios, kind="stable")]
