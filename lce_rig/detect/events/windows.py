"""Windows of events: their length, noise removal, and their sums as input arrays."""

from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from lce_rig.core.data import Events

# Events per pixel and step: the network's training value, and E2VID's default.
_EVENTS_PER_PIXEL = 0.35
BLOCK_PX = 16
# Fraction of active pixel blocks in a typical scene with a moving camera; see `active_share`.
_USUAL_ACTIVE_SHARE = 0.25
_MIN_ACTIVE_SHARE = _USUAL_ACTIVE_SHARE / 5
_LONGEST_NS = 60_000_000
_SHORTEST_NS = 20_000_000


class WindowRule(NamedTuple):
    """Rule for the end of the current window: at n_events and 20 ms both, or at 60 ms."""

    n_events: int

    @classmethod
    def of(cls, n_pixels: int, share: float) -> "WindowRule":
        """Set the next window's length from the active fraction of a sensor's pixels."""
        relative = min(1.0, max(share, _MIN_ACTIVE_SHARE) / _USUAL_ACTIVE_SHARE)
        return cls(max(1, round(_EVENTS_PER_PIXEL * n_pixels * relative)))

    def fill(self, n_events: int, age_ns: int) -> float:
        """Return how full a window is; 1 closes it."""
        return max(min(n_events / self.n_events, age_ns / _SHORTEST_NS), age_ns / _LONGEST_NS)

    def end(self, events: Events, start_ns: int) -> int | None:
        """Find the end of the window that began at start_ns with the first of `events`, ns; None if open.

        The window is [start, end): the event that completes the count still belongs to it.
        """
        longest_end = start_ns + _LONGEST_NS
        ends = [longest_end] if len(events) and int(events.t_ns[-1]) >= longest_end else []
        if len(events) >= self.n_events:
            filled = max(int(events.t_ns[self.n_events - 1]) + 1, start_ns + _SHORTEST_NS)
            # Later events may have the same timestamp: wait for a larger one.
            if int(events.t_ns[-1]) >= filled:
                ends.append(filled)
        return min(ends, default=None)


def active_share(events: Events) -> float:
    """Compute the fraction of the sensor covered by the events: (sum n)^2 / (B sum n^2) over B blocks.

    The participation ratio depends only on the spread of the events, not on their number; with it a small
    board before a still background gets windows of the same motion in pixels as a full image.
    """
    if not len(events):
        return 1.0
    counts = events_per_block(events)
    return float(counts.sum() ** 2 / (len(counts) * np.square(counts).sum()))


