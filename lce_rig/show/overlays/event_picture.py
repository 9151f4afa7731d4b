"""Recent events over the image reconstructed from them: red for brighter, blue for darker."""

from dataclasses import dataclass

import cv2
import numpy as np

from lce_rig.core.data import Events, Image
from lce_rig.show.overlays import canvas
from lce_rig.show.overlays.canvas import INK, Colour, Picture

# BGR; they also differ in lightness.
BRIGHTER: Colour = (70, 70, 255)
DARKER: Colour = (255, 150, 60)
# For a slow board all events of this time are drawn, for a fast one the latest per pixel.
_RECENT_NS = 100_000_000
_MOST_EVENTS_PX = 0.06
_DIM = 0.45


@dataclass(frozen=True, eq=False)
class ImageWithEvents:
    """A camera's view.

    Attributes:
        image: the image, captured or reconstructed from events.
        events: those shortly before it; None if the image was not reconstructed here.
    """

    image: Image
    events: Events | None = None

    @classmethod
    def of_events(cls, image: Image, events: Events) -> "ImageWithEvents":
        """Keep the events shortly before an image."""
        stamp_ns = image.stamp_ns if image.stamp_ns is not None else int(events.t_ns[-1])
        recent = events.between(stamp_ns - _RECENT_NS, stamp_ns)
        n_most = round(_MOST_EVENTS_PX * events.width_px * events.height_px)
        return cls(image, recent.select(slice(max(0, len(recent) - n_most), len(recent))))


def draw_events(image: Image, events: Events) -> tuple[Picture, int]:
    """Draw events over their image, dimmed, enlarged.

    Args:
        image: the image.
        events: each pixel gets the colour of the majority of its events.

    Returns:
        The drawing (H, W, 3) BGR and the factor, as `canvas.enlarged`.
    """
    picture, factor = canvas.enlarged(image.pixels)
    dimmed = picture.astype(np.float32) * _DIM + 30
    shape = image.pixels.shape[:2]
    sums = np.zeros(shape, dtype=np.int32)
    is_inside = (events.x < shape[1]) & (events.y < shape[0])
    inside = events.select(is_inside)
    np.add.at(sums, (inside.y, inside.x), np.where(inside.polarity, 1, -1))
    for is_coloured, colour in ((sums > 0, BRIGHTER), (sums < 0, DARKER)):
        large = cv2.resize(
            is_coloured.astype(np.uint8), None, fx=factor, fy=factor, interpolation=cv2.INTER_NEAREST
        )
        dimmed[large > 0] = colour
    return np.asarray(np.clip(dimmed, 0, 255), dtype=np.uint8), factor


def draw_event_key(
    picture: Picture, events: Events, left_px: float, baseline_px: float, text_px: float
) -> None:
    """Explain the colours in one line of text."""
    span_ms = 1e-6 * float(events.t_ns[-1] - events.t_ns[0]) if len(events) else 0.0
    texts = (
        (f"events of the last {span_ms:.{0 if span_ms >= 10 else 1}f} ms:", INK),
        ("brighter", BRIGHTER),
        ("darker", DARKER),
    )
    for text, colour in texts:
        canvas.draw_text(picture, text, left_px, baseline_px, text_px, colour)
        left_px += canvas.text_width_px(text, text_px) + text_px
