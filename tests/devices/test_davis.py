"""The DAVIS on dv-processing's own objects: from a file that it wrote, and live over its own network."""

import inspect
import re
import socket
import subprocess
import sys
import time
from contextlib import contextmanager
from datetime import timedelta
from itertools import islice

import numpy as np
import pytest

from lce_rig.core.data import Events, Image, Pulse
from lce_rig.core.errors import SourceError
from lce_rig.core.findings import Finding
from lce_rig.devices import davis
from lce_rig.devices.davis import DavisSource, OpenedCamera, bias_of, number_of
from lce_rig.rig import load_rig
from tests.devices.attached import attached

dv = pytest.importorskip("dv_processing")
START_US = 1_763_733_600_000_000
SIZE = (346, 260)
INTERVAL_US, EXPOSURE_US = 40_000, 4_001


def camera(**changes):
    return load_rig("rles").cameras["davis"].model_copy(update=changes)


def only_events():
    return camera(channels={"events": camera().channels["events"]})


def store(start_us, n=500):
    rng = np.random.default_rng(start_us % 1000)
    events = dv.EventStore()
    for k, (x, y) in enumerate(zip(rng.integers(0, 346, n), rng.integers(0, 260, n), strict=True)):
        events.push_back(start_us + 20 * k, int(x), int(y), bool(k % 3))
    return events


def edges(start_us):
    kinds = (
        "APS_EXPOSURE_START",
        "EXTERNAL_SIGNAL_RISING_EDGE",
        "EXTERNAL_SIGNAL_FALLING_EDGE",
        "APS_FRAME_END",
    )
    triggers = [dv.Trigger(start_us + 100 * k, getattr(dv.TriggerType, kind)) for k, kind in enumerate(kinds)]
    return dv.TriggerPacket(dv.TriggerPacket.TriggersVector(triggers))


@pytest.fixture
def recording(tmp_path):
    """A file with all streams: 8 x 10 ms of events, 8 frames of which one is missing, 8 trigger edges."""
    config = dv.io.MonoCameraWriter.Config("DAVIS346_00000499")
    config.addEventStream(SIZE)
    config.addFrameStream(SIZE)
    config.addImuStream()
    config.addTriggerStream()
    writer = dv.io.MonoCameraWriter(str(tmp_path / "davis.aedat4"), config)
    for k in range(8):
        now_us = START_US + INTERVAL_US * k
        writer.writeEvents(store(now_us))
        grey = np.full(SIZE[::-1], 10 * k, np.uint8)
        if k != 5:
            writer.writeFrame(dv.Frame(now_us, EXPOSURE_US, 0, 0, grey, dv.FrameSource.SENSOR))
        writer.writeTriggerPacket(edges(now_us))
    del writer
    return tmp_path / "davis.aedat4"


A_NOTE = Finding("clock.trigger_input_off", "warning")


def playing(path, device="DAVIS346_00000499"):
    return lambda sensor, settings: OpenedCamera(
        dv.io.MonoCameraRecording(str(path)), device, (A_NOTE,), "00000499"
    )


def play(path, settings):
    """Read a file to its end, as if it were a camera that is then unplugged."""
    came = []
    with (
        attached(DavisSource("davis", settings, playing(path))) as (source, samples),
        pytest.raises(SourceError, match="DAVIS346_00000499"),
    ):
        came.extend(samples)
    return came, source


def test_davis_file_returns_all_written_data(recording):
    came, source = play(recording, camera())
    events = [sample for sample in came if isinstance(sample, Events)]
    t_us = np.concatenate([part.t_ns for part in events]) // 1000
    written = [store(START_US + INTERVAL_US * k).numpy() for k in range(8)]
    assert (t_us == np.concatenate([part["timestamp"] for part in written])).all()
    for name in ("x", "y", "polarity"):
        ours = np.concatenate([getattr(part, name) for part in events])
        assert (ours == np.concatenate([part[name] for part in written])).all()
    assert {(part.sensor, part.width_px, part.height_px) for part in events} == {("davis", 346, 260)}
    assert source.status().serial == "00000499"


def test_davis_images_are_timestamped_at_mid_exposure(recording):
    came, source = play(recording, camera())
    images = [sample for sample in came if isinstance(sample, Image)]
    starts_us = [START_US + INTERVAL_US * k for k in range(8) if k != 5]
    assert [image.stamp_ns for image in images] == [1000 * t + 500 * EXPOSURE_US for t in starts_us]
    assert [int(image.pixels[7, 9]) for image in images] == [10 * k for k in range(8) if k != 5]
    assert {(image.channel, image.pixels.shape) for image in images} == {("frames", SIZE[::-1])}
    assert source.status().n_lost == 1


def test_davis_rising_edges_are_pulses(recording):
    came, _ = play(recording, camera())
    pulses = [sample for sample in came if isinstance(sample, Pulse)]
    assert [pulse.stamp_ns for pulse in pulses] == [
        1000 * (START_US + INTERVAL_US * k + 100) for k in range(8)
    ]
    assert [pulse.count for pulse in pulses] == list(range(8))
    assert {pulse.sensor for pulse in pulses} == {"davis"}


def test_davis_timestamps_far_from_host_clock_are_a_problem(recording):
    _, source = play(recording, camera())
    status = source.status()
    assert status.problems[0] == A_NOTE and status.problems[1].code == "clock.differs_from_computer"
    assert status.device == "DAVIS346_00000499"
    assert status.clock is not None and status.clock.code == "clock.davis"


def test_davis_of_other_size_is_refused(recording):
    small = camera(resolution_px=(240, 180))
    with (
        attached(DavisSource("davis", small, playing(recording))) as (_, samples),
        pytest.raises(SourceError, match="240x180"),
    ):
        list(samples)


