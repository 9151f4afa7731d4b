"""Choice of a sensor's driver; order of samples, reason for the end, and reconnection."""

import time

import pytest

from lce_rig.core.data import Pulse
from lce_rig.core.errors import SourceError
from lce_rig.devices import driver_of, open_live, sensors, source_of
from lce_rig.devices.reading import AttachedSensors, LiveSource, RateMeter, SourceStatus
from lce_rig.rig import load_rig
from tests.devices.attached import attached
from tests.shared import changed

HINT = "Check the plug."


def pulse(count):
    return Pulse("cam", count, count, 0)


class Script(LiveSource):
    """A device that returns given entries, one per call; errors are raised; then nothing."""

    def __init__(self, *entries, name="s", n_slots=9, silence_s=60.0):
        super().__init__(name, f"sensor {name!r}", silence_s, HINT, n_slots)
        self.entries = list(entries)
        self.is_open = False

    def open(self):
        self.is_open = True

    def read(self):
        if not self.entries:
            time.sleep(0.01)
            return []
        entry = self.entries.pop(0)
        if isinstance(entry, Exception):
            raise entry
        return entry

    def close(self):
        self.is_open = False

    def describe(self):
        return SourceStatus(self.sensor)


def counts(samples):
    return [sample.count for sample in samples if isinstance(sample, Pulse)]


def test_reading_error_follows_the_samples():
    with attached(Script([pulse(0), pulse(1)], [pulse(2)], SourceError("gone"))) as (source, samples):
        came = []
        with pytest.raises(SourceError, match="gone"):
            came.extend(samples)
        assert [each.count for each in came if isinstance(each, Pulse)] == [0, 1, 2]
        assert source.status().n_samples == 3
    assert not source.is_open


def test_reading_silence_is_an_error_with_hint():
    with attached(Script(silence_s=0.1)) as (_, samples), pytest.raises(SourceError) as caught:
        counts(samples)
    assert caught.value.hint == HINT


def test_reading_oldest_samples_are_dropped():
    came = []
    with attached(Script(n_slots=4)) as (source, samples):
        source.entries += [[pulse(k) for k in range(10)], SourceError("gone")]
        while source.status().n_samples < 10:
            time.sleep(0.005)
        with pytest.raises(SourceError, match="gone"):
            for sample in samples:
                came.append(sample)
        assert (source.status().n_samples, source.status().n_dropped) == (10, 6)
    assert [sample.count for sample in came if isinstance(sample, Pulse)] == [6, 7, 8, 9]


def test_reading_driver_bug_is_source_error():
    with (
        attached(Script([pulse(0)], ZeroDivisionError("oops"))) as (_, samples),
        pytest.raises(SourceError) as caught,
    ):
        counts(samples)
    assert isinstance(caught.value.__cause__, ZeroDivisionError)


def test_reading_failed_sensor_is_reopened():
    """Samples of the other sensors are not lost."""
    lossy = Script([pulse(0)], SourceError("gone"), [pulse(1)])
    steady = Script(*[[pulse(k)] for k in range(5)], name="t")
    with AttachedSensors([lossy, steady], reopen_every_s=0.05) as sensors:
        came = [each for each in (sensors.take(60.0) for _ in range(7)) if each is not None]
        by_name = {
            name: [each.count for key, each in came if key == name and isinstance(each, Pulse)]
            for name in "st"
        }
        assert by_name == {"s": [0, 1], "t": [0, 1, 2, 3, 4]}
        assert not sensors.lost()
        assert {name: status.n_dropped for name, status in sensors.statuses().items()} == {"s": 0, "t": 0}


def test_attach_early_overflow_is_no_loss():
    class Slow(Script):
        def open(self):
            while early.entries:
                time.sleep(0.005)

    early, late = Script([pulse(k) for k in range(100)], n_slots=64), Slow([pulse(0)], name="t")
    with AttachedSensors([early, late]) as sensors:
        assert sensors.take(60.0) == ("s", pulse(36))  # the newest 64 of 100
        assert sensors.statuses()["s"].n_dropped == 0


def test_reading_close_ends_a_reopening():
    class Absent(Script):
        """A permanently lost device: opening it waits until asked to stop."""

        n_opened = 0

        def open(self):
            self.n_opened += 1
            while self.n_opened > 1 and not self.is_stopping:
                time.sleep(0.001)
            super().open()

    source = Absent(SourceError("gone"))
    with AttachedSensors([source], reopen_every_s=0.0) as sensors:
        while source.n_opened < 2:
            time.sleep(0.005)
        assert sensors.lost()
    assert not source.is_open


def test_rate_meter_falls_without_samples():
    clock_s = [100.0]
    meter = RateMeter(lambda: clock_s[0])
    assert meter.rate_hz == 0
    for _ in range(21):
        clock_s[0] += 0.1
        meter.add(5)
    assert meter.rate_hz == pytest.approx(50)
    clock_s[0] += 0.1
    assert meter.rate_hz == pytest.approx(50)
    clock_s[0] += 0.8
    assert meter.rate_hz < 40
    clock_s[0] += 3
    assert meter.rate_hz == 0


@pytest.mark.parametrize(
    ("rig", "sources"),
    [
        ("rlfs", [("lidar", "Vlp16Source"), ("cam", "V4l2Source")]),
        ("rles", [("lidar", "Vlp16Source"), ("davis", "DavisSource")]),
    ],
)
def test_the_shipped_rigs_get_their_drivers(rig, sources):
    made = [(source.sensor, type(source).__name__) for source in open_live(load_rig(rig))]
    assert made[:2] == sources
    assert all(name == "SyncBoard" for _, name in made[2:])


@pytest.mark.parametrize(
    ("changes", "source"),
    [
        ({"driver__type": None, "driver__command": ("true",), "driver__device": None}, "ImagePipeSource"),
        ({"driver__type": "v4l2"}, "V4l2Source"),
        ({"driver__type": "ros2"}, "Ros2Source"),
    ],
)
def test_the_profile_may_choose_the_driver(changes, source):
    rig = load_rig("rlfs")
    rig = changed(rig, cameras__cam=changed(rig.cameras["cam"], **changes))
    assert type(open_live(rig)[1]).__name__ == source


@pytest.mark.parametrize("wanted", ["v4l", "vlp16", "sync_board"])
def test_open_live_unknown_driver_is_refused(wanted):
    """The other sensors can still be opened."""
    rig = changed(load_rig("rlfs"), cameras__cam__driver__type=wanted)
    with pytest.raises(SourceError) as caught:
        open_live(rig)
    assert repr(wanted) in caught.value.what and "v4l2, command, davis" in caught.value.hint
    assert sensors(rig)[:2] == ["lidar", "cam"] and source_of(rig, "lidar").sensor == "lidar"


def test_unknown_lidar_model_has_no_driver():
    rig = load_rig("rlfs")
    unknown = changed(rig, lidars__lidar__model="XY-32", lidars__lidar__driver__type=None)
    with pytest.raises(SourceError) as caught:
        driver_of(unknown, "lidar")
    assert "XY-32" in caught.value.what
    assert driver_of(changed(rig, lidars__lidar__model="Puck LITE"), "lidar") == "vlp16"
