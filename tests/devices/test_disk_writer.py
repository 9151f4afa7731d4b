"""A thread writes captures, another a recording: nothing waits for a slow disk."""

import threading
from pathlib import Path

import pytest

from lce_rig.collect.live.capture_writer import CaptureWriter
from lce_rig.core.errors import LceRigError
from lce_rig.devices.disk_writer import DiskWriter
from lce_rig.rig import load_rig
from lce_rig.session import Session

HERE = Path("somewhere")


def test_disk_writer_keeps_order_unwaited():
    written, may_go = [], threading.Event()

    def write(item):
        may_go.wait(60)
        written.append(item)

    with DiskWriter(HERE, write, lambda: written.append("finished")) as disk:
        for item in ("a", "b", "c"):
            disk.put(item)
        assert disk.n_waiting == 3
        may_go.set()
        disk.close()
        assert written == ["a", "b", "c", "finished"]
    assert written == ["a", "b", "c", "finished"]
    assert (disk.n_waiting, disk.n_written) == (0, 3)


def test_disk_writer_slow_disk_drops_counted(tmp_path):
    path, may_go = tmp_path / "raw", threading.Event()
    with path.open("wb") as file:

        def write(item):
            may_go.wait(60)
            file.write(item)

        with DiskWriter(path, write, most_waiting_bytes=100_000) as disk:
            for _ in range(1000):
                disk.put(bytes(1206), 1206)
            may_go.set()
    assert disk.n_written + disk.n_dropped == 1000 and disk.n_dropped > 900
    assert path.stat().st_size == disk.n_written * 1206
    (finding,) = disk.findings()
    assert (finding.code, finding.figures["n"]) == ("device.recording_incomplete", disk.n_dropped)


def test_failed_disk_writer_accepts_nothing():
    def fail(_item):
        raise OSError(28, "No space left on device")

    with DiskWriter(HERE, fail) as disk:
        for k in range(5):
            disk.put(k)
    assert (disk.n_written, disk.n_waiting) == (0, 0)
    assert [finding.code for finding in disk.findings()] == ["device.recording_stopped"]


def test_capture_writer_keeps_first_error(tmp_path):
    with Session.create(tmp_path / "session", load_rig("rlfs")) as session:
        keeper = CaptureWriter(session)
        with pytest.raises(KeyError), keeper.disk:
            keeper.take_back("000001")  # there is none
            raise KeyError
        with pytest.raises(LceRigError, match="000001"):
            keeper.close()