def test_davis_clock_reset_is_no_pulse(tmp_path):
    """Colour images stay BGR."""
    config = dv.io.MonoCameraWriter.Config("DAVIS346_00000499")
    config.addEventStream(SIZE)
    config.addFrameStream(SIZE)
    config.addTriggerStream()
    writer = dv.io.MonoCameraWriter(str(tmp_path / "davis.aedat4"), config)
    pixels = np.zeros((260, 346, 3), np.uint8)
    pixels[:, :, 0] = 200
    writer.writeFrame(dv.Frame(START_US, 1000, 0, 0, pixels, dv.FrameSource.SENSOR))
    reset = dv.Trigger(START_US, dv.TriggerType.TIMESTAMP_RESET)
    writer.writeTriggerPacket(dv.TriggerPacket(dv.TriggerPacket.TriggersVector([reset])))
    del writer
    (image,), _ = play(tmp_path / "davis.aedat4", camera())
    assert isinstance(image, Image) and (image.pixels == pixels).all()
    assert image.stamp_ns == 1000 * START_US + 500_000


SENDER = """
import sys, time
import dv_processing as dv
stream = dv.io.Stream.EventStream(0, "events", "DAVIS346_00000499", (346, 260))
writer = dv.io.NetworkWriter("127.0.0.1", int(sys.argv[1]), stream)
print("ready", flush=True)
while writer.getClientCount() == 0:
    time.sleep(0.01)
for _ in range(int(sys.argv[2])):
    events, now_us = dv.EventStore(), time.time_ns() // 1000
    for k in range(50):
        events.push_back(now_us + k, k, k, True)
    writer.writeEvents(events)
    time.sleep(0.02)
time.sleep(60)
"""


@contextmanager
def sender(n_batches):
    """A process that sends events live, as dv-processing's network writer does."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    command = [sys.executable, "-c", SENDER, str(port), str(n_batches)]
    with subprocess.Popen(command, stdout=subprocess.PIPE) as process:
        try:
            assert process.stdout.readline() == b"ready\n"
            yield process, port
        finally:
            process.kill()


def over_network(port):
    return lambda sensor, settings: OpenedCamera(dv.io.NetworkReader("127.0.0.1", port), "a sender")


@pytest.mark.realtime
def test_davis_live_lost_sender_is_an_error():
    """Until then events arrive with a delay of less than 500 ms."""
    with (
        sender(10_000) as (process, port),
        attached(DavisSource("davis", only_events(), over_network(port))) as (source, samples),
    ):
        came = [sample for sample in islice(samples, 10) if isinstance(sample, Events)]
        status = source.status()
        process.kill()
        with pytest.raises(SourceError, match="a sender") as caught:
            list(samples)
    assert sum(len(part) for part in came) == 500
    assert all(abs(part.host_ns - int(part.t_ns[0])) < 10**9 for part in came if part.host_ns)
    assert status.problems == ()
    assert status.rates_hz["events"] > 0
    assert status.clock is not None and abs(status.clock.figure("delay_ms")) < 500
    assert "Check cable" in caught.value.hint


@pytest.mark.realtime
def test_davis_missing_stream_is_an_error():
    with sender(1) as (_, port):
        source = DavisSource("davis", camera(), over_network(port))
        with pytest.raises(SourceError, match="'frames'"), attached(source):
            pass


@pytest.mark.skipif(bool(dv.io.camera.discover()), reason="a camera is attached")
@pytest.mark.parametrize(("device", "name"), [(None, "DAVIS"), ("DAVIS346_00000499", "DAVIS 00000499")])
def test_without_a_camera_there_is_one_clear_error(device, name):
    settings = camera(driver=camera().driver.model_copy(update={"device": device}))
    with pytest.raises(SourceError) as caught, attached(DavisSource("davis", settings)):
        pass
    assert "'davis'" in caught.value.what and f" no {name} is " in caught.value.what
    assert "lsusb" in caught.value.hint and "udev" in caught.value.hint


def test_every_call_to_a_camera_exists_in_dv_processing():
    source = inspect.getsource(davis)
    called = set(re.findall(r"[( ]camera\.(\w+)", source[source.index("def open_davis") :]))
    assert len(called) >= 15
    assert [name for name in sorted(called) if not hasattr(dv.io.camera.DAVIS, name)] == []
    for name in ("cameraModel", "serialNumber"):
        assert hasattr(dv.io.camera.USBDevice.DeviceDescriptor, name)
    asked = set(re.findall(r"_input\.(\w+)", inspect.getsource(DavisSource)))
    assert len(asked) >= 9
    assert [name for name in sorted(asked) if not hasattr(dv.io.camera.DAVIS, name)] == []


def test_davis_invalid_controls_are_named():
    assert number_of("davis", "exposure_us", 4000) * timedelta(microseconds=1) == timedelta(milliseconds=4)
    for value in (True, "long", 0, -3):
        with pytest.raises(SourceError, match=r"driver\.controls\.exposure_us"):
            number_of("davis", "exposure_us", value)
    assert bias_of("davis", "bias_on", "4, 39") == (4, 39)
    for value in ("4", "8,1", "1,256", "a,b", 4):
        with pytest.raises(SourceError, match="bias_on"):
            bias_of("davis", "bias_on", value)


@pytest.mark.hardware
def test_an_attached_davis_sends_all_its_streams():
    with attached(DavisSource("davis", camera())) as (source, samples):
        ends_s = time.monotonic() + 3
        came = []
        for sample in samples:
            came.append(sample)
            if time.monotonic() > ends_s:
                break
        status = source.status()
    assert any(isinstance(sample, Events) for sample in came)
    assert any(isinstance(sample, Image) for sample in came)
    assert status.clock is not None and abs(status.clock.figure("delay_ms")) < 100
    assert status.problems == ()
