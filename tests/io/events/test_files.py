"""Files of events: read back exactly, and where they are damaged as far as they go."""

import struct
import tracemalloc
from collections.abc import Callable
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lce_rig.core.data import Events
from lce_rig.core.errors import SourceError
from lce_rig.io.events import open_events
from tests.damage import damaged
from tests.io.events import encoders
from tests.io.events.aedat4_files import write_aedat4
from tests.io.events.bags import write_event_bag
from tests.io.events.encoders import everything, listed, random_events
from tests.notes import has_note

START_US = 1_700_000_000_000_000
EVENTS = random_events(30_000, 7, start_us=START_US)


def write_dsec(path, events):
    import h5py

    t_us = events.t_ns // 1000
    with h5py.File(path, "w") as file:
        file["events/t"] = (t_us - START_US).astype(np.uint32)
        file["events/x"], file["events/y"] = events.x, events.y
        file["events/p"] = events.polarity.astype(np.uint8)
        file["t_offset"] = START_US
        file["ms_to_idx"] = np.zeros(1, np.uint64)


def write_metavision(path, events):
    import h5py

    table = np.empty(len(events), [("x", "<u2"), ("y", "<u2"), ("p", "<i2"), ("t", "<i8")])
    table["x"], table["y"], table["p"], table["t"] = columns_of(events)
    with h5py.File(path, "w") as file:
        file["CD/events"] = table
        file["CD/indexes"] = np.zeros(1, [("id", "<u8"), ("ts", "<i8")])


def write_columns_at_root(path, events):
    import h5py

    with h5py.File(path, "w") as file:
        for name, column in zip("xypt", columns_of(events), strict=True):
            file[name] = column


def columns_of(events):
    return events.x, events.y, events.polarity.astype(np.int16), events.t_ns // 1000


def write_raw(path, events):
    head = "% evt 3.0\n% geometry 346x260\n% end\n"
    # The raw formats count from the sensor's start, and so do their stamps here.
    local = [(t - START_US, x, y, p) for t, x, y, p in listed(events)]
    path.write_bytes(head.encode() + encoders.evt3(local))


WRITERS: dict[str, Callable[[Path, Events], object]] = {
    "a.aedat4": lambda path, events: write_aedat4(path, [events]),
    "a.bag": lambda path, events: write_event_bag(path, [events]),
    "ros2": lambda path, events: write_event_bag(path, [events]),
    "a.h5": write_dsec,
    "metavision.h5": write_metavision,
    "root.hdf5": write_columns_at_root,
    "a.raw": write_raw,
}


@pytest.mark.parametrize("name", sorted(WRITERS))
def test_event_files_return_every_event(tmp_path, name):
    WRITERS[name](tmp_path / name, EVENTS)
    recording = open_events(tmp_path / name, sensor="davis")
    shift_us = START_US if name == "a.raw" else 0
    assert [(t + shift_us, x, y, p) for t, x, y, p in everything(recording)] == listed(EVENTS)
    assert recording.resolution_px == (EVENTS.x.max() + 1, EVENTS.y.max() + 1) == (346, 260)
    first_ns, last_ns = recording.span_ns
    assert last_ns - first_ns == pytest.approx(int(EVENTS.t_ns[-1] - EVENTS.t_ns[0]), abs=40e6)
    first = next(iter(recording))
    assert first.sensor == "davis"
    assert (first.t_ns.dtype, first.x.dtype, first.polarity.dtype) == (np.int64, np.uint16, np.bool_)


@pytest.mark.parametrize("name", sorted(WRITERS))
def test_no_events_is_an_error_that_names_the_file(tmp_path, name):
    WRITERS[name](tmp_path / name, EVENTS.select(slice(0, 0)))
    with pytest.raises(SourceError, match=name):
        open_events(tmp_path / name)


@pytest.mark.parametrize("name", sorted(WRITERS))
def test_events_of_another_camera_are_refused(tmp_path, name):
    WRITERS[name](tmp_path / name, EVENTS)
    with pytest.raises(SourceError, match="240x180"):
        list(open_events(tmp_path / name, sensor="davis", resolution=(240, 180)))


def test_files_of_dv_processing_are_read(tmp_path):
    dv = pytest.importorskip("dv_processing")
    few = EVENTS.select(slice(0, 3000))
    store = dv.EventStore()
    for t, x, y, p in listed(few):
        store.push_back(t, x, y, p)
    for compression in (dv.CompressionType.NONE, dv.CompressionType.LZ4, dv.CompressionType.ZSTD):
        path = tmp_path / f"{compression.name}.aedat4"
        config = dv.io.MonoCameraWriter.EventOnlyConfig("cam", (346, 260), compression)
        writer = dv.io.MonoCameraWriter(str(path), config)
        writer.writeEvents(store)
        del writer
        assert everything(open_events(path)) == listed(few)


def test_a_damaged_packet_costs_only_itself(tmp_path):
    write_aedat4(tmp_path / "a.aedat4", [EVENTS])
    data = bytearray((tmp_path / "a.aedat4").read_bytes())
    begin = 14 + 4 + struct.unpack_from("<I", data, 14)[0]
    second = begin + 8 + struct.unpack_from("<i", data, begin + 4)[0]
    data[second + 8 : second + 60] = b"\xff" * 52
    (tmp_path / "a.aedat4").write_bytes(data)
    recording = open_events(tmp_path / "a.aedat4")
    assert everything(recording) == listed(EVENTS)[:8192] + listed(EVENTS)[16384:]
    assert has_note(recording.notes, "1 broken packets", "packet 1")


