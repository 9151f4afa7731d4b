"""Sensors are watched side by side; one that is absent, or a bug in one driver, keeps no other from it."""

import time

import pytest
from wire.sync_board import FakeBoard

from lce_rig.core.errors import SourceError
from lce_rig.devices.reading import LiveSource, SourceStatus
from lce_rig.devices.sync_board import SyncBoard
from lce_rig.doctor.observing import observe
from lce_rig.rig import load_rig
from lce_rig.rig.profile import SyncSettings

pytestmark = pytest.mark.realtime


class Unusable(LiveSource):
    """A sensor that cannot be opened."""

    def __init__(self, sensor, error):
        super().__init__(sensor, sensor, 5.0)
        self.error = error

    def open(self):
        raise self.error

    def read(self):
        return []

    def close(self):
        pass

    def describe(self):
        return SourceStatus(self.sensor)


class TimedBoard(SyncBoard):
    """A sync board that counts as open once its clock is known and each line has pulsed, on any host."""

    def open(self):
        super().open()
        early = list(self._early)
        while not (self.host_clock and {"cam", "pps"} <= {pulse.sensor for pulse in early}):
            assert not self.is_stopping
            early += self.read()
        self._early = early


ABSENT = Unusable("gone", SourceError("it is not there", "Plug it in."))


def test_observe_failure_keeps_other_sensors():
    with FakeBoard(period_s=0.05) as fake:
        settings = SyncSettings.model_validate(
            {"device": fake.path, "triggers": {"cam": {"channel": 0, "rate_hz": 20.0}}}
        )
        seen = observe([ABSENT, Unusable("bad", ZeroDivisionError("a slip")), TimedBoard(settings)], 0.5)
    assert seen["gone"].failure is not None and seen["gone"].failure is ABSENT.error
    assert seen["bad"].failure is not None and "ZeroDivisionError" in seen["bad"].failure.what
    board = seen["sync"]
    assert board.failure is None and board.status is not None and board.watched_s > 0.4
    assert {pulse.sensor for pulse in board.pulses} == {"cam", "pps"}
    assert board.host_clock is not None


def test_observe_without_sensors_returns_at_once():
    start_s = time.monotonic()
    seen = observe([ABSENT], 60.0)
    assert time.monotonic() - start_s < 30 and seen["gone"].status is None


def test_davis_over_network_counts_events(tmp_path):
    pytest.importorskip("dv_processing")
    from lce_rig.devices.davis import DavisSource
    from tests.devices.test_davis import only_events, over_network, sender

    assert load_rig("rles").cameras["davis"].model == "DAVIS346"
    with sender(10_000) as (_, port):
        seen = observe([DavisSource("davis", only_events(), over_network(port))], 1.0)["davis"]
    assert seen.failure is None
    assert seen.n_events > 0 and seen.n_events % 50 == 0
    assert len(seen.arrivals_ns["events"]) > 1
