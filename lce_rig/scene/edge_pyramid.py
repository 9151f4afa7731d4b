"""Image edges as smooth fields of several widths, separately for vertical and horizontal edges."""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from lce_rig.core.data import Events
from lce_rig.core.geometry import Array

SIGMAS_RAD = tuple(0.024 / 2**level for level in range(4))
"""Blur of the fields: 1.4 deg, the error of rough extrinsics, down to the width of an outline."""

_WORKING_FOCAL_PX = 1000.0  # Focal length above which images are halved first, px.
_WEAKEST_GREY = 2.0  # Gradient of noise: an image without stronger edges has none.
_CLIP_PERCENTILE = 99  # of gradients: stronger edges count no more
_WINDOW_RAD, _WINDOW_SIGMAS = 0.12, 20.0  # Window across an edge, at least, and in sigmas of the blur,
_WINDOW_ASPECT = 4  # by its length along the edge.
_FLOOR = 0.005  # of the mean edge strength in a window, as a share of the strongest
_OUTLIERS = 0.5  # Fraction of outlines without an image edge.
_CLEAR = 0.5  # Log-likelihood ratio of an edge that stands out.
_SAMPLES_PER_SIGMA = 1.5  # Coarse fields are stored at a lower resolution.


@dataclass(frozen=True, eq=False)
class EdgeLayer:
    """The field of edges of one direction at one width.

    Attributes:
        values: (H, W, 3) float32: log-likelihood ratio of an outline at a pixel against anywhere near, and
            its derivatives along columns and rows, 1/px of the image.
        reduction: pixels of the image to one of the field.
    """

    values: NDArray[np.float32]
    reduction: int

    def sample(self, pixels: Array) -> Array:
        """Interpolate value and derivatives (N, 3) at pixels (N, 2) of the image; 0 outside."""
        at = places(pixels, self.reduction)
        parts = [
            self.interpolate(at[:, k : k + _REMAP_COLUMNS]) for k in range(0, len(pixels), _REMAP_COLUMNS)
        ]
        return np.concatenate([np.zeros((0, 3)), *parts])

    def interpolate(self, at: NDArray[np.float32]) -> NDArray[np.float32]:
        """Interpolate value and derivatives (N, 3), N at most 32767, at `places` (2, N); 0 outside."""
        if not at.size:
            return np.zeros((0, 3), dtype=np.float32)
        sampled = cv2.remap(self.values, at[:1], at[1:], cv2.INTER_LINEAR, borderValue=(0.0,) * 4)
        return np.asarray(sampled[0])


def places(pixels: Array, reduction: int | NDArray[np.intp]) -> NDArray[np.float32]:
    """Return the positions (2, N) of an image's pixels (N, 2) in its fields; far outside if NaN.

    Args:
        pixels: pixels of the image.
        reduction: reduction factor of the field, or of each pixel's field (N,).
    """
    at = (pixels.T + 0.5) / reduction - 0.5
    return np.asarray(np.fmin(np.fmax(at, _FAR_OUTSIDE), -_FAR_OUTSIDE), dtype=np.float32, order="C")


_REMAP_COLUMNS = 32767  # OpenCV's largest row of samples.
_FAR_OUTSIDE = -1e4  # px; OpenCV's coordinates have 16 bits.


@dataclass(frozen=True, eq=False)
class EdgePyramid:
    """The fields of one image.

    Attributes:
        levels: one pair (upright edges, level edges) for each of SIGMAS_RAD.
    """

    levels: Sequence[tuple[EdgeLayer, EdgeLayer]]

    def has_edges_near(self, pixels: Array, reach_px: float) -> NDArray[np.bool_]:
        """Find which pixels (N, 2) of the image have a vertical edge within a distance."""
        layer, _ = self.levels[-1]
        side = 2 * round(reach_px / layer.reduction) + 1
        near = np.array(layer.values)
        near[..., 0] = cv2.dilate((near[..., 0] > _CLEAR).astype(np.float32), np.ones((side, side)))
        return np.asarray(EdgeLayer(near, layer.reduction).sample(pixels)[:, 0] > 0, dtype=np.bool_)


def build_edge_pyramid(grey: NDArray[np.uint8], focal_px: float) -> EdgePyramid:
    """Convert an image to fields of its vertical and horizontal edges.

    Gradients g are clipped, blurred and compared with their mean over a window, so that busy texture attracts
    nothing: ln(0.5 + 0.5 g / mean g), half of the outlines being without an image edge.

    Args:
        grey: (H, W) image.
        focal_px: focal length of its lens.
    """
    reduction = 1
    while focal_px / reduction > _WORKING_FOCAL_PX:
        reduction *= 2
    return _pyramid(_edge_strengths(_reduced(grey.astype(np.float32), reduction)), focal_px, reduction)


