"""Files of events that ask for more than a sensor delivers, or for what is not theirs: refused, cheaply."""

import io
import os
import struct
import warnings
import zipfile
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from lce_rig.core.data import EventColumns
from lce_rig.core.errors import SourceError
from lce_rig.core.event_file import encode_events
from lce_rig.core.losses import Losses
from lce_rig.io.events import open_events
from lce_rig.io.events.aedat4 import decode_frame
from lce_rig.io.events.stream import parse_size, to_ns
from lce_rig.io.events.text import TextEvents
from tests.io.events import encoders
from tests.io.events.aedat4_files import STREAM, XML, RawFrame, flatbuffer, frame_packet
from tests.io.events.encoders import listed, random_events
from tests.io.events.test_files import WRITERS, everything, write_text, write_zip
from tests.io.events.test_recording import columns, record, stamps_us
from tests.notes import has_note

EVENTS = random_events(2000, 7, start_us=1_700_000_000_000_000)
SUFFIXES = ["aedat4", "h5", "npz", "raw", "txt", "zip"]
T_MAX = 1 << 62


def refusal(path: Path, **options: Any) -> str:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        with pytest.raises(SourceError, match=path.name) as caught:
            list(open_events(path, **options))
    assert "\n" not in caught.value.what
    return caught.value.what


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_a_pipe_or_device_in_place_of_a_file_is_refused_at_once(tmp_path: Path, suffix: str) -> None:
    os.mkfifo(tmp_path / f"pipe.{suffix}")
    (tmp_path / f"zero.{suffix}").symlink_to("/dev/zero")
    for name in ("pipe", "zero"):
        assert "or device" in refusal(tmp_path / f"{name}.{suffix}")


# HDF5


def write_h5(path: Path, make: Callable[[Any, str], object]) -> Path:
    import h5py

    with h5py.File(path, "w") as file:
        file.create_group("events")
        for name in "txyp":
            make(file, f"events/{name}")
    return path


def test_links_out_of_an_hdf5_file_are_never_followed(tmp_path: Path) -> None:
    import h5py

    WRITERS["a.h5"](tmp_path / "other.h5", EVENTS)
    other = str(tmp_path / "other.h5")

    def virtual(file: Any, name: str) -> None:
        layout = h5py.VirtualLayout((9,), "i8")
        layout[:] = h5py.VirtualSource(other, name, (len(EVENTS),))[:9]
        file.create_virtual_dataset(name, layout)

    made: dict[str, Callable[[Any, str], object]] = {
        "is a link": lambda f, name: f.__setitem__(name, h5py.ExternalLink(other, name)),
        "events/t is a link": lambda f, name: f.__setitem__(name, h5py.SoftLink(f"/{name}")),
        "lies in other files": lambda f, name: f.create_dataset(name, (9,), "u1", external=[(other, 0, 9)]),
        "events/t lies in other files": virtual,
    }
    for cause, make in made.items():
        assert cause in refusal(write_h5(tmp_path / "a.h5", make))
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["events"] = h5py.ExternalLink(other, "/events")
    assert has_note([refusal(tmp_path / "a.h5")], "events is", "a link")
    WRITERS["a.h5"](tmp_path / "a.h5", EVENTS)
    with h5py.File(tmp_path / "a.h5", "a") as file:
        del file["t_offset"]
        file["t_offset"] = h5py.ExternalLink(other, "/t_offset")
    assert has_note([refusal(tmp_path / "a.h5")], "t_offset is", "a link")


