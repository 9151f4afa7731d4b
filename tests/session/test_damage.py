"""Earlier captures survive any failure of disk or process, and damage is reported."""

import signal
import subprocess
import sys
import time

import numpy as np
import pytest

from lce_rig.core.data import Events
from lce_rig.core.errors import SessionError
from lce_rig.session import Session
from tests.shared import changed, files_up_to

WRITER = """
import sys, numpy as np
from lce_rig.core.data import Events, Image, Scan
from lce_rig.rig import load_rig
from lce_rig.session import Session
session = Session.resume(sys.argv[1], load_rig("rles"))
print("ready", flush=True)
rng = np.random.default_rng(len(session.captures))
while True:
    image = Image("davis", "frames", 1, rng.integers(0, 256, (120, 160), dtype=np.uint8))
    points = rng.normal(size=(5000, 3)).astype(np.float32)
    scan = Scan("lidar", 1, points, points[:, 0].copy(), np.zeros(5000, np.int16))
    x, y = (rng.integers(0, 260, 5000).astype(np.uint16) for _ in range(2))
    events = Events("davis", np.sort(rng.integers(0, 10**9, 5000)), x, y, x > y, 346, 260)
    print(session.add_capture([image], [scan], {}, [events]), flush=True)
"""


@pytest.mark.long
def test_killed_writer_leaves_whole_captures(tmp_path):
    path = tmp_path / "s"
    promised = set()
    for k in range(6):
        # The writer's standard output lists the captures reported as saved before it was killed.
        process = subprocess.Popen(
            [sys.executable, "-c", WRITER, str(path)], stdout=subprocess.PIPE, text=True
        )
        assert process.stdout is not None and process.stdout.readline() == "ready\n"
        promised.add(process.stdout.readline().strip())
        time.sleep(0.0031 * k)
        process.send_signal(signal.SIGKILL)
        promised.update(process.stdout.read().split())
        process.stdout.close()
        assert process.wait() == -signal.SIGKILL
        captures = Session.open(path).captures
        for capture in captures:
            capture.check()
            assert capture.image("davis", "frames").pixels.shape == (120, 160)
            assert len(capture.events("davis")) == 5000
        assert promised <= {c.name for c in captures}
    assert len(promised) >= 6
    Session.open(path, writable=True).close()
    assert not list((path / "captures").glob(".new-*"))


def test_add_capture_full_disk_loses_nothing(tmp_path, rig, samples):
    session = Session.create(tmp_path / "s", rig)
    session.add_capture(*samples(0), {})
    with files_up_to(2000), pytest.raises(SessionError):
        session.add_capture(*samples(1), {})
    assert [p.name for p in (tmp_path / "s" / "captures").iterdir()] == ["000000"]
    assert session.add_capture(*samples(1), {}) == "000001"


@pytest.mark.parametrize("name", ["cam.frames.png", "lidar.pcd", "cam.events.npz", "meta.json"])
def test_every_damaged_byte_is_noticed_and_the_file_named(tmp_path, rig, samples, name):
    camera = rig.cameras["cam"]
    rig = changed(rig, cameras__cam__channels__events=changed(camera.channels["frames"], kind="events"))
    width, height = camera.resolution_px
    t_ns, x = 1000 * np.arange(500), np.arange(500).astype(np.uint16)
    events = [Events("cam", t_ns, x, x, x > 9, width, height)]
    session = Session.create(tmp_path / "s", rig)
    session.add_capture(*samples(0), {}, events)
    session.add_capture(*samples(1), {}, events)
    file = session.captures[0].path / name
    whole = file.read_bytes()
    flipped = [
        whole[:position] + bytes([whole[position] ^ 128]) + whole[position + 1 :]
        for position in (0, 30, len(whole) // 2, len(whole) - 1)
    ]
    for damaged in (*flipped, b"", whole[:-3]):
        file.write_bytes(damaged)
        with pytest.raises(SessionError, match=name):
            session.captures[0].check()
    file.unlink()
    with pytest.raises(SessionError, match=name):
        session.captures[0].check()
    session.captures[1].check()


def test_missing_sample_error_lists_present_ones(tmp_path, rig, samples):
    session = Session.create(tmp_path / "s", rig)
    session.add_capture(*samples(0), {})
    with pytest.raises(SessionError, match=r"cam\.frames"):
        session.captures[0].scan("top")
    with pytest.raises(SessionError, match="000007"):
        session.capture("000007")


def test_file_as_session_is_not_a_full_disk(tmp_path, rig):
    (tmp_path / "s").write_text("a note")
    for path in (tmp_path / "s", tmp_path / "s/below"):
        with pytest.raises(SessionError) as caught:
            Session.resume(path, rig)
        assert "Make room" not in str(caught.value)
