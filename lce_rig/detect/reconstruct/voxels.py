"""Events summed into arrays: the network's voxel grid and the plain event map."""

import numpy as np
from numpy.typing import NDArray

from lce_rig.core.data import Events

FloatArray = NDArray[np.float32]


def voxel_grid(
    events: Events, n_bins: int = 5, start_ns: int | None = None, end_ns: int | None = None
) -> FloatArray:
    """Spread the events over temporal bins, V(b) = sum p max(0, 1 - |b - t*|), t* = (B - 1) (t - t0) / dt [1].

    Args:
        events: N events.
        n_bins: B.
        start_ns, end_ns: t0 and t0 + dt; None takes the first and the last event's stamp.

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
    bins_per_ns = (n_bins - 1) / max(1, end_ns - start_ns)
    position = (events.t_ns - start_ns).astype(np.float64)
    position *= bins_per_ns
    np.clip(position, 0.0, n_bins - 1, out=position)
    lower = position.astype(np.intp)
    np.minimum(lower, n_bins - 2, out=lower)
    position -= lower
    n_pixels = events.height_px * events.width_px
    cell = lower * n_pixels + _pixel_index(events)
    sign = np.where(events.polarity, 1.0, -1.0)
    late = position * sign
    voxels = np.bincount(cell, sign - late, n_bins * n_pixels)
    # The share of the later bin lands one bin on: the same cells, counted into the grid from bin 1.
    voxels[n_pixels:] += np.bincount(cell, late, (n_bins - 1) * n_pixels)
    return voxels.astype(np.float32).reshape(shape)


def normalise_voxels(voxels: FloatArray) -> FloatArray:
    """Bring the non-zero voxels to mean 0 and standard deviation 1, in place; zeros stay zeros.

    References:
        Rebecq et al., High speed and high dynamic range video with an event camera, TPAMI 2019.
    """
    flat = voxels.reshape(-1)
    hit = np.flatnonzero(flat)
    if not len(hit):
        return voxels
    values = flat[hit].astype(np.float64)
    flat[hit] = (values - values.mean()) / max(float(values.std()), 1e-3)
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
