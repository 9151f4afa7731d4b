"""Flickering lamps are told from moving edges and from noise."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from lce_rig.core.data import Events
from lce_rig.detect.events.reconstruct.filters import measure_flicker
from lce_rig.io.events import open_events

WIDTH, HEIGHT = 160, 120


def events_of(t_s: np.ndarray, x: np.ndarray, y: np.ndarray, polarity: np.ndarray) -> Events:
    order = np.argsort(t_s, kind="stable")
    t_ns = np.rint(t_s[order] * 1e6).astype(np.int64) * 1000
    x, y = x[order].astype(np.uint16), y[order].astype(np.uint16)
    return Events("events", t_ns, x, y, polarity[order].astype(bool), WIDTH, HEIGHT)


def moving_edges(seed: int, duration_s: float = 1.0, speed_px_s: float = 300.0) -> Events:
    """Vertical bars that cross the picture: their front edges brighten, their rear edges darken."""
    rng = np.random.default_rng(seed)
    x, y = np.meshgrid(np.arange(WIDTH), np.arange(20, 100))
    x, y = x.ravel(), y.ravel()
    parts = []
    for edge, polarity in ((0, True), (8, False), (30, True), (38, False)):
        for again in range(int(speed_px_s * duration_s / 60)):
            t_s = (x + edge + 60 * again) / speed_px_s + rng.normal(0, 5e-4, len(x))
            parts.append((t_s, x, y, np.full(len(x), polarity)))
    t_s, x, y, polarity = (np.concatenate(column) for column in zip(*parts, strict=True))
    keep = (t_s > 0) & (t_s < duration_s)
    return events_of(t_s[keep], x[keep], y[keep], polarity[keep])


def noise(seed: int, rate_hz: float, duration_s: float = 1.0) -> Events:
    rng = np.random.default_rng(seed)
    n = rng.poisson(rate_hz * WIDTH * HEIGHT * duration_s)
    x, y = rng.integers(0, WIDTH, n), rng.integers(0, HEIGHT, n)
    return events_of(rng.uniform(0, duration_s, n), x, y, rng.random(n) < 0.5)


def merged(*streams: Events) -> Events:
    t_ns, x, y, polarity = (
        np.concatenate([getattr(s, name) for s in streams]) for name in ("t_ns", "x", "y", "polarity")
    )
    order = np.argsort(t_ns, kind="stable")
    return Events("events", t_ns[order], x[order], y[order], polarity[order], WIDTH, HEIGHT)


def test_lamps_that_flicker_are_told_from_motion() -> None:
    rng = np.random.default_rng(7)
    n = 200_000
    phase = rng.uniform(0, 1, n)
    t_s = (rng.integers(0, 100, n) + phase) / 100
    storm = events_of(t_s, rng.integers(0, WIDTH, n), rng.integers(0, HEIGHT, n), phase < 0.5)
    flicker = measure_flicker(storm)
    assert flicker.is_storm
    assert flicker.frequency_hz == pytest.approx(100.0, abs=2.0)
    assert flicker.coherence > 0.9
    for scene in (moving_edges(8), noise(9, 5.0), merged(moving_edges(8), noise(9, 1.0))):
        assert not measure_flicker(scene).is_storm


def test_events_of_one_polarity_alone_are_a_storm() -> None:
    scene = noise(9, 5.0)
    assert measure_flicker(replace(scene, polarity=np.ones(len(scene), bool))).is_storm
    sparse = noise(9, 0.02)
    assert not measure_flicker(sparse).is_storm


@pytest.mark.dataset
@pytest.mark.parametrize(
    ("name", "is_storm"), [("event_packet_ros1.bag", True), ("davis346_apriltag_libcaer_cmp.mcap", False)]
)
def test_a_real_room_with_mains_light_is_told_from_one_without(
    recordings: Path, name: str, is_storm: bool
) -> None:
    if not (recordings / "events").is_dir():
        pytest.skip("no recordings of events")
    recording = open_events(recordings / "events" / name)
    first_ns, last_ns = recording.span_ns
    flicker = measure_flicker(recording.read(first_ns, last_ns))
    assert flicker.is_storm == is_storm
    if is_storm:
        assert flicker.frequency_hz == pytest.approx(120.0, abs=1.0)
