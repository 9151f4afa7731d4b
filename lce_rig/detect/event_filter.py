"""What an event camera sends that the scene did not cause: hot pixels, background activity, flicker of lamps.

References:
    T. Delbruck, Frame-free dynamic digital vision, 2008: an event is noise unless a neighbour supports it.
    Y. Hu, S.-C. Liu, T. Delbruck, v2e: from video frames to realistic DVS events, 2021.
"""

from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lce_rig.core.data import Events

# A pixel is hot where it fires this much more than its neighbours' median; edges pass over them as well.
_HOT_RATIO = 5.0
_HOT_SIGMAS = 6.0
_MAX_FLICKER_BINS = 20_000
# Motion in the scene lies below, lamps and screens above.
_MIN_FLICKER_HZ = 20.0
# A storm: this share of all events comes in bursts of one polarity, and these bursts are regular.
_STORM_COHERENCE = 0.5
_STORM_PEAK_SHARE = 0.3
# Or nearly all are of one polarity at a time, as when a light is switched; a board's edges make both.
_ONE_SIDED_COHERENCE = 0.9


def find_hot_pixels(events: Events, min_rate_hz: float = 10.0) -> NDArray[np.bool_]:
    """Find pixels that fire alone: far more often than the median of the eight around them.

    Up to three hot pixels side by side leave that median as it is.

    Args:
        events: a second or more; shorter stretches show only the hottest.
        min_rate_hz: slower pixels are never hot.

    Returns:
        (H, W), True where hot.
    """
    counts = _count(events).astype(np.float32)
    if not len(events):
        return counts > 0
    duration_s = max(int(events.t_ns[-1] - events.t_ns[0]), 1) * 1e-9
    height, width = counts.shape
    # Beyond the border lies the border mirrored: a corner's neighbours count twice rather than being absent.
    padded = np.pad(counts, 1, mode="reflect")
    neighbours = [
        padded[row : row + height, column : column + width]
        for row in range(3)
        for column in range(3)
        if (row, column) != (1, 1)
    ]
    expected = np.median(np.stack(neighbours), axis=0) + 1.0
    is_frequent = counts > max(min_rate_hz * duration_s, _HOT_SIGMAS)
    is_alone = (counts > _HOT_RATIO * expected) & (counts > expected + _HOT_SIGMAS * np.sqrt(expected))
    return np.asarray(is_frequent & is_alone, dtype=np.bool_)


def without_pixels(events: Events, pixels: NDArray[np.bool_]) -> Events:
    """Leave out the events of some pixels, (H, W)."""
    return events.select(~pixels[events.y, events.x])


class BackgroundActivityFilter:
    """Leaves out events that no neighbour supports; consecutive stretches are filtered as one.

    Time is cut into slices. An event stays where one of the eight pixels around it fired in the same slice or
    in the one before, that is within one to two slices' length: images of counts, not a search by event.

    Attributes:
        slice_ns: length of a slice.
    """

    def __init__(self, slice_ns: int = 5_000_000) -> None:
        self.slice_ns = slice_ns
        self._number: int | None = None
        self._previous: NDArray[np.int32] | None = None
        self._current: NDArray[np.int32] | None = None

    def apply(self, events: Events) -> Events:
        """Filter a stretch that follows those before in time."""
        number = events.t_ns // self.slice_ns
        keep = np.zeros(len(events), bool)
        edges = [0, *(np.flatnonzero(np.diff(number)) + 1).tolist(), len(events)]
        for begin, end in pairwise(edges):
            if begin < end:
                cut = slice(begin, end)
                keep[cut] = self._supported(events.select(cut), int(number[begin]))
        return events.select(keep)

    def _supported(self, events: Events, number: int) -> NDArray[np.bool_]:
        counts = _count(events)
        if self._current is None or self._previous is None or self._number is None:
            self._previous, self._current = np.zeros_like(counts), counts
        elif number == self._number:
            self._current = self._current + counts
        else:
            is_next = number == self._number + 1
            self._previous, self._current = self._current if is_next else np.zeros_like(counts), counts
        self._number = number
        around = _around(self._previous + self._current)
        return np.asarray(around[events.y, events.x] > 0)


@dataclass(frozen=True)
class Flicker:
    """How much of a stretch of events is lamps that flicker.

    Attributes:
        frequency_hz: of the strongest regular alternation of polarity above 20 Hz; 0 in too short a stretch.
        coherence: how much one polarity outweighs the other in a millisecond; near 1 where the whole picture
            brightens and darkens at once, near 0 where edges move.
        peak_share: share of that alternation's power at the frequency and its multiples.
    """

    frequency_hz: float
    coherence: float
    peak_share: float

    @property
    def is_storm(self) -> bool:
        """Whether flicker, or events of one polarity alone, drown the scene."""
        is_regular = self.coherence > _STORM_COHERENCE and self.peak_share > _STORM_PEAK_SHARE
        return is_regular or self.coherence > _ONE_SIDED_COHERENCE


def measure_flicker(events: Events, bin_ns: int = 1_000_000) -> Flicker:
    """Measure the flicker of lamps in a stretch of about a second.

    Mains lamps flicker at 100 or 120 Hz: all pixels that see them turn brighter together, then darker.

    Args:
        events: at least 0.2 s; of longer stretches the first 20 s are looked at.
        bin_ns: twice the bins' length is the shortest period seen.
    """
    if len(events) < 2:
        return Flicker(0.0, 0.0, 0.0)
    bins = (events.t_ns - events.t_ns[0]) // bin_ns
    is_used = bins < _MAX_FLICKER_BINS
    bins, polarity = bins[is_used], events.polarity[is_used]
    signed = np.bincount(bins, weights=np.where(polarity, 1.0, -1.0))
    coherence = _coherence(signed, np.bincount(bins))
    power = np.abs(np.fft.rfft(signed - signed.mean())) ** 2
    duration_s = len(signed) * bin_ns * 1e-9
    slowest = int(np.ceil(_MIN_FLICKER_HZ * duration_s))
    # Below four periods a line and its leakage are most of the spectrum.
    if slowest < 4 or len(power) <= slowest + 1 or power.sum() == 0:
        return Flicker(0.0, coherence, 0.0)
    peak = slowest + int(np.argmax(power[slowest:]))
    # A line that falls between two frequencies leaks into both.
    lines = np.unique(np.clip(np.arange(peak, len(power), peak)[:, None] + (-1, 0, 1), 1, len(power) - 1))
    return Flicker(peak / duration_s, coherence, float(power[lines].sum() / power.sum()))


def _coherence(signed: NDArray[Any], counts: NDArray[np.intp]) -> float:
    """Mean product of the polarities of two events in one bin, as a root: few events do not look coherent."""
    n_pairs = float((counts * (counts - 1)).sum())
    return float(np.sqrt(max((signed**2 - counts).sum() / n_pairs, 0.0))) if n_pairs else 0.0


def _around(counts: NDArray[np.int32]) -> NDArray[np.int32]:
    """Sum the eight pixels around each."""
    padded = np.pad(counts, 1)
    rows = padded[:-2] + padded[1:-1] + padded[2:]
    return np.asarray(rows[:, :-2] + rows[:, 1:-1] + rows[:, 2:] - counts, dtype=np.int32)


def _count(events: Events) -> NDArray[np.int32]:
    """Count the events of every pixel, (H, W)."""
    flat = events.y.astype(np.intp) * events.width_px + events.x
    counts = np.bincount(flat, minlength=events.height_px * events.width_px)
    return counts.reshape(events.height_px, events.width_px).astype(np.int32)