@pytest.mark.parametrize(
    ("kind", "cause"),
    [
        ("compound", "not numbers"),
        ("bytes", "not numbers"),
        ("text", "not numbers"),
        ("vlen", "not numbers"),
        ("reference", "not numbers"),
        ("null", "not numbers"),
        ("2-D", "2 dimensions"),
        ("scalar", "0 dimensions"),
        ("group", "is not a dataset"),
        ("fractions", "not whole microseconds"),
        ("nan", "beyond any sensor"),
    ],
)
def test_columns_of_hdf5_that_are_no_lists_of_numbers_are_refused(
    tmp_path: Path, kind: str, cause: str
) -> None:
    import h5py

    made: dict[str, Callable[[Any, str], object]] = {
        "compound": lambda f, name: f.create_dataset(name, data=np.zeros(5, [("a", "i4")])),
        "bytes": lambda f, name: f.create_dataset(name, data=np.array([b"ab"] * 5)),
        "text": lambda f, name: f.create_dataset(name, (5,), h5py.string_dtype()),
        "vlen": lambda f, name: f.create_dataset(name, (5,), h5py.vlen_dtype("i4")),
        "reference": lambda f, name: f.create_dataset(name, (5,), h5py.ref_dtype),
        "null": lambda f, name: f.create_dataset(name, data=h5py.Empty("i4")),
        "2-D": lambda f, name: f.create_dataset(name, data=np.zeros((5, 2))),
        "scalar": lambda f, name: f.create_dataset(name, data=3),
        "group": lambda f, name: f.create_group(name),
        "fractions": lambda f, name: f.create_dataset(name, data=np.linspace(0, 1, 5)),
        "nan": lambda f, name: f.create_dataset(name, data=np.full(5, np.nan)),
    }
    assert cause in refusal(write_h5(tmp_path / "a.h5", made[kind]))


def test_attributes_of_hdf5_that_are_no_numbers_are_refused_by_name(tmp_path: Path) -> None:
    import h5py

    for value in (h5py.Empty("i4"), "abc", np.zeros(0), np.nan, 1e300, [1, 2]):
        WRITERS["a.h5"](tmp_path / "a.h5", EVENTS)
        with h5py.File(tmp_path / "a.h5", "a") as file:
            file.attrs["width"] = value
        assert has_note([refusal(tmp_path / "a.h5")], "width is", "not a number")


@pytest.mark.parametrize("chunks", [None, (1 << 16,)])
def test_events_that_hdf5_declares_and_does_not_store_are_refused(
    tmp_path: Path, chunks: tuple[int, ...] | None
) -> None:
    path = write_h5(tmp_path / "a.h5", lambda f, name: f.create_dataset(name, (10**12,), "i8", chunks=chunks))
    assert has_note([refusal(path)], "1e+12 events", "0 MB")


def test_chunks_of_hdf5_larger_than_any_are_refused(tmp_path: Path) -> None:
    path = write_h5(
        tmp_path / "a.h5", lambda f, name: f.create_dataset(name, (1 << 30,), "i8", chunks=(1 << 28,))
    )
    assert "chunks of 2.68e+08" in refusal(path)


def test_a_chunk_of_hdf5_that_unpacks_to_more_than_it_says_is_refused(tmp_path: Path) -> None:
    packer = zlib.compressobj(1)
    bomb = b"".join(packer.compress(bytes(1 << 20)) for _ in range(100)) + packer.flush()

    def make(file: Any, name: str) -> None:
        data = file.create_dataset(name, (1000,), "i8", chunks=(1000,), compression="gzip")
        data.id.write_direct_chunk((0,), bomb)

    assert "unpacks to" in refusal(write_h5(tmp_path / "a.h5", make))


@pytest.mark.parametrize(("dtype", "options"), [("<u4", {}), (">i8", {"shuffle": True, "fletcher32": True})])
def test_large_chunks_of_hdf5_are_read_exactly(tmp_path: Path, dtype: str, options: dict[str, bool]) -> None:
    import h5py

    n = 1_050_000
    rng = np.random.default_rng(1)
    data = {"t": np.sort(rng.integers(0, 60_000, n)), "x": rng.integers(0, 346, n), "y": np.arange(n) % 260}
    data["p"] = data["t"] % 2
    with h5py.File(tmp_path / "a.h5", "w") as file:
        for name, column in data.items():
            file.create_dataset(
                f"events/{name}", data=column.astype(dtype), compression=1, chunks=(400_000,), **options
            )
    stretches = list(open_events(tmp_path / "a.h5", resolution=(346, 260)))
    assert np.array_equal(np.concatenate([s.t_ns for s in stretches]), data["t"] * 1000)
    assert np.array_equal(np.concatenate([s.x for s in stretches]), data["x"])
    assert np.array_equal(np.concatenate([s.y for s in stretches]), data["y"])


