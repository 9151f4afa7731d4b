"""An event camera's pixels: each fires when its low-pass filtered ln(intensity) crosses a threshold.

References:
    P. Lichtsteiner, C. Posch and T. Delbruck, A 128x128 120 dB 15 us latency asynchronous temporal contrast
        vision sensor, IEEE JSSC 43(2), 2008.
    H. Rebecq, D. Gehrig and D. Scaramuzza, ESIM: an open event camera simulator, CoRL 2018.
    Y. Hu, S.-C. Liu and T. Delbruck, v2e: from video frames to realistic DVS events, CVPRW 2021.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from lce_rig.core.camera import Intrinsics
from lce_rig.core.data import Events
from lce_rig.core.geometry import Array
from lce_rig.simulate.options import EventNoise
from lce_rig.simulate.scene import join_rows

_NS_PER_US = 1000
# Least drawn threshold, change of log intensity: at 0 a pixel would send events without end.
_LEAST_THRESHOLD = 0.05
# A pixel in the dark keeps this share of the bandwidth that full white gives it: the photoreceptor's bias.
_DARK_BANDWIDTH = 0.1
_HOT_HZ, _HOT_ON_SHARE = (10.0, 300.0), 0.95


class EventPixels(NamedTuple):
    """The differences between pixels, fixed for a sensor.

    Attributes:
        width_px, height_px: size of the sensor.
        threshold_on, threshold_off: (P,) by row-major pixel.
        hot_hz: (P,) spontaneous events per second.
    """

    width_px: int
    height_px: int
    threshold_on: Array
    threshold_off: Array
    hot_hz: Array


def draw_pixels(intrinsics: Intrinsics, noise: EventNoise, rng: np.random.Generator) -> EventPixels:
    """Draw a sensor's pixels."""
    n = intrinsics.width_px * intrinsics.height_px
    spread = noise.threshold_sigma * rng.standard_normal((2, n))
    means = np.array([[noise.threshold_on], [noise.threshold_off]])
    on, off = np.maximum(means + spread, np.minimum(means, _LEAST_THRESHOLD))
    hot_hz = np.zeros(n)
    hot = rng.choice(n, round(noise.hot_share * n), replace=False)
    hot_hz[hot] = _HOT_HZ[0] * (_HOT_HZ[1] / _HOT_HZ[0]) ** rng.random(len(hot))
    return EventPixels(intrinsics.width_px, intrinsics.height_px, on, off, hot_hz)


@dataclass(frozen=True, eq=False)
class _Raw:
    """Events of unsorted pixels: time in s after the start, pixel and sign."""

    t_s: Array
    pixel: NDArray[np.intp]
    polarity: NDArray[np.bool_]


