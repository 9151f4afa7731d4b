"""What the page receives: a state in JSON, and its image as JPEG."""

import asyncio
import json
import math
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict

import cv2
import numpy as np
from numpy.typing import NDArray

from lce_rig.collect.live.state import LiveState
from lce_rig.core.geometry import Array

Pixels = NDArray[np.uint8]

#: Enough for a phone, and little enough for its radio.
MAX_WIDTH_PX = 960
_QUALITY = 75
# A collection runs for hours; the page shows the last of its messages.
_MAX_LOG = 50


def to_json(state: LiveState, update: int, *, has_picture: bool) -> str:
    """Write a state, without its image, for the page; what is not known is null.

    Args:
        state: the state.
        update: a number that the page answers with once it has shown the state.
        has_picture: whether a JPEG of the drawing follows.
    """
    drawing = None
    if state.drawing is not None:
        height, width = state.drawing.pixels.shape[:2]
        drawing = {
            "camera": state.drawing.camera,
            "width_px": width,
            "height_px": height,
            "present_px": _outline(state.drawing.present_px),
            "wanted_px": _outline(state.drawing.wanted_px),
            "is_there": bool(state.drawing.is_there),
            "has_picture": has_picture,
        }
    document = {
        "update": update,
        "rig": state.rig,
        "session": state.session,
        "elapsed_s": _number(state.elapsed_s),
        "phase": state.phase,
        "headline": state.headline,
        "detail": state.detail,
        "hold_s": None if state.hold_s is None else _number(state.hold_s),
        "n_captures": int(state.n_captures),
        "n_wanted": state.n_wanted,
        "last_capture": state.last_capture,
        "goes_on": state.goes_on,
        "streams": [asdict(stream) | {"rate_hz": _number(stream.rate_hz)} for stream in state.streams],
        "drawing": drawing,
        "coverage": None if state.coverage is None else asdict(state.coverage),
        "sigma_deg": _number(state.sigma_deg),
        "sigma_mm": _number(state.sigma_mm),
        "target_deg": _number(state.target_deg),
        "target_mm": _number(state.target_mm),
        "cues": [asdict(cue) for cue in state.cues],
        "log": list(state.log[-_MAX_LOG:]),
        "notes": list(state.notes),
    }
    return json.dumps(document, allow_nan=False)


def beat(age_s: float | None) -> str:
    """Write that nothing is new, and for how long; None where nothing has come yet."""
    return json.dumps({"beat": True, "age_s": None if age_s is None else round(age_s, 1)})


def encode_picture(pixels: Pixels) -> bytes:
    """Compress an image, (H, W) or (H, W, 3) BGR, at most `MAX_WIDTH_PX` wide."""
    height, width = pixels.shape[:2]
    shrinkage = width / MAX_WIDTH_PX
    if shrinkage > 1:
        # Means over areas are fast for whole factors only, and below two there is little to be averaged.
        kind = cv2.INTER_LINEAR if shrinkage < 2 else cv2.INTER_AREA
        shrinkage = shrinkage if shrinkage < 2 else math.ceil(shrinkage)
        size = (round(width / shrinkage), max(1, round(height / shrinkage)))
        pixels = np.asarray(cv2.resize(pixels, size, interpolation=kind), np.uint8)
    _, jpeg = cv2.imencode(".jpg", pixels, [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])
    return bytes(jpeg)


class Encoder:
    """Compresses each image once, however many watch, in a thread of its own.

    Attributes:
        n_encoded: images compressed.
    """

    def __init__(self) -> None:
        self.n_encoded = 0
        self._pixels: Pixels | None = None
        self._jpeg: asyncio.Future[bytes] | None = None
        self._thread = ThreadPoolExecutor(1, "preview-pictures")

    async def encode(self, pixels: Pixels) -> bytes:
        """Compress an image, or give what it was compressed to before."""
        if self._jpeg is None or self._pixels is not pixels:
            loop = asyncio.get_running_loop()
            self._pixels, self._jpeg = pixels, loop.run_in_executor(self._thread, encode_picture, pixels)
            self.n_encoded += 1
        # One viewer that leaves must not take the image from the others.
        return await asyncio.shield(self._jpeg)

    def close(self) -> None:
        """End the thread."""
        self._thread.shutdown()


def _outline(points_px: Array | None) -> list[list[float] | None] | None:
    """Round an outline to tenths of a pixel; a point out of the lens's sight is None."""
    if points_px is None:
        return None
    is_seen = np.asarray(np.isfinite(points_px).all(axis=1))
    rounded = np.round(np.where(is_seen[:, None], points_px, 0.0), 1).tolist()
    return [point if is_point else None for point, is_point in zip(rounded, is_seen, strict=True)]


def _number(value: float) -> float | None:
    return float(value) if math.isfinite(value) else None