# AEDAT4


def aedat4(path: Path, packets: list[bytes], xml: bytes | None = None) -> Path:
    streams = STREAM.format(number=0, kind="EVTS", name="events", width=346, height=260)
    head = flatbuffer(
        b"IOHE", {1: ("q", -1), 2: XML.format(streams=streams).encode() if xml is None else xml}
    )
    body = b"".join(struct.pack("<ii", 0, len(packet)) + packet for packet in packets)
    path.write_bytes(b"#!AER-DAT4.0\r\n" + head + body)
    return path


@pytest.mark.parametrize("kind", ["lz4", "zstd"])
def test_packets_that_unpack_to_more_than_a_camera_sends_are_refused(tmp_path: Path, kind: str) -> None:
    piece, n_pieces = bytes(1 << 20), 150
    if kind == "lz4":
        lz4 = pytest.importorskip("lz4.frame")
        packer = lz4.LZ4FrameCompressor()
        parts = [packer.begin(), *(packer.compress(piece) for _ in range(n_pieces)), packer.flush()]
    else:
        packer = pytest.importorskip("backports.zstd").ZstdCompressor()
        parts = [*(packer.compress(piece) for _ in range(n_pieces)), packer.flush()]
    assert "unpacks to" in refusal(aedat4(tmp_path / "a.aedat4", [b"".join(parts)]))


def test_entities_in_the_head_of_aedat4_are_not_expanded(tmp_path: Path) -> None:
    entities = "".join(f'<!ENTITY a{i} "{f"&a{i - 1};" * 10}">' for i in range(1, 12))
    text = f'<!DOCTYPE l [<!ENTITY a0 "ha">{entities}]><dv>&a11;</dv>'
    assert "declares entities" in refusal(aedat4(tmp_path / "a.aedat4", [], text.encode()))
    assert "damaged" in refusal(aedat4(tmp_path / "a.aedat4", [], text.encode("utf-16")))


def test_heads_of_aedat4_that_are_deep_or_huge_are_refused(tmp_path: Path) -> None:
    assert "streams: none" in refusal(aedat4(tmp_path / "a.aedat4", [], b"<a>" * 9999 + b"</a>" * 9999))
    (tmp_path / "b.aedat4").write_bytes(b"#!AER-DAT4.0\r\n" + struct.pack("<I", 1 << 30))
    os.truncate(tmp_path / "b.aedat4", 1 << 31)
    assert "declares 1074 MB" in refusal(tmp_path / "b.aedat4")
    long = XML.format(streams=STREAM.format(number="9" * 5000, kind="EVTS", name="", width=1, height=1))
    assert "no number" in refusal(aedat4(tmp_path / "c.aedat4", [], long.encode()))


def test_zeros_behind_the_packets_of_aedat4_are_a_torn_end_and_no_packets(tmp_path: Path) -> None:
    WRITERS["a.aedat4"](tmp_path / "whole.aedat4", EVENTS)
    path = aedat4(tmp_path / "a.aedat4", [])
    os.truncate(path, 50 << 20)
    assert "1 torn ends" in refusal(path)


def test_frames_of_absurd_sizes_and_times_are_refused() -> None:
    packet = frame_packet(RawFrame(1000, 10, np.zeros((4, 6), np.uint8)))
    assert decode_frame(packet[4:]).pixels.shape == (4, 6)
    for start_us, cause in ((1 << 60, "beyond any clock"), (-(1 << 60), "beyond any clock")):
        late = frame_packet(RawFrame(start_us, 10, np.zeros((4, 6), np.uint8)))
        with pytest.raises(ValueError, match=cause):
            decode_frame(late[4:])
    absurd = flatbuffer(b"FRME", {6: ("h", 32767), 7: ("h", 32767), 10: bytes(24)})
    with pytest.raises(ValueError, match="32767x32767"):
        decode_frame(absurd[4:])


