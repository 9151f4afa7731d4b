"""Event pixels follow their own law exactly when quiet, and err as they claim to when not."""

from dataclasses import replace

import numpy as np
import pytest

from lce_rig.core.camera import Intrinsics
from lce_rig.core.data import Events
from lce_rig.simulate.event_camera import EventCamera, draw_pixels
from lce_rig.simulate.options import EventNoise

from .conftest import QUIET_EVENTS

LENS = Intrinsics(60.0, 60.0, 31.5, 23.5, 64, 48)
SHAPE = (48, 64)

START_NS = 1_700_000_000_000_000_000
SECOND_NS = 1_000_000_000


def ripples(seed=0):
    """Smoothly varying intensities, different for each pixel, by a factor of up to twenty."""
    rng = np.random.default_rng(seed)
    swing, rate, phase = rng.uniform(0.1, 1.5, SHAPE), rng.uniform(3, 20, SHAPE), rng.uniform(0, 6.3, SHAPE)
    return lambda t_s: np.exp(swing * np.sin(rate * t_s + phase) - 1.6).astype(np.float32)


def flat(value):
    return lambda t_s: np.full(SHAPE, value, dtype=np.float32)


def record(noise, scene, *, duration_s=0.5, step_s=0.002, seed=0, n_packets=1, pixels=None, offset_ns=0):
    pixels = pixels or draw_pixels(LENS, noise, np.random.default_rng(seed))
    camera = EventCamera(
        pixels, noise, scene(0.0), START_NS, np.random.default_rng(seed), sensor="dvs", offset_ns=offset_ns
    )
    packets = []
    n_steps = round(duration_s / step_s)
    for k in range(1, n_steps + 1):
        camera.see(scene(k * step_s), START_NS + round(1e9 * k * step_s))
        if k % (n_steps // n_packets) == 0:
            packets.append(camera.take())
    return packets


def pixel_of(events):
    return events.y.astype(np.int64) * events.width_px + events.x


def counts(events, polarity):
    chosen = events.polarity == polarity
    return np.bincount(pixel_of(events)[chosen], minlength=SHAPE[0] * SHAPE[1]).astype(float)


def logs(scene, noise, t_s):
    return np.log(scene(t_s).astype(np.float64).ravel() + noise.dark_radiance)


def intervals_ns(events):
    order = np.lexsort((events.t_ns, pixel_of(events)))
    same = np.diff(pixel_of(events)[order]) == 0
    return np.diff(events.t_ns[order])[same]


@pytest.mark.parametrize("sigma", [0.0, 0.05])
def test_quiet_pixels_follow_the_intensity(sigma):
    noise = replace(QUIET_EVENTS, threshold_sigma=sigma)
    pixels, scene = draw_pixels(LENS, noise, np.random.default_rng(4)), ripples()
    for duration_s in (0.1, 0.37, 0.5):
        (events,) = record(noise, scene, duration_s=duration_s, pixels=pixels)
        told = pixels.threshold_on * counts(events, True) - pixels.threshold_off * counts(events, False)
        change = logs(scene, noise, duration_s) - logs(scene, noise, 0.0)
        assert np.all(np.abs(change - told) <= np.maximum(pixels.threshold_on, pixels.threshold_off) + 1e-5)
        assert len(events) > 1000


def test_ramp_gives_an_event_per_threshold():
    def ramp(t_s):
        left = np.arange(SHAPE[1]) < 32
        up = 0.1 * np.exp(4.01 * t_s * 0.30)
        down = 0.1 * np.exp(-4.01 * t_s * 0.25)
        return np.where(left, up, down).astype(np.float32) * np.ones(SHAPE, dtype=np.float32)

    noise = replace(QUIET_EVENTS, dark_radiance=0.0)
    (events,) = record(noise, ramp, duration_s=1.0)
    assert np.all(events.polarity == (events.x < 32))
    assert np.all(counts(events, True) + counts(events, False) == 4)
    expected_s = np.arange(1, 5) / 4.01
    first = events.select(pixel_of(events) == 0)
    assert np.allclose(1e-9 * (first.t_ns - START_NS), expected_s, atol=1e-4)


def test_events_are_ordered_microseconds():
    packets = record(EventNoise(), ripples(), n_packets=10)
    t_ns = np.concatenate([packet.t_ns for packet in packets])
    assert np.all(np.diff(t_ns) >= 0)
    assert np.all(t_ns % 1000 == 0)
    assert t_ns[0] >= START_NS and t_ns[-1] <= START_NS + SECOND_NS // 2
    assert {packet.sensor for packet in packets} == {"dvs"}
    assert {(packet.width_px, packet.height_px) for packet in packets} == {(64, 48)}
    assert max(int(packet.x.max()) for packet in packets) == 63


def test_no_pixel_fires_within_its_refractory_period():
    fast = ripples(1)
    noise = EventNoise(refractory_s=0.004, noise_hz=20.0, threshold_on=0.1, threshold_off=0.1)
    packets = record(noise, lambda t_s: fast(4 * t_s), n_packets=7)
    together = [np.concatenate([getattr(p, k) for p in packets]) for k in ("t_ns", "x", "y", "polarity")]
    events = Events("dvs", *together, 64, 48)
    assert len(events) > 10_000
    assert intervals_ns(events).min() >= 4_000_000 - 1000
    free = record(replace(noise, refractory_s=0.0), lambda t_s: fast(4 * t_s))[0]
    assert np.mean(intervals_ns(free) < 4_000_000) > 0.1


def test_slow_pixels_lag_behind_and_dark_ones_more():
    def step(level):
        return lambda t_s: flat(level if t_s <= 0.01 else 1.3 * level)(t_s)

    delay_s = []
    for level in (0.7, 0.1):
        noise = replace(QUIET_EVENTS, cutoff_hz=50.0, threshold_on=0.1, dark_radiance=0.0)
        (events,) = record(noise, step(level), duration_s=0.2, step_s=0.001)
        assert np.all(counts(events, True) == 2) and events.polarity.all()
        delay_s.append(1e-9 * (events.t_ns[-1] - START_NS) - 0.01)
    # 1 - exp(-t/tau) = 0.2 / ln 1.3, with 1 / tau = 2 pi 50 Hz (0.1 + 0.9 I) after the step.
    expected = [-np.log(1 - 0.2 / np.log(1.3)) / (2 * np.pi * 50 * (0.1 + 0.9 * 1.3 * i)) for i in (0.7, 0.1)]
    assert np.allclose(delay_s, expected, atol=1e-3)


def test_noise_has_its_rate_and_increases_in_the_dark():
    noise = replace(QUIET_EVENTS, noise_hz=10.0)
    halves = np.where(np.arange(SHAPE[1]) < 32, 0.0, 1.0).astype(np.float32) * np.ones(SHAPE, np.float32)
    (events,) = record(noise, lambda t_s: halves, duration_s=2.0, step_s=0.05)
    rate_hz = [np.sum((events.x < 32) == dark) / (2.0 * np.prod(SHAPE) / 2) for dark in (True, False)]
    assert rate_hz == pytest.approx([20.0, 10.0], rel=0.05)
    assert events.polarity.mean() == pytest.approx(0.5, abs=0.02)


def test_thresholds_spread_as_configured():
    """From pixel to pixel, and from event to event."""
    noise = replace(QUIET_EVENTS, threshold_sigma=0.04)
    pixels = draw_pixels(LENS, noise, np.random.default_rng(0))
    assert pixels.threshold_on.mean() == pytest.approx(noise.threshold_on, abs=0.004)
    assert pixels.threshold_on.std() == pytest.approx(0.04, rel=0.05)
    assert abs(np.corrcoef(pixels.threshold_on, pixels.threshold_off)[0, 1]) < 0.1

    def rise(t_s):
        return 0.01 * np.exp(np.float32(10 * t_s)) * flat(1.0)(0)

    steady, shaky = (
        record(replace(QUIET_EVENTS, dark_radiance=0.0, event_sigma=s), rise, duration_s=0.4)[0]
        for s in (0.0, 0.03)
    )
    assert intervals_ns(steady).std() < 1e5
    assert intervals_ns(shaky).std() * 10e-9 == pytest.approx(0.03, rel=0.1)
