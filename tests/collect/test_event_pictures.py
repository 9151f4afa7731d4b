"""Pictures for cameras without frames: one for the middle of every sweep, from all events up to it."""

from dataclasses import replace

import numpy as np
import pytest

from lce_rig.collect.event_pictures import with_event_pictures
from lce_rig.core.data import Image, Scan
from lce_rig.core.findings import Losses
from lce_rig.detect.events.reconstructor import Reconstructor
from lce_rig.io.recording import merge_by_time
from lce_rig.rig import load_rig

from .event_sightings import T0_NS, event_stream

MS = 1_000_000


@pytest.fixture(scope="module")
def rig():
    return load_rig("rles")


def scan(time_ms):
    """A sweep of 100 ms whose middle is at `time_ms`."""
    offset_ns, zeros = np.array([0, 100 * MS]), np.zeros(2, np.float32)
    stamp_ns = T0_NS + round((time_ms - 50) * MS)
    return Scan("lidar", stamp_ns, np.ones((2, 3), np.float32), zeros, zeros.astype("i2"), offset_ns)


EVENTS = event_stream([(0.0, 2.0, 0.5)])
MIDDLES_MS = range(750, 1950, 100)


def pictures(samples, rig, tally=None):
    found = list(with_event_pictures(samples, rig, ["davis"], tally or Losses()))
    return [sample for sample in found if isinstance(sample, Image)]


@pytest.fixture(scope="module")
def given(rig):
    """Events and scans in the order of their timestamps."""
    return list(merge_by_time([EVENTS, map(scan, MIDDLES_MS)], rig))


@pytest.fixture(scope="module")
def passed(rig, given):
    return list(with_event_pictures(given, rig, ["davis"], Losses()))


def test_event_images_match_whole_stream(given, passed):
    assert [s for s in passed if not isinstance(s, Image)] == given
    found = [s for s in passed if isinstance(s, Image)]
    stamps_ns = [T0_NS + t * MS for t in MIDDLES_MS]
    truth = list(Reconstructor().reconstruct(EVENTS, stamps_ns))
    assert [(i.sensor, i.channel, i.stamp_ns) for i in found] == [("davis", "events", t) for t in stamps_ns]
    for image, other in zip(found, truth, strict=True):
        assert isinstance(other, Image) and np.array_equal(image.pixels, other.pixels)


@pytest.mark.parametrize("late_ms", [120, pytest.param(700, marks=pytest.mark.long)])
def test_event_images_late_scans_are_equal(rig, passed, late_ms):
    whole = replace(
        EVENTS[0],
        **{n: np.concatenate([getattr(e, n) for e in EVENTS]) for n in ("t_ns", "x", "y", "polarity")},
    )
    cut = [whole.select(slice(k, k + 3000)) for k in range(0, len(whole), 3000)]
    arrivals = [(int(e.t_ns[0]), k, e) for k, e in enumerate(cut)]
    arrivals += [(T0_NS + (t - 50 + late_ms) * MS, 10_000 + t, scan(t)) for t in MIDDLES_MS]
    late = pictures((sample for *_, sample in sorted(arrivals, key=lambda arrival: arrival[:2])), rig)
    prompt = [sample for sample in passed if isinstance(sample, Image)]
    assert [i.stamp_ns for i in late] == [i.stamp_ns for i in prompt]
    assert all(np.array_equal(a.pixels, b.pixels) for a, b in zip(late, prompt, strict=True))


def test_event_images_early_scans_counted(rig):
    tally = Losses()
    scans = [scan(t) for t in range(-2950, 800, 100)]
    found = pictures(merge_by_time([EVENTS, scans], rig), rig, tally)
    assert [i.stamp_ns for i in found] == [T0_NS + t * MS for t in (750,)]
    counts = {refusal.code: n for refusal, n in tally.counts()}
    assert counts == {"read.no_events_at_scan": 30, "read.network_settling": 7}


def test_event_images_clock_set_back_skipped(rig):
    tally = Losses()
    given = [*EVENTS[:30], scan(1050), scan(1150), *EVENTS[30:], scan(550), scan(1950)]
    found = pictures(given, rig, tally)
    assert [i.stamp_ns for i in found] == [T0_NS + t * MS for t in (1050, 1150, 1950)]
    ((said, n),) = tally.counts()
    assert (said.code, n) == ("read.events_gone_by", 1)