# Archives and text


def test_lines_that_never_end_cost_the_rest_of_the_text_alone(tmp_path: Path) -> None:
    write_text(tmp_path / "a.txt", EVENTS)
    with (tmp_path / "a.txt").open("ab") as file:
        file.write(b"1" * (20 << 20))
    recording = open_events(tmp_path / "a.txt")
    assert everything(recording) == listed(EVENTS)
    assert has_note(recording.notes, "line 2002", "4096 bytes")


@pytest.mark.parametrize("content", [b"1" * (1 << 22), b" " * (1 << 22), b"0.1 1 1 " + b"1" * 10**5 + b"\n"])
def test_text_that_begins_with_an_endless_line_is_refused(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "a.txt").write_bytes(content)
    assert "neither a size" in refusal(tmp_path / "a.txt")


def test_one_long_word_among_many_short_ones_takes_no_memory(tmp_path: Path) -> None:
    (tmp_path / "a.txt").write_bytes(
        b"346 260\n" + b"1 1 1 1\n" * 9999 + b"1" * 4000 + b" 1 1 1\n0.1 1 1 1\n"
    )
    losses = Losses()
    assert sum(map(len, TextEvents(tmp_path / "a.txt").stretches(losses))) == 10_000
    assert losses.by_code() == {"recording.broken_lines": 1}


@pytest.mark.parametrize("word", [b"nan", b"inf", b"1e300", b"1e999", b"-1e300", b"1" * 200, b"\xff\x00"])
def test_times_in_text_that_are_on_no_clock_are_left_out(tmp_path: Path, word: bytes) -> None:
    (tmp_path / "a.txt").write_bytes(b"346 260\n0.1 1 1 1\n" + word + b" 1 1 1\n0.2 1 1 1\n")
    recording = open_events(tmp_path / "a.txt")
    assert [t for t, *_ in everything(recording)] == [100_000, 200_000]
    assert any("1 broken lines" in note for note in recording.notes)


