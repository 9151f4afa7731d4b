"""Image edges as a smooth field: how likely an outline lies on each pixel, compared with its surroundings."""

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from lce_rig.core.geometry import Array

# At a focal length of 1000 px; other lenses and resolutions scale them, so that angles stay the same.
_REFERENCE_PX = 1000.0
_WORKING_FOCAL_PX = 700.0  # Images with a longer one are halved first: edges are blurred more than that.
_SIGMA_PX = 3.0  # 0.17 deg: what extrinsics, beams and azimuth steps leave open
_WINDOW_PX = (121.0, 31.0)  # along and across the direction searched
_WEAKEST_GREY = 2.0  # An image whose strongest edges are weaker shows noise.
_CLIP_PERCENTILE = 99
_FLOOR = 0.005
_OUTLIERS = 0.5  # share of depth edges that no image edge accompanies


@dataclass(frozen=True, eq=False)
class EdgeField:
    """Two fields of one image, for upright and for level outlines.

    Attributes:
        upright: (H, W) float32 log-likelihood ratio of an upright outline at a pixel against anywhere near.
        level: the same for level outlines; None if the LiDAR sees none.
        reduction: pixels of the image to one of the fields.
    """

    upright: NDArray[np.float32]
    level: NDArray[np.float32] | None
    reduction: int

    def sample(self, pixels: Array, is_level: NDArray[np.bool_]) -> Array:
        """Interpolate the fields at pixels (N, 2) of the image; 0 outside."""
        at = ((np.where(np.isfinite(pixels), pixels, -1e4) + 0.5) / self.reduction - 0.5).astype(np.float32)
        values = np.zeros(len(at))
        for field, chosen in ((self.upright, ~is_level), (self.level, is_level)):
            if field is not None and chosen.any():
                u, v = at[chosen, 0][None], at[chosen, 1][None]
                values[chosen] = cv2.remap(field, u, v, cv2.INTER_LINEAR, borderValue=0.0)[0]
        return values


def build_edge_field(grey: NDArray[np.uint8], focal_px: float, ring_step_rad: float | None) -> EdgeField:
    """Turn an image into fields of its edges.

    Gradients g are clipped, blurred to the uncertainty of an outline and compared with their mean over a
    window, so that busy texture attracts nothing: ln(0.5 + 0.5 g / mean g), half of the outlines being
    without an image edge.

    Args:
        grey: (H, W) image.
        focal_px: of its lens.
        ring_step_rad: between the LiDAR's rings, which leaves the height of level outlines open; None for no
            field of level outlines.
    """
    reduction = 2 if focal_px > _WORKING_FOCAL_PX else 1
    if reduction > 1:
        grey = np.asarray(
            cv2.resize(grey, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA), dtype=np.uint8
        )
    scale = focal_px / _REFERENCE_PX / reduction
    smooth = cv2.GaussianBlur(grey.astype(np.float32), (0, 0), 1.0 if reduction == 1 else 0.7)
    upright = _compare(np.abs(cv2.Scharr(smooth, cv2.CV_32F, 1, 0)) / 16, scale, _SIGMA_PX)
    level = None
    if ring_step_rad is not None:
        # An outline lies anywhere between two rings: a uniform distribution.
        open_px = ring_step_rad * _REFERENCE_PX / np.sqrt(12)
        across = np.ascontiguousarray((np.abs(cv2.Scharr(smooth, cv2.CV_32F, 0, 1)) / 16).T)
        level = np.ascontiguousarray(_compare(across, scale, float(np.hypot(_SIGMA_PX, open_px))).T)
    return EdgeField(upright, level, reduction)


def _compare(gradient: NDArray[Any], scale: float, sigma_px: float) -> NDArray[np.float32]:
    """Compare gradients along the rows with their surroundings; sigma at the reference focal length."""
    strongest = max(float(np.percentile(gradient, _CLIP_PERCENTILE)), _WEAKEST_GREY)
    clipped = np.minimum(gradient / strongest, 1.0)
    along, across = scale * sigma_px, max(0.5, scale * sigma_px / 2)
    blurred = cv2.GaussianBlur(clipped, (0, 0), sigmaX=along, sigmaY=across)
    widening = max(1.0, sigma_px / _SIGMA_PX)
    window = (int(_WINDOW_PX[0] * scale * widening) | 1, int(_WINDOW_PX[1] * scale) | 1)
    ratio = (blurred + _FLOOR) / (cv2.blur(blurred, window) + _FLOOR)
    return np.asarray(np.log(_OUTLIERS + (1 - _OUTLIERS) * ratio), dtype=np.float32)