@pytest.mark.parametrize(
    "head", ["% evt 3.0\n% geometry 640x480\n", "% format EVT3;height=480;width=640\n% end\n"]
)
def test_raw_files_of_every_header_are_read(tmp_path, head):
    truth = listed(random_events(500, 8, (640, 480)))
    (tmp_path / "a.raw").write_bytes(head.encode() + encoders.evt3(truth))
    recording = open_events(tmp_path / "a.raw")
    assert recording.resolution_px == (640, 480)
    assert everything(recording) == truth


@pytest.mark.parametrize("column", [65_538, -1, float("nan")])
def test_columns_beyond_16_bits_do_not_wrap_onto_the_sensor(tmp_path, column):
    few = EVENTS.select(slice(0, 100))
    write_dsec(tmp_path / "a.h5", few)
    import h5py

    with h5py.File(tmp_path / "a.h5", "a") as file:
        del file["events/x"]
        file["events/x"] = np.append(few.x[:-1].astype(float), column)
    recording = open_events(tmp_path / "a.h5", resolution=(346, 260))
    assert everything(recording) == listed(few)[:-1]


def test_hdf5_compressed_by_a_plugin_is_read(tmp_path):
    h5py, hdf5plugin = pytest.importorskip("h5py"), pytest.importorskip("hdf5plugin")
    write_dsec(tmp_path / "a.h5", EVENTS)
    with h5py.File(tmp_path / "a.h5", "a") as file:
        del file["events/x"]
        file.create_dataset("events/x", data=EVENTS.x, **hdf5plugin.Blosc())
    assert everything(open_events(tmp_path / "a.h5")) == listed(EVENTS)


def link_to_other_file(h5py, path):
    return h5py.ExternalLink(str(path), "events/x")


def column_in_other_file(h5py, path):
    layout = h5py.VirtualLayout(len(EVENTS), np.uint16)
    layout[:] = h5py.VirtualSource(str(path), "events/x", (len(EVENTS),))
    return layout


@pytest.mark.parametrize("of_other", [link_to_other_file, column_in_other_file])
def test_hdf5_columns_of_other_files_are_refused(tmp_path, of_other):
    h5py = pytest.importorskip("h5py")
    for name in ("a.h5", "other.h5"):
        write_dsec(tmp_path / name, EVENTS)
    with h5py.File(tmp_path / "a.h5", "a") as file:
        del file["events/x"]
        made = of_other(h5py, tmp_path / "other.h5")
        if isinstance(made, h5py.ExternalLink):
            file["events/x"] = made
        else:
            file.create_virtual_dataset("events/x", made)
    with pytest.raises(SourceError, match=r"a\.h5: events/x is in another file"):
        everything(open_events(tmp_path / "a.h5"))


def test_hdf5_links_inside_the_file_are_followed(tmp_path):
    h5py = pytest.importorskip("h5py")
    write_dsec(tmp_path / "a.h5", EVENTS)
    with h5py.File(tmp_path / "a.h5", "a") as file:
        file["all/x"] = file["events/x"][:]
        del file["events/x"]
        file["events/x"] = h5py.SoftLink("/all/x")
    assert everything(open_events(tmp_path / "a.h5")) == listed(EVENTS)
    with h5py.File(tmp_path / "a.h5", "a") as file:
        del file["events/x"]
        file["events/x"] = h5py.SoftLink("x")
    with pytest.raises(SourceError, match="lead in a circle"):
        everything(open_events(tmp_path / "a.h5"))


@pytest.mark.parametrize("name", ["a.aedat4", "a.h5", "a.bag", "a.raw", "a.mp4"])
def test_event_files_garbage_is_refused_in_one_line(tmp_path, name):
    for rubbish in (b"", b"rubbish\n" * 100, bytes(1000)):
        (tmp_path / name).write_bytes(rubbish)
        with pytest.raises(SourceError, match=name) as caught:
            open_events(tmp_path / name)
        assert "\n" not in caught.value.what


FEW_EVENTS = EVENTS.select(slice(0, 200))


@cache
def whole(folder, name):
    WRITERS[name](folder / name, FEW_EVENTS)
    return (folder / name).read_bytes()


@pytest.mark.parametrize("name", ["a.aedat4", "a.h5", "a.raw"])
@given(data=st.data())
def test_damaged_events_are_read_or_refused_in_one_line(tmp_path_factory, name, data):
    folder = tmp_path_factory.getbasetemp()
    path = folder / "damaged" / name
    path.parent.mkdir(exist_ok=True)
    path.write_bytes(data.draw(damaged(whole(folder, name))))
    try:
        for events in open_events(path, resolution=(346, 260)):
            assert len(events.t_ns) == len(events.x) > 0
            assert events.x.max() < 346 and events.y.max() < 260
            assert (events.t_ns[1:] >= events.t_ns[:-1]).all()
    except SourceError as error:
        assert name in error.what
        assert "\n" not in error.what


def test_long_event_recording_is_streamed(tmp_path):
    piece = random_events(20_000, 1)
    span_ns = int(piece.t_ns[-1])
    pieces = (
        Events("", piece.t_ns + i * span_ns, piece.x, piece.y, piece.polarity, 346, 260) for i in range(150)
    )
    write_aedat4(tmp_path / "a.aedat4", pieces)
    recording = open_events(tmp_path / "a.aedat4")
    tracemalloc.start()
    n_events = sum(map(len, recording))
    _, peak_bytes = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert n_events == 3_000_000
    assert peak_bytes < 0.3 * n_events * 13
