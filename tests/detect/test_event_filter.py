"""Noise of event cameras is told from the scene: hot pixels, lone events, flickering lamps."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from lce_rig.core.data import Events
from lce_rig.detect.event_filter import (
    BackgroundActivityFilter,
    find_hot_pixels,
    measure_flicker,
    without_pixels,
)
from lce_rig.sources.events import open_events

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


def merged(*streams: Events) -> tuple[Events, np.ndarray]:
    """Merge streams; also say which of them each event is from."""
    source = np.concatenate([np.full(len(s), i) for i, s in enumerate(streams)])
    t_ns, x, y, polarity = (
        np.concatenate([getattr(s, name) for s in streams]) for name in ("t_ns", "x", "y", "polarity")
    )
    order = np.argsort(t_ns, kind="stable")
    together = Events("events", t_ns[order], x[order], y[order], polarity[order], WIDTH, HEIGHT)
    return together, source[order]


def hot(pixels: list[tuple[int, int]], rate_hz: float, seed: int = 0) -> Events:
    rng = np.random.default_rng(seed)
    n = int(rate_hz)
    x, y = np.repeat(np.array(pixels), n, axis=0).T
    return events_of(rng.uniform(0, 1, len(x)), x, y, rng.random(len(x)) < 0.5)


def test_hot_pixels_are_found_and_the_pixels_of_moving_edges_are_not() -> None:
    pixels = [(0, 0), (159, 119), (30, 5), (31, 5), (80, 60), (81, 61)]
    together, _ = merged(moving_edges(1), noise(2, 0.5), hot(pixels, 200.0))
    found = find_hot_pixels(together)
    assert sorted((x, y) for y, x in np.argwhere(found).tolist()) == sorted(pixels)
    cleaned = without_pixels(together, found)
    assert not find_hot_pixels(cleaned).any()


@pytest.mark.parametrize("seed", range(5))
def test_noise_alone_has_no_hot_pixels(seed: int) -> None:
    assert not find_hot_pixels(noise(seed, 3.0)).any()


def test_no_events_have_no_hot_pixels() -> None:
    none = noise(0, 1.0).select(slice(0, 0))
    assert find_hot_pixels(none).shape == (HEIGHT, WIDTH)
    assert not find_hot_pixels(none).any()


def test_lone_events_go_and_edges_stay() -> None:
    together, source = merged(moving_edges(3), noise(4, 1.0))
    kept = BackgroundActivityFilter().apply(together)
    # Events are told apart by their place in the stream: stamps and pixels together are unique here.
    keys = together.t_ns * WIDTH * HEIGHT + together.y.astype(np.int64) * WIDTH + together.x
    is_kept = np.isin(keys, kept.t_ns * WIDTH * HEIGHT + kept.y.astype(np.int64) * WIDTH + kept.x)
    assert is_kept[source == 0].mean() > 0.99
    # The bars cover two thirds of the picture; above and below them noise has no company.
    outside = (together.y < 19) | (together.y > 100)
    assert is_kept[(source == 1) & outside].mean() < 0.1


@pytest.mark.parametrize("n_parts", [2, 7, 50])
def test_a_stream_in_parts_is_filtered_nearly_as_one(n_parts: int) -> None:
    together, _ = merged(moving_edges(5), noise(6, 1.0))
    whole = len(BackgroundActivityFilter().apply(together))
    in_parts = BackgroundActivityFilter()
    cuts = np.array_split(np.arange(len(together)), n_parts)
    total = sum(len(in_parts.apply(together.select(slice(int(c[0]), int(c[-1]) + 1)))) for c in cuts)
    # Where a part ends inside a slice, its last events do not see what comes after.
    assert total == pytest.approx(whole, rel=0.02)
    assert total <= whole


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
    for scene in (moving_edges(8), noise(9, 5.0), merged(moving_edges(8), noise(9, 1.0))[0]):
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


def test_a_moment_is_no_storm() -> None:
    none = noise(0, 1.0).select(slice(0, 0))
    assert not measure_flicker(none).is_storm
    assert not measure_flicker(noise(0, 1.0).select(slice(0, 3))).is_storm
