"""Offset and drift of clocks: truth within the stated sigmas, jumps detected, hours completed."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lce_rig.timing.clock import HOUR_NS, ClockModel, resolve_hour
from lce_rig.timing.clock_fit import ClockTracker, fit_clock, match_edges

START_NS = 1_753_000_000_123_456_789
S = 1_000_000_000


class Device:
    """A device with a clock that starts at a given host time and runs faster than the host's by `drift`."""

    def __init__(self, drift, offset_ns=5 * S):
        self.drift, self.offset_ns = drift, offset_ns

    def stamp_ns(self, elapsed_ns):
        """Read it, in whole microseconds, at times since START_NS."""
        elapsed_ns = np.asarray(elapsed_ns)
        return np.int64(elapsed_ns * (1 + self.drift) + self.offset_ns) // 1000 * 1000

    def host_ns(self, stamp_ns):
        """The exact host time of a device time."""
        return START_NS + round((stamp_ns - self.offset_ns) / (1 + self.drift))

    def error_sigmas(self, model, stamp_ns):
        return (model.convert(stamp_ns) - self.host_ns(stamp_ns)) / model.sigma_ns(stamp_ns)


def exchanges(rng, device, n=100, span_s=10.0, way_ns=73_000.0, jitter_ns=100_000.0):
    """Requests over a shared machine: ways of unequal length, usual jitter, a few that waited for long."""
    sent = np.sort(rng.uniform(0, span_s, n)) * S
    share = rng.uniform()
    there = 2 * way_ns * share + rng.exponential(jitter_ns, n) * np.where(rng.uniform(size=n) < 0.05, 20, 1)
    back = 2 * way_ns * (1 - share) + rng.exponential(jitter_ns, n)
    back *= np.where(rng.uniform(size=n) < 0.03, 200, 1)
    received = sent + there + 20_000 + back
    sent_ns, received_ns = START_NS + np.int64(sent), START_NS + np.int64(received)
    rx_ns, tx_ns = device.stamp_ns(sent + there), device.stamp_ns(sent + there + 20_000)
    bound_ns = np.maximum((received_ns - sent_ns) - (tx_ns - rx_ns), 0) / 2
    return rx_ns + (tx_ns - rx_ns) // 2, sent_ns + (received_ns - sent_ns) // 2, bound_ns


def edges(rng, device, n=60, period_s=0.5, noise_ns=20_000.0):
    times = np.arange(n) * period_s * S
    seen = START_NS + np.int64(times + rng.normal(scale=noise_ns, size=n))
    return device.stamp_ns(times), seen


def rms(values):
    return float(np.sqrt(np.mean(np.square(values))))


@pytest.mark.parametrize("where_s", [0.0, 5.0, 10.0, 40.0])
def test_clock_requests_error_fits_sigma(where_s):
    sigmas = []
    for seed in range(100):
        rng = np.random.default_rng(seed)
        device = Device(drift=rng.normal(scale=40e-6))
        source_ns, reference_ns, bound_ns = exchanges(rng, device)
        model = fit_clock(source_ns, reference_ns, "time requests", bound_ns)
        sigmas.append(device.error_sigmas(model, int(device.stamp_ns(where_s * S))))
    # Ways that differ by all of their length are rarer than the model allows for.
    assert 0.5 < rms(sigmas) < 1.2


@pytest.mark.parametrize("where_s", [0.0, 15.0, 29.5])
def test_clock_edges_error_matches_sigma(where_s):
    sigmas = []
    for seed in range(300):
        device = Device(drift=-25e-6)
        model = fit_clock(*edges(np.random.default_rng(seed), device), "edges")
        sigmas.append(device.error_sigmas(model, int(device.stamp_ns(where_s * S))))
    assert 0.85 < rms(sigmas) < 1.2


def test_clock_model_allows_later_drift_change():
    device = Device(drift=40e-6)
    model = fit_clock(*edges(np.random.default_rng(0), device), "edges")
    later = model.last_ns + 600 * S
    warmer = device.host_ns(model.last_ns) + round(600 * S / (1 + 41e-6))
    assert abs(model.convert(later) - warmer) < 2 * model.sigma_ns(later)
    assert model.sigma_ns(later) > 10 * model.sigma_ns(model.last_ns)


