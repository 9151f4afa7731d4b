"""What a rig delivers, as samples of noise that are quick to make, and a bag of them read back."""

import numpy as np

from lce_rig.core.data import Events, Image, Scan
from lce_rig.io import SourceOptions, open_recording
from lce_rig.io.events import open_events
from lce_rig.io.recording import ContinuousRecording
from lce_rig.io.ros.bag_recorder import BagRecorder

T0_NS = 1_700_000_000_123_456_789
KINDS = ["recording.bag", "recording"]
"""A bag of ROS 1, and one of ROS 2."""


def opened(path, rig, **options):
    recording = open_recording(path, rig, SourceOptions(**options))
    assert isinstance(recording, ContinuousRecording)
    return recording


def sweep(k):
    """A scan of a round room in the order of firing, at 10 Hz, that arrives when it is complete."""
    azimuth = np.linspace(np.pi, -np.pi, 400, endpoint=False).repeat(16)
    ring = np.tile(np.arange(16), 400)
    radius = 4 + np.sin(3 * azimuth + k)
    z = radius * np.tan(np.radians(2 * ring - 15.0))
    points = np.stack([radius * np.cos(azimuth), radius * np.sin(azimuth), z], axis=1).astype(np.float32)
    offset_ns = np.arange(400).repeat(16) * 221_184 + ring * 2_304
    stamp_ns = T0_NS + k * 100_000_000
    intensity = (ring * 3.5).astype(np.float32)
    return Scan(
        "lidar", stamp_ns, points, intensity, ring.astype(np.int16), offset_ns, stamp_ns + 100_000_000
    )


def picture(k, shape=(260, 346)):
    pixels = np.random.default_rng(k).integers(0, 256, shape, dtype=np.uint8)
    stamp_ns = T0_NS + k * 50_000_001
    return Image("davis", "frames", stamp_ns, pixels, stamp_ns + 7_000_000)


def packet(k, n=4000):
    """20 ms of events, whole microseconds."""
    rng = np.random.default_rng(k)
    t_ns = (T0_NS // 1000 + k * 20_000 + np.sort(rng.integers(0, 20_000, n))) * 1000
    x, y = rng.integers(0, 346, n).astype(np.uint16), rng.integers(0, 260, n).astype(np.uint16)
    return Events("davis", t_ns, x, y, rng.random(n) < 0.5, 346, 260, int(t_ns[0]) + 3_000_000)


def one_second(n_events=4000):
    """Everything a rig delivers in a second, in the order of arrival; so many events in each packet."""
    packets = [packet(k, n_events) for k in range(50)]
    samples = [*map(sweep, range(10)), *map(picture, range(20)), *packets]
    return sorted(samples, key=lambda sample: sample.host_ns or 0)


def record(path, rig, samples):
    with BagRecorder(path, rig) as recorder:
        for sample in samples:
            recorder.write(sample)
    return path


def read(path, rig, options=None):
    recording = open_recording(path, rig, options)
    samples = list(recording.samples())
    return [s for s in samples if isinstance(s, Image)], [s for s in samples if isinstance(s, Scan)]


def read_events(path):
    parts = list(open_events(path, sensor="davis", resolution=(346, 260)))
    return {n: np.concatenate([getattr(p, n) for p in parts]) for n in ("t_ns", "x", "y", "polarity")}