def events_per_block(events: Events) -> NDArray[np.float64]:
    """Count the events in each block of 16 x 16 pixels (B,)."""
    n_cols, n_rows = -(-events.width_px // BLOCK_PX), -(-events.height_px // BLOCK_PX)
    block = (events.y // BLOCK_PX).astype(np.intp) * n_cols + events.x // BLOCK_PX
    return np.bincount(block, minlength=n_cols * n_rows).astype(np.float64)


def events_per_pixel(events: Events) -> NDArray[np.int64]:
    """Count the events of each pixel (H, W)."""
    index = events.y.astype(np.intp) * events.width_px + events.x
    counts = np.bincount(index, minlength=events.height_px * events.width_px)
    return counts.reshape(events.height_px, events.width_px)


FloatArray = NDArray[np.float32]


def voxel_grid(events: Events, n_bins: int, start_ns: int, end_ns: int) -> FloatArray:
    """Spread events over temporal bins, V(b) = sum p max(0, 1 - |b - t*|), t* = (B - 1) (t - t0) / dt [1].

    Args:
        events: N events.
        n_bins: B.
        start_ns, end_ns: t0 and t0 + dt.

    Returns:
        (B, H, W) float32, polarity +-1.

    References:
        [1] Zhu et al., Unsupervised event-based learning of optical flow, depth, and egomotion, CVPR 2019.
    """
    shape = (n_bins, events.height_px, events.width_px)
    if not len(events):
        return np.zeros(shape, np.float32)
    duration_ns = max(1, end_ns - start_ns)
    position = np.clip((events.t_ns - start_ns) * ((n_bins - 1) / duration_ns), 0.0, n_bins - 1)
    sign = np.where(events.polarity, 1.0, -1.0)
    pixel = events.y.astype(np.intp) * events.width_px + events.x
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
    """Normalise the non-zero voxels to mean 0 and standard deviation 1, in place; zeros stay zero.

    References:
        Rebecq et al., High speed and high dynamic range video with an event camera, TPAMI 2019.
    """
    is_hit = voxels != 0
    values = voxels[is_hit]
    if len(values):
        voxels[is_hit] = (values - values.mean(dtype=np.float64)) / max(values.std(dtype=np.float64), 1e-3)
    return voxels


# Ratio of a hot pixel's event count to the median of the 5 x 5 pixels around it.
_HOT_FACTOR = 8.0
_HOT_MIN_EVENTS = 20
_HOT_PERIOD_NS = 500_000_000
_SUPPORT_NS = 10_000_000


class NoiseFilter:
    """Learns the hot pixels along the stream, and removes their events and isolated ones."""

    def __init__(self) -> None:
        self._n_events: NDArray[np.int64] | None = None
        self._since_ns = 0
        self._is_hot: NDArray[np.bool_] | None = None

    def learn(self, events: Events) -> None:
        """Count the next part of the stream; update the hot pixels twice a second."""
        if not len(events):
            return
        if self._n_events is None:
            self._n_events = np.zeros((events.height_px, events.width_px), np.int64)
            self._since_ns = int(events.t_ns[0])
        self._n_events += events_per_pixel(events)
        last_ns = int(events.t_ns[-1])
        if last_ns - self._since_ns >= _HOT_PERIOD_NS:
            self._is_hot = hot_pixels(self._n_events)
            self._n_events[:] = 0
            self._since_ns = last_ns

    def clean(self, events: Events) -> Events:
        """Remove background activity and the events of known hot pixels."""
        if self._is_hot is not None and self._is_hot.any():
            events = events.select(~self._is_hot[events.y, events.x])
        return without_background_activity(events)


def hot_pixels(n_events: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Find hot pixels (H, W) from events per pixel over half a second or more, (H, W).

    Moving edges pass over neighbours, too; a hot pixel's neighbours stay quiet. The median of the
    neighbours is insensitive to a second hot pixel among them.
    """
    import cv2

    counts = np.minimum(n_events, 65535).astype(np.uint16)
    typical = cv2.medianBlur(counts, 5).astype(np.float32)
    return np.asarray((counts >= _HOT_MIN_EVENTS) & (counts > _HOT_FACTOR * (typical + 1)))


def without_background_activity(events: Events) -> Events:
    """Remove events without a neighbouring event.

    Time is cut into slices of 10 ms. An event stays if its 3 x 3 neighbourhood holds another pixel's event in
    the same slice, the one before or the one after: the nearest-neighbour filter of [1] with slices in place
    of a map of timestamps.

    References:
        [1] Delbruck, Frame-free dynamic digital vision, ISSE 2008.
    """
    if not len(events):
        return events
    n_slices = int((events.t_ns[-1] - events.t_ns[0]) // _SUPPORT_NS) + 1
    bounds = np.searchsorted(events.t_ns, events.t_ns[0] + _SUPPORT_NS * np.arange(n_slices + 1))
    active = np.zeros((n_slices + 2, events.height_px, events.width_px), bool)
    for index in range(n_slices):
        cut = slice(bounds[index], bounds[index + 1])
        active[index + 1, events.y[cut], events.x[cut]] = True
    keep = np.empty(len(events), bool)
    for index in range(n_slices):
        cut = slice(bounds[index], bounds[index + 1])
        near = active[index] | active[index + 1] | active[index + 2]
        wide = np.pad(near.astype(np.uint8), 1)
        rows = wide[:-2] + wide[1:-1] + wide[2:]
        total = rows[:, :-2] + rows[:, 1:-1] + rows[:, 2:]
        keep[cut] = np.asarray(total > near)[events.y[cut], events.x[cut]]
    return events.select(keep)


_BIN_NS = 1_000_000
# Limit of coherence: recordings under mains lamps have 0.83 to 0.86, others 0.11 to 0.28.
_FLICKER_COHERENCE = 0.5


def is_flickering(events: Events) -> bool:
    """Check whether flickering or switched lamps caused most events of about a second.

    Under such light, all pixels turn brighter together, then darker; moving edges cause both at any time.
    The root mean product of the polarities of two events of one millisecond separates the two.
    """
    if len(events) < 2:
        return False
    bins = (events.t_ns - events.t_ns[0]) // _BIN_NS
    counts = np.bincount(bins)
    signed = 2.0 * np.bincount(bins, events.polarity) - counts
    # Pairs of an event with itself are excluded, so that few events do not look coherent.
    n_pairs = float((counts * (counts - 1)).sum())
    return bool(n_pairs and (signed**2 - counts).sum() > _FLICKER_COHERENCE**2 * n_pairs)