def test_clock_fit_tolerates_20_percent_false_edges():
    for seed in range(20):
        rng = np.random.default_rng(seed)
        device = Device(drift=40e-6)
        source_ns, reference_ns = edges(rng, device, n=100)
        wrong = rng.choice(100, 20, replace=False)
        reference_ns[wrong] += np.int64(rng.uniform(5e6, 500e6, 20))
        model = fit_clock(source_ns, reference_ns, "edges")
        assert abs(device.error_sigmas(model, model.anchor_ns)) < 4


def test_too_few_readings_make_no_model():
    assert fit_clock(*edges(np.random.default_rng(0), Device(0.0), n=3), "edges") is None
    assert fit_clock(np.zeros(0, np.int64), np.zeros(0, np.int64), "edges") is None
    assert fit_clock(np.full(9, S), np.full(9, START_NS), "edges") is None


def test_clock_chained_models_add_errors():
    camera, board = Device(40e-6, 7 * S), Device(-90e-6, 2 * S)
    sigmas = []
    for seed in range(200):
        rng = np.random.default_rng(seed)
        times = np.arange(80) * 0.3 * S
        noisy = camera.stamp_ns(times + rng.normal(scale=30_000, size=80))
        to_board = fit_clock(noisy, board.stamp_ns(times), "edges")
        through = to_board.then(fit_clock(*edges(rng, board), "edges"))
        stamp_ns = int(camera.stamp_ns(20 * S))
        sigmas.append(camera.error_sigmas(through, stamp_ns))
    assert 0.85 < rms(sigmas) < 1.2
    assert "80 edges" in through.origin and "60 edges" in through.origin


def test_match_edges_survives_losses_bounces():
    rng = np.random.default_rng(3)
    device = Device(40e-6)
    times = np.arange(200) * 0.05 * S
    coarse = ClockModel(0, START_NS - 5 * S + 4_000_000, 0.0, np.zeros((2, 2)), 0, 0, 0, 0, 0, "start")
    seen = rng.uniform(size=200) < 0.8
    bounced = np.sort(np.concatenate([times[seen], times[seen][::7] + 3000]))
    made = rng.uniform(size=200) < 0.9
    pairs = match_edges(device.stamp_ns(bounced), START_NS + np.int64(times[made]), coarse, 10e6)
    assert len(pairs[0]) == (seen & made).sum()
    model = fit_clock(*pairs, "edges")
    assert abs(model.drift - (1 / 1.00004 - 1)) < 0.2e-6


def followed(rng, jump_ns, at_s, what="host"):
    tracker, device = ClockTracker("time requests"), Device(40e-6)
    readings = exchanges(rng, device, n=300, span_s=30.0)
    for source, reference, bound in zip(*(each.tolist() for each in readings), strict=True):
        after = reference - START_NS > at_s * S
        moved = (
            (source, reference + jump_ns * after) if what == "host" else (source - jump_ns * after, reference)
        )
        tracker.add(*moved, bound)
    return tracker, device, tracker.steps


@pytest.mark.parametrize("jump_ns", [3 * S, -3 * S, 20_000_000, -2_000_000])
def test_clock_set_host_is_noticed_once(jump_ns):
    for seed in range(5):
        tracker, device, steps = followed(np.random.default_rng(seed), jump_ns, at_s=20)
        assert len(steps) == 1
        assert steps[0].size_ns == pytest.approx(jump_ns, abs=1_000_000)
        stamp_ns = int(device.stamp_ns(30 * S))
        error_ns = tracker.model.convert(stamp_ns) - device.host_ns(stamp_ns) - jump_ns
        assert abs(error_ns) < 4 * tracker.model.sigma_ns(stamp_ns)


def test_clock_device_restart_is_noticed():
    tracker, _, steps = followed(np.random.default_rng(0), 15 * S, at_s=15, what="device")
    assert [round(step.size_ns / S) for step in steps] == [15]
    assert tracker.model.first_ns >= steps[0].source_ns


def test_clock_tracker_drops_old_readings():
    tracker = ClockTracker("edges")
    for k in range(2_000):
        tracker.add(k * S // 10, START_NS + k * S // 10)
    assert tracker.model.first_ns >= 139 * S


@given(st.integers(0, 3 * 10**18), st.integers(-HOUR_NS // 2 + 1, HOUR_NS // 2 - 1))
def test_resolve_hour_within_half_an_hour(true_ns, error_ns):
    assert resolve_hour(true_ns % HOUR_NS, true_ns + error_ns) == true_ns
