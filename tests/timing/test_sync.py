"""Streams on one clock: time differences of pairs, their uncertainty, and whether boards may move."""

import numpy as np
import pytest

from lce_rig.core.data import Events, Image, Pulse, Scan
from lce_rig.core.findings import Losses
from lce_rig.timing.clock import ClockModel
from lce_rig.timing.clock_fit import fit_clock
from lce_rig.timing.rig_clock import EdgeClock, RigClock
from lce_rig.timing.scan_pairing import pair_by_time
from tests.shared import changed

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
    model = fit_clock(stamps, seen, "edges")
    return model, lambda true_ns: 90 * S + round((true_ns - UTC_NS) * (1 + drift))


def clock_of(rig, **models):
    clock = RigClock(rig, has_board=True)
    clock.models.update(models)
    return clock


def test_pairs_are_found_on_the_common_clock(rlfs):
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
        (late_ns,) = (each.stamp_ns - frame.time_ns for each in frame.images)
        assert abs(late_ns - 7 * MS) < 4 * model.inverse().sigma_ns(frame.time_ns) < MS


def test_sync_places_samples_of_known_clocks(rlfs):
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


def test_sync_good_clocks_may_move_boards(rlfs):
    clock = clock_of(rlfs, cam=fitted()[0], lidar=ClockModel.identity(1000.0, "PPS locked"))
    verdict = clock.verdict()
    assert not verdict.requires_still_boards
    assert (verdict.finding.code, verdict.reasons) == ("sync.boards_may_move", ())


def test_sync_without_hardware_needs_still(rlfs):
    free = changed(rlfs, cameras__cam__channels__frames__timestamps__sync="none")
    verdict = clock_of(free, lidar=ClockModel.identity(1000.0, "")).verdict()
    assert verdict.requires_still_boards
    (reason,) = verdict.reasons
    assert (reason.code, reason.subject) == ("sync.none_in_profile", "cam")
    assert reason.figures == {"key": "cameras.cam.channels.frames.timestamps.sync"}
    assert verdict.finding.code == "sync.boards_must_stand"


def test_sync_loose_clocks_need_still_boards(rlfs):
    loose = ClockModel.identity(25e6, "arrivals of packets")
    verdict = clock_of(rlfs, lidar=loose).verdict()
    assert [(found.code, found.subject) for found in verdict.reasons] == [
        ("sync.too_uncertain", "lidar"),
        ("sync.not_tied", "cam"),
    ]
    assert verdict.reasons[0].figures == {"sigma_ms": pytest.approx(25), "limit_ms": pytest.approx(10)}


HOST_NS = 1_753_000_000 * S


def coarse(error_ms):
    """From the camera's Unix time to the board's, as the computer knows it when the camera is opened."""
    return ClockModel(HOST_NS, 77 * S + round(error_ms * MS), 0.0, np.zeros((2, 2)), 0, 0, 0, 0, 0, "host")


def run(
    seed=0, period_s=0.05, n=400, error_ms=3.0, drift=60e-6, lost=0.0, unseen=0.0, bounces=0.0, bound_ms=15
):
    rng = np.random.default_rng(seed)
    clock = EdgeClock("davis", bound_ms * MS)
    clock.set_clock(coarse(error_ms))
    for k in range(n):
        true_ns = round(k * period_s * S)
        if rng.uniform() >= lost:
            clock.take_sent(Pulse("davis", 77 * S + true_ns // 1000 * 1000, k, 0))
        if rng.uniform() >= unseen:
            seen_ns = HOST_NS + round(true_ns * (1 + drift) + rng.uniform(0, 2000)) // 1000 * 1000
            clock.take_seen(Pulse("davis", seen_ns, k, 0))
            if rng.uniform() < bounces:
                clock.take_seen(Pulse("davis", seen_ns + 4000, k, 0))
        if k % 50 == 49:
            clock.fit()
    return clock, clock.fit()


@pytest.mark.parametrize("faults", [{}, {"lost": 0.2, "unseen": 0.2, "bounces": 0.1}, {"error_ms": -12.0}])
def test_edges_tie_the_camera_to_the_board(faults):
    for seed in range(5):
        clock, model = run(seed, **faults)
        assert clock.problem is None
        assert model.drift == pytest.approx(-60e-6, abs=0.1e-6)
        true_ns = 10 * S
        error_ns = model.convert(HOST_NS + round(true_ns * 1.00006)) - 77 * S - true_ns
        assert abs(error_ns) < 2000


def test_edges_too_quick_are_refused():
    clock, model = run(bound_ms=30)
    assert model is None
    assert clock.problem.code == "edges.too_close"
    assert clock.problem.figures == {"sigma_ms": 30, "period_ms": 50}


def test_sync_unrelated_edges_are_refused():
    rng = np.random.default_rng(0)
    clock = EdgeClock("davis", 5 * MS)
    clock.set_clock(coarse(0))
    for k in range(200):
        clock.take_sent(Pulse("davis", 77 * S + k * 50 * MS, k, 0))
    for k, time in enumerate(np.sort(rng.uniform(0, 10, 200))):
        clock.take_seen(Pulse("davis", HOST_NS + round(time * S), k, 0))
    assert clock.fit() is None
    assert clock.problem.code == "edges.not_the_pulses"


def test_sync_restarted_board_is_fitted_again():
    clock, _ = run(n=100)
    for k in range(100):
        clock.take_sent(Pulse("davis", k * 50 * MS, k, 0))
    assert clock.fit() is None
    clock.set_clock(ClockModel(HOST_NS, 0, 0.0, np.zeros((2, 2)), 0, 0, 0, 0, 0, "host"))
    for k in range(100):
        clock.take_seen(Pulse("davis", HOST_NS + k * 50 * MS, k, 0))
    assert abs(clock.fit().drift) < 1e-7