class EventCamera:
    """An event camera: converts the scene's intensities, in order of time, to events.

    Args:
        pixels: the sensor.
        noise: the sensor's errors.
        radiance: (H, W) linear intensity at the start, to which the pixels have settled.
        start_ns: time of the start, on the rig's clock.
        rng: source of noise.
        sensor: name in the rig profile.
        offset_ns: excess of its timestamps over the rig's clock.
    """

    def __init__(
        self,
        pixels: EventPixels,
        noise: EventNoise,
        radiance: NDArray[np.float32],
        start_ns: int,
        rng: np.random.Generator,
        *,
        sensor: str = "cam",
        offset_ns: int = 0,
    ) -> None:
        self._pixels, self._noise, self._rng = pixels, noise, rng
        self._sensor, self._start_ns, self._offset_ns = sensor, start_ns, offset_ns
        self._on, self._off = pixels.threshold_on.copy(), pixels.threshold_off.copy()
        self._now_s = 0.0
        self._input = self._log(radiance)
        self._output = self._input.copy()
        self._reference = self._input.copy()
        n = len(self._input)
        if noise.leak_hz > 0:
            # Pixels have leaked for a long time: each is somewhere on its way to its next event.
            self._reference -= pixels.threshold_on * rng.random(n)
        self._released_s = np.zeros(n)  # a pixel is blind until then
        self._last_s = np.full(n, -np.inf)  # when it last made an event
        self._raw: list[_Raw] = []
        self._taken_s = 0.0
        self._darkness = 1.0 / (1.0 + np.clip(radiance.ravel(), 0.0, 1.0).astype(np.float64))

    def _log(self, radiance: NDArray[np.float32]) -> Array:
        seen = np.log(radiance.ravel() + np.float32(self._noise.dark_radiance))
        return np.asarray(seen, dtype=np.float64)

    def see(self, radiance: NDArray[np.float32], t_ns: int) -> None:
        """Ramp ln(intensity) linearly from the previous image to `radiance` (H, W) at t_ns."""
        now_s, start_s = 1e-9 * (t_ns - self._start_ns), self._now_s
        seen = self._log(radiance)
        # A ramp passes each pixel's low-pass exactly: y' = (x - y) / tau with x = x0 + k t has the solution
        # x - k tau + (y0 - x0 + k tau) exp(-t / tau).
        output = seen
        if np.isfinite(self._noise.cutoff_hz):
            intensity = np.clip(radiance.ravel(), 0.0, 1.0)
            bandwidth = _DARK_BANDWIDTH + (1 - _DARK_BANDWIDTH) * intensity
            tau_s = 1.0 / (2 * np.pi * self._noise.cutoff_hz * bandwidth)
            lag = (seen - self._input) * (tau_s / (now_s - start_s))
            decay = np.exp(-(now_s - start_s) / tau_s)
            output = np.asarray(seen - lag + (self._output - self._input + lag) * decay)
        leak_per_s = self._noise.leak_hz * self._pixels.threshold_on
        # The difference that the pixel compares, at the start of the step, and its slope:
        # e(t) = excess + slope t.
        excess = self._output - self._reference
        slope = (output - self._output) / (now_s - start_s) + leak_per_s
        begin_s = self._released_s - start_s
        is_waking = begin_s > 0
        # A pixel's reference is its signal at the moment it is released from its refractory period.
        excess = np.where(is_waking, -slope * begin_s, excess)
        end_excess = excess + slope * (now_s - start_s)
        is_blind = begin_s > now_s - start_s
        self._reference = np.where(is_blind, self._reference, output - end_excess)
        fires = (end_excess >= self._on) | (end_excess <= -self._off)
        pixel = np.flatnonzero(fires & ~is_blind)
        self._fire(pixel, excess[pixel], slope[pixel], end_excess[pixel] > 0, start_s, now_s, output)
        self._input, self._output, self._now_s = seen, output, now_s

    def _fire(
        self,
        pixel: NDArray[np.intp],
        excess: Array,
        slope: Array,
        is_on: NDArray[np.bool_],
        start_s: float,
        now_s: float,
        output: Array,
    ) -> None:
        """Generate the events of pixels (M,) whose excess + slope t (M,) passes their threshold by now_s."""
        if not len(pixel):
            return
        threshold = np.where(is_on, self._on[pixel], self._off[pixel])
        sign = np.where(is_on, 1.0, -1.0)
        # By rounding, a pixel at its threshold may have no slope, or the wrong sign.
        rate = np.maximum(sign * slope, 1e-9)
        first_s = start_s + np.clip((threshold - sign * excess) / rate, 0.0, now_s - start_s)
        # After its first event a pixel starts from zero: the others follow at a constant distance.
        apart_s = self._noise.refractory_s + threshold / rate
        n_more = np.floor((now_s - first_s) / apart_s).astype(np.int64)
        n = n_more + 1
        number = np.arange(n.sum()) - np.repeat(np.cumsum(n) - n, n)
        t_s = np.repeat(first_s, n) + number * np.repeat(apart_s, n)
        # Draw the change that triggers the next event of pixels (M,).
        if self._noise.event_sigma > 0:
            change = self._noise.event_sigma * self._rng.standard_normal((2, len(pixel)))
            self._on[pixel] = np.maximum(self._pixels.threshold_on[pixel] + change[0], _LEAST_THRESHOLD)
            self._off[pixel] = np.maximum(self._pixels.threshold_off[pixel] + change[1], _LEAST_THRESHOLD)
        self._raw.append(_Raw(np.minimum(t_s, now_s), np.repeat(pixel, n), np.repeat(is_on, n)))
        released_s = first_s + n_more * apart_s + self._noise.refractory_s
        self._released_s[pixel] = released_s
        self._reference[pixel] = output[pixel] - slope * np.maximum(now_s - released_s, 0.0)

    def take(self) -> Events:
        """Return the events since the last call, in order of time, noise included."""
        # Events without a cause: shot noise, more of it in the dark, and hot pixels'.
        hot_hz, start_s, end_s = self._pixels.hot_hz, self._taken_s, self._now_s
        summed_hz = np.cumsum(self._noise.noise_hz * 2 * self._darkness + hot_hz)
        n = self._rng.poisson(summed_hz[-1] * (end_s - start_s))
        t_s = self._rng.uniform(start_s, end_s, n)
        pixel = np.searchsorted(summed_hz, self._rng.uniform(0.0, summed_hz[-1], n), side="right")
        pixel = np.minimum(pixel, len(summed_hz) - 1)
        on_share = np.where(hot_hz[pixel] > 0, _HOT_ON_SHARE, 0.5)
        noise = _Raw(t_s, pixel, self._rng.random(n) < on_share)
        together = join_rows([*self._raw, noise])
        self._raw, self._taken_s = [], self._now_s
        order = np.lexsort((together.polarity, together.pixel, together.t_s))
        t_s, pixel, polarity = together.t_s[order], together.pixel[order], together.polarity[order]
        # Events within their pixel's refractory period are dropped.
        order = np.argsort(pixel, kind="stable")
        by_pixel, by_time = pixel[order], t_s[order]
        is_first = np.diff(by_pixel, prepend=-1) != 0
        before_s = np.append(-np.inf, by_time[:-1])[: len(order)]
        before_s = np.where(is_first, self._last_s[by_pixel], before_s)
        keep = np.empty(len(order), dtype=np.bool_)
        keep[order] = by_time - before_s >= self._noise.refractory_s * (1 - 1e-9)
        self._last_s[by_pixel] = by_time  # the last of each pixel stands at its end
        t_ns = self._start_ns + self._offset_ns + np.rint(1e9 * t_s[keep]).astype(np.int64)
        row, column = np.divmod(pixel[keep], self._pixels.width_px)
        return Events(
            self._sensor,
            t_ns // _NS_PER_US * _NS_PER_US,
            column.astype(np.uint16),
            row.astype(np.uint16),
            polarity[keep],
            self._pixels.width_px,
            self._pixels.height_px,
            int(t_ns[0]) if len(t_ns) else None,
        )