def test_a_zip_whose_text_is_far_longer_than_text_packs_is_refused(tmp_path: Path) -> None:
    with zipfile.ZipFile(tmp_path / "a.zip", "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
        archive.writestr("events.txt", b"346 260\n" + b"1" * (40 << 20))
    assert has_note([refusal(tmp_path / "a.zip")], "'events.txt'", "42 MB")
    write_zip(tmp_path / "b.zip", EVENTS)
    assert everything(open_events(tmp_path / "b.zip")) == listed(EVENTS)


def test_other_archives_than_deflated_ones_are_refused(tmp_path: Path) -> None:
    for name, method in (("a.zip", zipfile.ZIP_BZIP2), ("a.npz", zipfile.ZIP_LZMA)):
        with zipfile.ZipFile(tmp_path / name, "w", method) as archive:
            for member in ["t.txt"] if name == "a.zip" else ["t.npy", "x.npy", "y.npy", "p.npy"]:
                archive.writestr(member, b"346 260\n1 1 1 1\n")
        assert "by deflate" in refusal(tmp_path / name)


def test_an_npz_without_a_size_takes_the_extent_and_one_with_it_its_own(tmp_path: Path) -> None:
    (tmp_path / "a.npz").write_bytes(encode_events(EVENTS))
    assert open_events(tmp_path / "a.npz").resolution_px == (346, 260)
    np.savez(tmp_path / "b.npz", t=[1, 2], x=[3, 4], y=[5, 5], p=[0, 1])
    recording = open_events(tmp_path / "b.npz")
    assert recording.resolution_px == (5, 6)
    assert any("5x6, the extent" in note for note in recording.notes)


# Prophesee


@pytest.mark.parametrize(
    "size",
    ["height=2x0;width=640", "height=0;width=640", "height=480;width=99999999999", "height=\xb2;width=2"],
)
def test_a_size_in_a_raw_header_that_no_sensor_has_is_left_aside_and_said(tmp_path: Path, size: str) -> None:
    truth = listed(random_events(500, 8))
    head = f"% format EVT3;{size}\n% end\n".encode()
    (tmp_path / "a.raw").write_bytes(head + encoders.evt3(truth))
    recording = open_events(tmp_path / "a.raw", resolution=(346, 260))
    assert everything(recording) == truth
    assert has_note(recording.notes, "is ignored")


def test_a_raw_header_without_an_end_is_refused(tmp_path: Path) -> None:
    (tmp_path / "a.raw").write_bytes(b"% evt 3.0\n" + b"% a b\n" * (1 << 17))
    assert has_note([refusal(tmp_path / "a.raw")], "header", "256 kB")


# Time and resolution


@pytest.mark.parametrize("dtype", ["i8", "u8", "f8", "i4", "u4", "f4"])
def test_times_beyond_any_clock_are_told_from_others(dtype: str) -> None:
    info: Any = np.finfo(dtype) if dtype[0] == "f" else np.iinfo(dtype)
    times = np.array([info.min, 5, info.max], dtype)
    found = to_ns(times, 7)
    assert found[1] == 12_000
    ends = [T_MAX if abs(int(t)) > T_MAX // 1000 else (int(t) + 7) * 1000 for t in (info.min, info.max)]
    assert found[[0, 2]].tolist() == ends
    assert times[1] == 5


def test_sizes_that_no_camera_has_are_none() -> None:
    assert parse_size("346", "260") == (346, 260)
    for width, height in (
        ("", "1"),
        ("0", "5"),
        ("2x0", "1"),
        ("-3", "4"),
        ("9" * 5000, "1"),
        ("9999", "9999"),
    ):
        assert parse_size(width, height) is None


def test_stamps_at_the_ends_of_64_bits_are_left_out_and_the_others_kept() -> None:
    t_ns = np.arange(1000, dtype=np.int64) * 1000
    t_ns[[100, 200, 300, 400]] = T_MAX, -T_MAX, (1 << 63) - 1, -(1 << 63)
    zeros = np.zeros(1000, np.uint16)
    recording = record(EventColumns(t_ns, zeros, zeros, zeros > 0))
    assert stamps_us(recording) == [i for i in range(1000) if i not in (100, 200, 300, 400)]
    assert has_note(recording.notes, "4 events", "any clock")


def test_a_clock_that_wraps_at_every_event_is_refused() -> None:
    wrapping = np.tile([(1 << 31) - 1, 0], 10_001)
    with pytest.raises(SourceError, match="wraps more than 10000 times"):
        list(record(columns(wrapping)))


def test_more_events_than_a_camera_sends_that_stay_mixed_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("lce_rig.io.events.event_recording._MAX_HELD_EVENTS", 2**16)
    rng = np.random.default_rng(0)
    mixed = [columns(rng.integers(0, 19_000, 40_000)) for _ in range(50)]
    with pytest.raises(SourceError, match="80000 events within 20 ms, out of order"):
        list(record(*mixed))


def test_an_extent_beyond_any_sensor_is_refused(tmp_path: Path) -> None:
    write_h5(tmp_path / "a.h5", lambda f, name: f.create_dataset(name, data=np.array([0, 65_000])))
    assert has_note([refusal(tmp_path / "a.h5")], "column 65000", "row 65000")


def test_a_recording_whose_every_stamp_is_beyond_any_clock_says_so(tmp_path: Path) -> None:
    data = io.BytesIO()
    np.savez(data, t=np.array([1 << 62]), x=[1], y=[1], p=[1])
    (tmp_path / "a.npz").write_bytes(data.getvalue())
    assert "any clock" in refusal(tmp_path / "a.npz")
    zeros = np.zeros(3, np.uint16)
    recording = record(EventColumns(np.full(3, T_MAX), zeros, zeros, zeros > 0))
    with pytest.raises(SourceError, match="3 events"):
        _ = recording.start_ns
