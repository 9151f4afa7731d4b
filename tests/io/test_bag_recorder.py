"""What a rig delivers is recorded as bags that our readers, and others', give back as it was."""

import tracemalloc
from dataclasses import replace

import numpy as np
import pytest

from lce_rig.core.data import Events, Image, Scan
from lce_rig.core.errors import SourceError
from lce_rig.io import open_recording
from lce_rig.io.ros.bag_recorder import BagRecorder
from tests.shared import changed, files_up_to

from .rig_samples import KINDS, T0_NS, one_second, packet, picture, read, read_events, record, sweep


@pytest.mark.parametrize("name", KINDS)
def test_bag_recorder_samples_round_trip(tmp_path, rles, name):
    samples = one_second()
    path = record(tmp_path / name, rles, samples)
    images, scans = read(path, rles)
    for found, given in zip(images, [s for s in samples if isinstance(s, Image)], strict=True):
        assert np.array_equal(found.pixels, given.pixels)
        assert (found.sensor, found.channel) == ("davis", "frames")
        assert (found.stamp_ns, found.host_ns) == (given.stamp_ns, given.host_ns)
    for found, given in zip(scans, [s for s in samples if isinstance(s, Scan)], strict=True):
        assert (found.stamp_ns, found.host_ns) == (given.stamp_ns, given.host_ns)
        for column in ("points", "intensity", "ring"):
            assert np.array_equal(getattr(found, column), getattr(given, column)), column
        assert found.offset_ns is not None and given.offset_ns is not None
        assert np.abs(found.offset_ns - given.offset_ns).max() <= 4, (
            "float32 seconds, as Velodyne's driver has"
        )
    events = [s for s in samples if isinstance(s, Events)]
    for column, found_column in read_events(path).items():
        assert np.array_equal(found_column, np.concatenate([getattr(p, column) for p in events])), column


def test_bag_recorder_colour_and_timeless(tmp_path, rles):
    colour = picture(0, (20, 30, 3))
    given = replace(sweep(0), offset_ns=None, host_ns=None)
    images, scans = read(record(tmp_path / "r.bag", rles, [colour, given]), rles)
    assert np.array_equal(images[0].pixels, colour.pixels)
    assert scans[0].offset_ns is None
    assert (scans[0].stamp_ns, scans[0].host_ns) == (given.stamp_ns, given.stamp_ns), "arrival unknown"


@pytest.mark.parametrize("has_times", [True, False])
def test_timestamps_mark_the_firing_of_the_profile(tmp_path, rles, has_times):
    rig = changed(rles, lidars__lidar__timestamps__reference="last_firing")
    given = sweep(3) if has_times else replace(sweep(3), offset_ns=None)
    _, (found,) = read(record(tmp_path / "r.bag", rig, [picture(0), given]), rig)
    assert found.stamp_ns == pytest.approx(given.stamp_ns, abs=4 if has_times else 0)


@pytest.mark.parametrize("path", ["no/folder/r.bag", "file/r"])
def test_bag_recorder_invalid_folder_is_refused(tmp_path, rles, path):
    (tmp_path / "file").write_bytes(b"")
    with pytest.raises(SourceError, match=path):
        BagRecorder(tmp_path / path, rles)


def test_bag_recorder_refuses_unknown(tmp_path, rles):
    """Samples of known sensors are kept."""
    with BagRecorder(tmp_path / "r.bag", rles) as recorder:
        recorder.write(picture(0))
        for stranger, name in (
            (replace(picture(1), channel="depth"), r"davis\.depth"),
            (replace(sweep(0), sensor="top"), "top"),
            (replace(packet(0), sensor="front"), r"front\.events"),
        ):
            with pytest.raises(SourceError, match=name):
                recorder.write(stranger)
        with pytest.raises(ValueError):
            recorder.write(replace(picture(1), stamp_ns=None, host_ns=None))
        recorder.write(packet(0))
        with pytest.raises(SourceError, match="/davis/events"):
            recorder.write(replace(picture(1), channel="events"))
        recorder.write(sweep(0))
        recorder.write(sweep(1))
    images, scans = read(tmp_path / "r.bag", rles)
    assert (len(images), len(scans)) == (1, 2)


@pytest.mark.parametrize("name", KINDS)
def test_bag_recorder_memory_is_bounded(tmp_path, rles, name):
    image, scan, events = picture(0), sweep(0), packet(0)
    with BagRecorder(tmp_path / name, rles) as recorder:
        recorder.write(image)
        recorder.write(scan)
        recorder.write(events)
        tracemalloc.start()
        for k in range(150):
            later_ns = k * 50_000_000
            recorder.write(replace(image, stamp_ns=T0_NS + later_ns))
            recorder.write(replace(scan, stamp_ns=T0_NS + later_ns))
            recorder.write(replace(events, t_ns=events.t_ns + later_ns))
        held, peak = tracemalloc.get_traced_memory()
        tracemalloc.stop()
    written = sum(file.stat().st_size for file in tmp_path.rglob("*.*") if file.is_file())
    assert written > 40_000_000
    assert held < 3_000_000 and peak < 8_000_000


@pytest.mark.parametrize("name", KINDS)
def test_a_full_disk_stops_the_recording(tmp_path, rles, name):
    samples = [*map(sweep, range(5)), *map(picture, range(50))]
    n_taken = 0
    with files_up_to(3_000_000), BagRecorder(tmp_path / name, rles) as recorder:
        with pytest.raises(SourceError):
            for sample in samples:
                recorder.write(sample)
                n_taken += 1
        with pytest.raises(SourceError):
            recorder.write(samples[0])
    assert 10 < n_taken < 50
    with pytest.raises(SourceError, match=name):
        open_recording(tmp_path / name, rles)
