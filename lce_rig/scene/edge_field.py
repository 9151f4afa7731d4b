"""Image edges as a smooth field: how likely an outline lies on each pixel, compared with its surroundings."""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from lce_rig.core.data import Events
from lce_rig.core.geometry import Array

# At a focal length of 1000 px; other lenses and resolutions scale them, so that angles stay the same.
_REFERENCE_PX = 1000.0
_WORKING_FOCAL_PX = 700.0  # Images with a longer one are halved first: edges are blurred more than that.
_SIGMA_PX = 3.0  # 0.17 deg: what extrinsics, beams and azimuth steps leave open
_WINDOW_PX = (121.0, 31.0)  # along and across the direction searched
_WEAKEST_GREY = 2.0  # An image whose strongest edges are weaker shows noise.
_CLIP_PERCENTILE = 99
_FLOOR = 0.005
_CLEAR = 0.5  # log-likelihood ratio of an edge that stands out
_OUTLIERS = 0.5  # share of depth edges that no image edge accompanies


@dataclass(frozen=True, eq=False)
class EdgeField:
    """The field of one image.

    Attributes:
        values: (H, W) float32 log-likelihood ratio of an upright outline at a pixel against anywhere near.
        reduction: pixels of the image to one of the field.
    """

    values: NDArray[np.float32]
    reduction: int

    def sample(self, pixels: Array) -> Array:
        """Interpolate the field at pixels (..., N, 2) of the image; 0 outside."""
        if not pixels.size:
            return np.zeros(pixels.shape[:-1])
        at = ((np.where(np.isfinite(pixels), pixels, -1e4) + 0.5) / self.reduction - 0.5).astype(np.float32)
        rows = at.reshape(-1, pixels.shape[-2], 2)
        sampled = cv2.remap(self.values, rows[..., 0], rows[..., 1], cv2.INTER_LINEAR, borderValue=0.0)
        return np.asarray(sampled.reshape(pixels.shape[:-1]), dtype=np.float64)

    def has_edges_near(self, pixels: Array, reach_px: float) -> NDArray[np.bool_]:
        """Find which pixels (N, 2) of the image have an edge within a distance."""
        side = 2 * round(reach_px / self.reduction) + 1
        near = cv2.dilate((self.values > _CLEAR).astype(np.float32), np.ones((side, side)))
        is_near = EdgeField(np.asarray(near, dtype=np.float32), self.reduction).sample(pixels) > 0
        return np.asarray(is_near, dtype=np.bool_)


def build_edge_field(grey: NDArray[np.uint8], focal_px: float) -> EdgeField:
    """Turn an image into a field of its upright edges.

    Horizontal gradients g are clipped, blurred to the uncertainty of an outline and compared with their mean
    over a window, so that busy texture attracts nothing: ln(0.5 + 0.5 g / mean g), half of the outlines being
    without an image edge.

    Args:
        grey: (H, W) image.
        focal_px: of its lens.
    """
    reduction = 2 if focal_px > _WORKING_FOCAL_PX else 1
    if reduction > 1:
        grey = np.asarray(
            cv2.resize(grey, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA), dtype=np.uint8
        )
    scale = focal_px / _REFERENCE_PX / reduction
    smooth = cv2.GaussianBlur(grey.astype(np.float32), (0, 0), 1.0 if reduction == 1 else 0.7)
    gradient = np.abs(cv2.Scharr(smooth, cv2.CV_32F, 1, 0)) / 16
    strongest = max(float(np.percentile(gradient, _CLIP_PERCENTILE)), _WEAKEST_GREY)
    clipped = np.minimum(gradient / strongest, 1.0)
    return EdgeField(_likelihood_ratio(clipped, scale), reduction)


def build_event_field(events: Events, focal_px: float) -> EdgeField:
    """Turn the events of a short time into a field: where brightness changed, an edge passed.

    Their count per pixel takes the place of the gradient: only edges that move, or that a moving rig passes,
    are in it.

    Args:
        events: of a few hundredths of a second.
        focal_px: of the lens.
    """
    pixels = events.y.astype(np.intp) * events.width_px + events.x
    counts = np.bincount(pixels, minlength=events.width_px * events.height_px).astype(np.float32)
    # A flickering pixel counts no more than an edge's.
    strongest = max(float(np.percentile(counts[counts > 0], _CLIP_PERCENTILE)), 1.0) if len(events) else 1.0
    clipped = np.minimum(counts.reshape(events.height_px, events.width_px) / strongest, 1.0)
    return EdgeField(_likelihood_ratio(clipped, focal_px / _REFERENCE_PX), 1)


def _likelihood_ratio(strength: NDArray[np.float32], scale: float) -> NDArray[np.float32]:
    """Blur edges to the uncertainty of an outline and compare them with their mean over a window."""
    sigma_px = scale * _SIGMA_PX
    blurred = cv2.GaussianBlur(strength, (0, 0), sigmaX=sigma_px, sigmaY=max(0.5, sigma_px / 2))
    window = (int(_WINDOW_PX[0] * scale) | 1, int(_WINDOW_PX[1] * scale) | 1)
    ratio = (blurred + _FLOOR) / (cv2.blur(blurred, window) + _FLOOR)
    return np.asarray(np.log(_OUTLIERS + (1 - _OUTLIERS) * ratio), dtype=np.float32)
