"""One thread writes captures and recordings: what is vital first, and nothing waits for a slow disk."""

import threading
from pathlib import Path

import pytest

from lce_rig.core.errors import SessionError
from lce_rig.devices.disk_writer import DiskWriter

HERE = Path("somewhere")


def test_vital_items_overtake_others_and_each_sink_keeps_its_order():
    written = []
    may_go = threading.Event()

    def write(item):
        may_go.wait(10)
        written.append(item)

    with DiskWriter() as disk:
        captures, samples = disk.add(HERE, write, is_vital=True), disk.add(HERE, write)
        for item in ("a", "b", "c"):
            samples.put(item, 1)
        captures.put("first")
        captures.put("second")
        assert captures.n_waiting == 2 and samples.n_waiting
        may_go.set()
    assert [item for item in written if item not in "abc"] == ["first", "second"]
    assert [item for item in written if item in "abc"] == ["a", "b", "c"]
    assert written.index("second") <= 2, "one sample at most was being written already"
    assert captures.n_waiting == 0 and (captures.n_written, samples.n_written) == (2, 3)


def test_what_a_slow_disk_cannot_take_is_dropped_counted_and_said(tmp_path):
    path = tmp_path / "raw"
    with path.open("wb") as file, DiskWriter(most_waiting_bytes=100_000) as disk:
        sink = disk.add(path, file.write)
        for _ in range(40_000):
            sink.put(bytes(1206), 1206)
    assert sink.n_written + sink.n_dropped == 40_000 and sink.n_dropped > 0
    assert path.stat().st_size == sink.n_written * 1206
    (finding,) = sink.findings()
    assert (finding.code, finding.figures["n"]) == ("device.recording_incomplete", sink.n_dropped)


def test_a_sink_that_fails_takes_nothing_more_and_the_others_go_on():
    def fail(_item):
        raise OSError(28, "No space left on device")

    with DiskWriter() as disk:
        full, other = disk.add(HERE, fail), disk.add(HERE, lambda _item: None)
        for k in range(5):
            full.put(k)
            other.put(k)
    assert (full.n_written, other.n_written) == (0, 5)
    assert [finding.code for finding in full.findings()] == ["device.recording_stopped"]


def test_a_vital_sink_that_fails_is_an_error_but_not_over_another():
    def fail(_item):
        raise SessionError("the disk is gone")

    with pytest.raises(SessionError, match="gone"), DiskWriter() as disk:
        disk.add(HERE, fail, is_vital=True).put(1)
    with pytest.raises(KeyError), DiskWriter() as disk:
        disk.add(HERE, fail, is_vital=True).put(1)
        raise KeyError


def test_sinks_are_finished_after_their_last_item():
    done = []
    with DiskWriter() as disk:
        disk.add(HERE, done.append, lambda: done.append("finished")).put("item")
        disk.close()
        assert done == ["item", "finished"]
    assert done == ["item", "finished"]
