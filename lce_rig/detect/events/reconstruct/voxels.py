"""Events summed into arrays: the network's voxel grid and the plain event map."""

from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from lce_rig.core.data import Events

FloatArray = NDArray[np.float32]


def voxel_grid(
    events: Events, n_bins: int = 5, start_ns: int | None = None, end_ns: int | None = None
) -> FloatArray:
    """Spread events over temporal bins, V(b) = sum p max(0, 1 - |b - t*|), t* = (B - 1) (t - t0) / dt [1].

    Args:
        events: N events.
        n_bins: B.
        start_ns, end_ns: t0 and t0 + dt; None takes the first and the last event's timestamp.

    Returns:
        (B, H, W) float32, polarity +-1.

    References:
        [1] Zhu et al., Unsupervised event-based learning of optical flow, depth, and egomotion, CVPR 2019.
    """
    shape = (n_bins, events.height_px, events.width_px)
    if not len(events):
        return np.zeros(shape, np.float32)
    start_ns = int(events.t_ns[0]) if start_ns is None else start_ns
    end_ns = int(events.t_ns[-1]) if end_ns is None else end_ns
    duration_ns = max(1, end_ns - start_ns)
    position = np.clip((events.t_ns - start_ns) * ((n_bins - 1) / duration_ns), 0.0, n_bins - 1)
    sign = np.where(events.polarity, 1.0, -1.0)
    pixel = _pixel_index(events)
    n_pixels = events.height_px * events.width_px
    voxels = np.zeros((n_bins, n_pixels))
    # Events are in time order: those between two bins form a slice, counted into two images.
    bounds = np.searchsorted(position, np.arange(n_bins))
    bounds[-1] = len(position)
    for bin_, (first, last) in enumerate(pairwise(bounds)):
        cut = slice(first, last)
        late = (position[cut] - bin_) * sign[cut]
        voxels[bin_] += np.bincount(pixel[cut], sign[cut] - late, n_pixels)
        voxels[bin_ + 1] += np.bincount(pixel[cut], late, n_pixels)
    return voxels.astype(np.float32).reshape(shape)


def normalise_voxels(voxels: FloatArray) -> FloatArray:
    """Bring the non-zero voxels to mean 0 and standard deviation 1, in place; zeros stay zeros.

    References:
        Rebecq et al., High speed and high dynamic range video with an event camera, TPAMI 2019.
    """
    is_hit = voxels != 0
    values = voxels[is_hit]
    if len(values):
        voxels[is_hit] = (values - values.mean(dtype=np.float64)) / max(values.std(dtype=np.float64), 1e-3)
    return voxels


def event_map(events: Events) -> FloatArray:
    """Sum the polarities of each pixel, (H, W): the paper's rejected alternative to a reconstruction."""
    n_pixels = events.height_px * events.width_px
    sign = np.where(events.polarity, 1.0, -1.0)
    sums = np.bincount(_pixel_index(events), sign, n_pixels)
    return sums.astype(np.float32).reshape(events.height_px, events.width_px)


def _pixel_index(events: Events) -> NDArray[np.intp]:
    index = events.y.astype(np.intp)
    index *= events.width_px
    index += events.x
    return index
