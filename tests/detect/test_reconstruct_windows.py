"""Where windows of events end."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from moving_board import events_of

from lce_rig.core.errors import UsageError
from lce_rig.detect.events.windows import WindowOptions, active_share, window_rule

MS = 1_000_000


def steady(rate_hz, duration_s, width_px=64, height_px=64, region=(0, 64)):
    n = round(rate_hz * duration_s)
    rng = np.random.default_rng(0)
    t = (np.arange(n) * (1e9 / rate_hz)).astype(np.int64)
    x, y = rng.integers(*region, n), rng.integers(*region, n)
    return events_of(t, x, y, rng.random(n) < 0.5, width_px, height_px)


def test_windows_of_constant_time_end_on_time_whatever_the_rate():
    rule = window_rule(WindowOptions("time", duration_s=0.05), 64, 64, 1.0)
    for rate in (100, 1e5):
        assert rule.end(steady(rate, 0.2), 7 * MS) == 57 * MS
    assert rule.end(steady(1e5, 0.04), 0) is None


@given(st.integers(1, 900))
def test_windows_of_constant_count_hold_that_many_events(n_events):
    events = steady(1e4, 0.1)
    rule = window_rule(WindowOptions("count", n_events=n_events), 64, 64, 1.0)
    end = rule.end(events, 0)
    assert end is not None
    assert len(events.between(0, end)) == n_events


@pytest.mark.parametrize(("rate_hz", "expected_ms"), [(1e3, 60), (3e4, 48), (1e6, 20)])
def test_automatic_windows_follow_the_event_rate_between_20_and_60_ms(rate_hz, expected_ms):
    events = steady(rate_hz, 0.2)
    end = window_rule(WindowOptions(), 64, 64, active_share(events)).end(events, 0)
    assert end == pytest.approx(expected_ms * MS, rel=0.03)


def test_a_small_active_part_gets_proportionally_smaller_windows():
    small = active_share(steady(1e5, 0.1, 256, 256, (32, 96)))
    assert small == pytest.approx(1 / 16, rel=0.05)
    full = window_rule(WindowOptions(), 256, 256, 1.0).n_events
    assert window_rule(WindowOptions(), 256, 256, small).n_events == pytest.approx(full / 4, rel=0.05)


@pytest.mark.parametrize("bad", [{"duration_s": 0.0}, {"duration_s": -1.0}, {"n_events": 0}])
def test_windows_that_never_end_are_refused(bad):
    with pytest.raises(UsageError):
        WindowOptions("time", **bad)
