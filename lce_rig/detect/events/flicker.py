"""Flicker of lamps in a stream of events: regular bursts of one polarity that drown the scene."""

from dataclasses import dataclass

import numpy as np

from lce_rig.core.data import Events

_MAX_FLICKER_BINS = 20_000
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


def measure_flicker(events: Events, bin_ns: int = 1_000_000) -> Flicker:
    """Measure the flicker of lamps in a stretch of about a second.

    Mains lamps flicker at 100 or 120 Hz: all pixels that see them turn brighter together, then darker.

    Args:
        events: at least 0.2 s; of longer stretches the first 20 s are looked at.
        bin_ns: twice the bins' length is the shortest period seen.
    """
    if len(events) < 2:
        return Flicker(0.0, 0.0, 0.0)
    # Events come in order of time: where each bin ends is found without looking at them one by one.
    t_ns = events.t_ns[: np.searchsorted(events.t_ns, events.t_ns[0] + bin_ns * _MAX_FLICKER_BINS)]
    n_bins = int((t_ns[-1] - t_ns[0]) // bin_ns) + 1
    ends = np.searchsorted(t_ns, t_ns[0] + bin_ns * np.arange(1, n_bins + 1))
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
    duration_s = len(signed) * bin_ns * 1e-9
    slowest = int(np.ceil(_MIN_FLICKER_HZ * duration_s))
    # Below four periods a line and its leakage are most of the spectrum.
    if slowest < 4 or len(power) <= slowest + 1 or power.sum() == 0:
        return Flicker(0.0, coherence, 0.0)
    peak = slowest + int(np.argmax(power[slowest:]))
    # A line that falls between two frequencies leaks into both.
    lines = np.unique(np.clip(np.arange(peak, len(power), peak)[:, None] + (-1, 0, 1), 1, len(power) - 1))
    return Flicker(peak / duration_s, coherence, float(power[lines].sum() / power.sum()))
