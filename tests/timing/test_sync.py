"""Streams on one clock: how far apart pairs are, how well that is known, and whether boards may move."""

import numpy as np
import pytest

from lce_rig.core.data import Events, Image, Scan
from lce_rig.core.losses import Losses
from lce_rig.rig import load_rig
from lce_rig.timing.clock import ClockModel
from lce_rig.timing.clock_fit import TimePairs, fit_clock
from lce_rig.timing.rig_clock import RigClock
from lce_rig.timing.scan_pairing import pair_by_time

MS, S = 1_000_000, 1_000_000_000
UTC_NS = 1_753_000_000 * S


def image(stamp_ns, sensor="cam", channel="frames"):
    return Image(sensor, channel, stamp_ns, np.zeros((2, 2), np.uint8))


def scan(stamp_ns):
    points, zeros = np.ones((2, 3), np.float32), np.zeros(2)
    offset_ns = np.array([0, 100 * MS])
    return Scan("lidar", stamp_ns, points, zeros.astype("f4"), zeros.astype("i2"), offset_ns)


def fitted(seed=0, noise_ns=30_000.0, drift=50e-6):
    """A camera's clock that began 90 s before, fitted to UTC; with its true time."""
    rng = np.random.default_rng(seed)
    times = np.int64(np.arange(100) * 0.1 * S)
    stamps = np.int64(times * (1 + drift)) + 90 * S
    seen = UTC_NS + times + np.int64(rng.normal(scale=noise_ns, size=100))
    model = fit_clock(TimePairs.from_edges(stamps, seen), "edges")
    return model, lambda true_ns: 90 * S + round((true_ns - UTC_NS) * (1 + drift))


@pytest.fixture
def rlfs():
    return load_rig("rlfs")


def clock_of(rig, **models):
    clock = RigClock(rig, has_board=True)
    clock.models.update(models)
    return clock


def test_pairs_are_found_on_the_common_clock_and_say_how_far_apart_they_are(rlfs):
    model, stamp_of = fitted()
    clock = clock_of(rlfs, cam=model, lidar=ClockModel.identity(1000.0, "PPS locked"))
    true_ns = [UTC_NS + 5 * S + k * 100 * MS for k in range(10)]
    samples = []
    for time_ns in true_ns:
        samples += [scan(time_ns - 50 * MS), image(stamp_of(time_ns + 7 * MS))]
    placed = [clock.place(sample) for sample in samples]
    frames = list(pair_by_time(placed, rlfs, Losses()))
    assert len(frames) == 10
    for frame in frames:
        (pair,) = clock.pair_times(frame)
        assert (pair["stream"], pair["lidar"]) == ("cam.frames", "lidar")
        assert abs(pair["difference_s"] - 0.007) < 4 * pair["sigma_s"] < 0.001
        assert pair["tolerance_s"] == 0.05
        assert "-49.6 ppm" in pair["clock"] and "PPS" in pair["clock"]


def test_every_kind_of_sample_is_placed_and_untied_ones_left_as_they_are(rlfs):
    model, stamp_of = fitted(noise_ns=0.0)
    clock = clock_of(rlfs, cam=model)
    stamps = np.array([stamp_of(UTC_NS + k * S) for k in range(5)])
    none = np.zeros(5, np.uint16)
    events = Events("cam", stamps, none, none, none.astype(bool), 4, 4)
    assert np.abs(clock.place(events).t_ns - UTC_NS - np.arange(5) * S).max() < 2000
    assert abs(clock.place(image(int(stamps[2]))).stamp_ns - UTC_NS - 2 * S) < 2000
    assert clock.place(image(5, "other")).stamp_ns == 5
    assert clock.place(image(None)).stamp_ns is None
    clock.models.pop("cam")
    assert clock.place(events) is events


def test_a_rig_with_hardware_sync_and_good_clocks_may_move_its_board(rlfs):
    clock = clock_of(rlfs, cam=fitted()[0], lidar=ClockModel.identity(1000.0, "PPS locked"))
    verdict = clock.verdict()
    assert not verdict.requires_still_boards
    assert (verdict.finding.code, verdict.reasons) == ("sync.boards_may_move", ())


def test_a_rig_without_hardware_sync_needs_still_boards_and_says_why(rlfs):
    camera = rlfs.cameras["cam"]
    frames = camera.channels["frames"]
    free = frames.model_copy(update={"timestamps": frames.timestamps.model_copy(update={"sync": "none"})})
    cameras = {"cam": camera.model_copy(update={"channels": {"frames": free}})}
    verdict = clock_of(
        rlfs.model_copy(update={"cameras": cameras}), lidar=ClockModel.identity(1000.0, "")
    ).verdict()
    assert verdict.requires_still_boards
    (reason,) = verdict.reasons
    assert (reason.code, reason.subject) == ("sync.none_in_profile", "cam")
    assert reason.figures == {"key": "cameras.cam.channels.frames.timestamps.sync"}
    assert verdict.finding.code == "sync.boards_must_stand"


def test_clocks_that_are_not_tied_or_known_too_loosely_need_still_boards(rlfs):
    loose = ClockModel.identity(25e6, "arrivals of packets")
    verdict = clock_of(rlfs, lidar=loose).verdict()
    assert [(found.code, found.subject) for found in verdict.reasons] == [
        ("sync.too_uncertain", "lidar"),
        ("sync.not_tied", "cam"),
    ]
    assert verdict.reasons[0].figures == {"sigma_ms": pytest.approx(25), "limit_ms": pytest.approx(10)}
