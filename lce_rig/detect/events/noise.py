"""Noise in events: hot pixels, background activity, lamps that flicker."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lce_rig.core.data import Events

# A pixel is hot where it fires this many times as often as the 5 x 5 pixels around it.
_HOT_FACTOR = 8.0
_HOT_MIN_EVENTS = 20
_HOT_PERIOD_NS = 500_000_000
_SUPPORT_NS = 10_000_000


class NoiseFilter:
    """Learns along the stream which pixels are hot, and removes their events and isolated ones."""

    def __init__(self) -> None:
        self._n_events: NDArray[np.int64] | None = None
        self._since_ns = 0
        self._is_hot: NDArray[np.bool_] | None = None

    def learn(self, events: Events) -> None:
        """Count the next stretch of the stream; twice a second the hot pixels are determined again."""
        if not len(events):
            return
        shape = events.height_px, events.width_px
        if self._n_events is None:
            self._n_events, self._since_ns = np.zeros(shape, np.int64), int(events.t_ns[0])
        index = events.y.astype(np.intp) * events.width_px + events.x
        self._n_events += np.bincount(index, minlength=shape[0] * shape[1]).reshape(shape)
        last_ns = int(events.t_ns[-1])
        if last_ns - self._since_ns >= _HOT_PERIOD_NS:
            self._is_hot = hot_pixels(np.minimum(self._n_events, 65535).astype(np.uint16))
            self._n_events[:] = 0
            self._since_ns = last_ns

    def clean(self, events: Events) -> Events:
        """Remove the events of hot pixels known so far and background activity."""
        if self._is_hot is not None and self._is_hot.any():
            events = events.select(~self._is_hot[events.y, events.x])
        return without_background_activity(events)


def hot_pixels(n_events: NDArray[np.uint16]) -> NDArray[np.bool_]:
    """Find pixels that fire on their own, (H, W), from events per pixel over half a second or more, (H, W).

    Real edges pass over neighbours too, whichever way they move; a hot pixel's neighbours stay quiet. The
    median of the neighbours is blind to a second hot pixel next door.
    """
    import cv2

    typical = cv2.medianBlur(n_events, 5).astype(np.float32)
    return np.asarray((n_events >= _HOT_MIN_EVENTS) & (n_events > _HOT_FACTOR * (typical + 1)))


def without_background_activity(events: Events) -> Events:
    """Remove events without a neighbouring event.

    Time is cut into slices of 10 ms; an event stays where its 3 x 3 neighbourhood holds another
    pixel's event in the same slice, the one before or the one after: the nearest-neighbour filter of [1] with
    slices in place of a map of timestamps.

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


_MAX_FLICKER_BINS = 20_000
_BIN_NS = 1_000_000
# Motion in the scene lies below, lamps and screens above.
_MIN_FLICKER_HZ = 20.0
# A storm: this share of all events comes in bursts of one polarity, and these bursts are regular.
_STORM_COHERENCE = 0.5
_STORM_PEAK_SHARE = 0.3
# Or nearly all are of one polarity at a time, as when a light is switched; a board's edges make both.
_ONE_SIDED_COHERENCE = 0.9


@dataclass(frozen=True)
class Flicker:
    """How much of a stretch of events is lamps that flicker.

    Attributes:
        frequency_hz: of the strongest regular alternation of polarity above 20 Hz; 0 in too short a stretch.
        coherence: how much one polarity outweighs the other in a millisecond; near 1 where the whole image
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


def measure_flicker(events: Events) -> Flicker:
    """Measure the flicker of lamps in a stretch of about a second.

    Mains lamps flicker at 100 or 120 Hz: all pixels that see them turn brighter together, then darker.

    Args:
        events: at least 0.2 s; of longer stretches the first 20 s are looked at.
    """
    if len(events) < 2:
        return Flicker(0.0, 0.0, 0.0)
    # Events come in order of time: where each bin ends is found without looking at them one by one.
    t_ns = events.t_ns[: np.searchsorted(events.t_ns, events.t_ns[0] + _BIN_NS * _MAX_FLICKER_BINS)]
    n_bins = int((t_ns[-1] - t_ns[0]) // _BIN_NS) + 1
    ends = np.searchsorted(t_ns, t_ns[0] + _BIN_NS * np.arange(1, n_bins + 1))
    counts = np.diff(ends, prepend=0)
    is_filled = counts > 0
    n_brighter = np.zeros(n_bins, dtype=np.int64)
    begins = (ends - counts)[is_filled]
    n_brighter[is_filled] = np.add.reduceat(events.polarity[: ends[-1]], begins, dtype=np.int64)
    signed = 2.0 * n_brighter - counts
    # Mean product of the polarities of two events in one bin, as a root: few events do not look coherent.
    n_pairs = float((counts * (counts - 1)).sum())
    coherence = float(np.sqrt(max((signed**2 - counts).sum() / n_pairs, 0.0))) if n_pairs else 0.0
    power = np.abs(np.fft.rfft(signed - signed.mean())) ** 2
    duration_s = len(signed) * _BIN_NS * 1e-9
    slowest = int(np.ceil(_MIN_FLICKER_HZ * duration_s))
    # Below four periods a line and its leakage are most of the spectrum.
    if slowest < 4 or len(power) <= slowest + 1 or power.sum() == 0:
        return Flicker(0.0, coherence, 0.0)
    peak = slowest + int(np.argmax(power[slowest:]))
    # A line that falls between two frequencies leaks into both.
    lines = np.unique(np.clip(np.arange(peak, len(power), peak)[:, None] + (-1, 0, 1), 1, len(power) - 1))
    return Flicker(peak / duration_s, coherence, float(power[lines].sum() / power.sum()))