def build_event_pyramid(events: Events, focal_px: float) -> EdgePyramid:
    """Convert the events of a short time to fields: brightness changes where an edge passes.

    Their count per pixel takes the place of both gradients: only edges that move, or that a moving rig
    passes, are in it.

    Args:
        events: events of a few hundredths of a second.
        focal_px: focal length of the lens.
    """
    pixels = events.y.astype(np.intp) * events.width_px + events.x
    counts = np.bincount(pixels, minlength=events.width_px * events.height_px).astype(np.float32)
    # Clip flickering pixels to the strength of an edge.
    strongest = max(float(np.percentile(counts[counts > 0], _CLIP_PERCENTILE)), 1.0) if len(events) else 1.0
    strength = np.minimum(counts.reshape(events.height_px, events.width_px) / strongest, 1.0)
    return _pyramid((strength, strength), focal_px, 1)


def _pyramid(strengths: Sequence[NDArray[np.float32]], focal_px: float, reduction: int) -> EdgePyramid:
    """Build the fields of vertical and horizontal edges, of given strength, at all widths."""
    levels = []
    for sigma_rad in SIGMAS_RAD:
        further = 1
        while sigma_rad * focal_px / reduction / further > 2 * _SAMPLES_PER_SIGMA:
            further *= 2
        upright, level = (
            EdgeLayer(
                _field(_reduced(each, further), axis, sigma_rad, focal_px, reduction * further),
                reduction * further,
            )
            for axis, each in enumerate(strengths)
        )
        levels.append((upright, level))
    return EdgePyramid(tuple(levels))


def _reduced(values: NDArray[np.float32], factor: int) -> NDArray[np.float32]:
    """Average blocks of pixels; the last ones are repeated to fill the blocks."""
    if factor == 1:
        return values
    bottom, right = (-size % factor for size in values.shape)
    padded = cv2.copyMakeBorder(values, 0, bottom, 0, right, cv2.BORDER_REPLICATE)
    size = (padded.shape[1] // factor, padded.shape[0] // factor)
    return np.asarray(cv2.resize(padded, size, interpolation=cv2.INTER_AREA), dtype=np.float32)


def _edge_strengths(grey: NDArray[np.float32]) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Compute clipped gradients along columns and along rows, 0 to 1."""
    smooth = cv2.GaussianBlur(grey, (0, 0), 1.0)
    strengths = []
    for axis in (0, 1):
        gradient = np.abs(cv2.Scharr(smooth, cv2.CV_32F, 1 - axis, axis)) / 16
        strongest = max(float(np.percentile(gradient, _CLIP_PERCENTILE)), _WEAKEST_GREY)
        strengths.append(np.asarray(np.minimum(gradient / strongest, 1.0), dtype=np.float32))
    return strengths[0], strengths[1]


def _field(
    strength: NDArray[np.float32], axis: int, sigma_rad: float, focal_px: float, reduction: int
) -> NDArray[np.float32]:
    """Blur edges, compare them with their mean over a window, and differentiate."""
    px_per_rad = focal_px / reduction
    across, along = sigma_rad * px_per_rad, max(0.5, sigma_rad * px_per_rad / 2)
    wide = max(_WINDOW_RAD, _WINDOW_SIGMAS * sigma_rad) * px_per_rad
    window = (int(wide) | 1, int(wide / _WINDOW_ASPECT) | 1)
    if axis == 0:
        blurred = cv2.GaussianBlur(strength, (0, 0), sigmaX=across, sigmaY=along)
    else:
        blurred = cv2.GaussianBlur(strength, (0, 0), sigmaX=along, sigmaY=across)
        window = window[::-1]
    # OpenCV's logarithm and division take half the time of numpy's.
    ratio = cv2.divide(blurred + np.float32(_FLOOR), cv2.blur(blurred, window) + np.float32(_FLOOR))
    values = cv2.log(np.float32(_OUTLIERS) + np.float32(1 - _OUTLIERS) * ratio)
    slopes = [cv2.Sobel(values, cv2.CV_32F, 1 - k, k, scale=1 / (8 * reduction)) for k in (0, 1)]
    return np.asarray(cv2.merge([values, *slopes]), dtype=np.float32)
