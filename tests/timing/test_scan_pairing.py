"""Streams of several sensors become frames."""

from dataclasses import replace

import numpy as np

from lce_rig.core.data import Image, Scan
from lce_rig.core.findings import Losses
from lce_rig.timing.scan_pairing import PATIENCE_NS, pair_by_time

MS = 1_000_000


def image(time_ms, channel="frames"):
    return Image("cam", channel, round(time_ms * MS), np.zeros((2, 2), np.uint8))


def scan(time_ms, has_times=True):
    """A scan of 100 ms with its middle at `time_ms`."""
    offset_ns = np.array([0, 100 * MS]) if has_times else None
    points, zeros = np.ones((2, 3), np.float32), np.zeros(2)
    return Scan(
        "lidar", round((time_ms - 50) * MS), points, zeros.astype("f4"), zeros.astype("i2"), offset_ns
    )


def pairs(samples, rig):
    counts = Losses()
    frames = list(pair_by_time(samples, rig, counts))
    return [(f.time_ns // MS, [i.stamp_ns // MS for i in f.images]) for f in frames], counts


def alone(losses):
    """Return the number of scans without an image, and the smallest time difference, s."""
    ((finding, n),) = losses.counts()
    assert finding.code == "read.no_image_at_scan"
    return n, round(finding.figures["nearest_s"], 9)


def test_pairing_uses_image_nearest_to_mid_scan(rig):
    pictures = [image(t) for t in (970, 1003, 1036, 1069, 1102, 1135)]
    samples = sorted([scan(1000), scan(1100), *pictures], key=lambda s: s.stamp_ns)
    assert pairs(samples, rig)[0] == [(1000, [1003]), (1100, [1102])]


def test_pairing_untimed_scan_uses_the_rate(rig):
    assert pairs([scan(1000, has_times=False), image(1000)], rig)[0] == [(1000, [1000])]


def test_pairing_late_images_find_their_scan(rig):
    samples = [scan(1000), scan(1100), scan(1200), image(1000), image(1100), image(1200)]
    assert [images for _, images in pairs(samples, rig)[0]] == [[1000], [1100], [1200]]


def test_pairing_outside_limit_is_measured(rig):
    found, losses = pairs([image(900), scan(1000), image(1080)], rig)
    assert found == [] and alone(losses) == (1, 0.08)


def test_silent_camera_blocks_no_pairing(rig):
    samples = [image(1000), *(scan(1000 + 100 * k) for k in range(30))]
    counts = Losses()
    frames = pair_by_time(samples, rig, counts)
    assert next(frames).time_ns == 1000 * MS
    assert list(frames) == [] and alone(counts)[0] == 29
    assert PATIENCE_NS < 29 * 100 * MS


def test_a_clock_set_back_does_not_mix_before_and_after(rig):
    before = [s for k in range(5) for s in (scan(10**7 + 100 * k), image(10**7 + 100 * k))]
    after = [s for k in range(5) for s in (scan(1000 + 100 * k), image(1000 + 100 * k))]
    found, _ = pairs(before + after, rig)
    assert all(images == [time] for time, images in found) and len(found) >= 9


def test_pairing_skips_samples_without_timestamp(rig):
    timeless = Image("cam", "frames", None, np.zeros((2, 2), np.uint8))
    assert pairs([timeless, scan(1000), image(1000)], rig)[0] == [(1000, [1000])]


def test_pairing_lone_scans_report_the_gap(rig):
    samples = sorted([image(1000), scan(1000), scan(1100), scan(1200)], key=lambda s: s.stamp_ns)
    found, losses = pairs(samples, rig)
    assert found == [(1000, [1000])]
    assert alone(losses) == (2, 0.1)


def test_pairing_without_lidar_joins_images_of_two_cameras(rig):
    camera = rig.cameras["cam"]
    both = rig.model_copy(update={"lidars": {}, "cameras": {"cam": camera, "other": camera}})
    samples = [replace(image(t + 10), sensor="other") for t in (1000, 1100)]
    samples += [image(t) for t in (1000, 1100, 1500)]
    losses = Losses()
    frames = list(pair_by_time(sorted(samples, key=lambda s: s.stamp_ns), both, losses))
    assert [[i.sensor for i in f.images] for f in frames] == [["cam", "other"]] * 2
    assert not any(f.scans for f in frames)
    assert [finding.code for finding, _ in losses.counts()] == ["read.no_other"]
