"""Events as one file: exact, repeatable, readable by numpy alone."""

import io
import tracemalloc
import zipfile

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lce_rig.core.data import Events
from lce_rig.core.event_file import EventArchive, decode_events, encode_events


def events_at(t_ns: list[int], host_ns: int | None = None) -> Events:
    n = len(t_ns)
    x, y = (np.arange(n) * 7 % 346).astype(np.uint16), (np.arange(n) % 260).astype(np.uint16)
    return Events("cam", np.array(t_ns, np.int64), x, y, np.arange(n) % 3 == 0, 346, 260, host_ns)


@given(
    t_ns=st.lists(st.integers(-(2**60), 2**60), max_size=30).map(sorted),
    host_ns=st.none() | st.integers(0, 2**62),
)
def test_events_come_back_to_the_nanosecond(t_ns: list[int], host_ns: int | None) -> None:
    events = events_at(t_ns, host_ns)
    found = decode_events(encode_events(events), "cam")
    for name in ("t_ns", "x", "y", "polarity"):
        assert getattr(found, name).dtype == getattr(events, name).dtype
        assert np.array_equal(getattr(found, name), getattr(events, name))
    assert (found.sensor, found.width_px, found.height_px, found.host_ns) == ("cam", 346, 260, host_ns)


def test_the_same_events_give_the_same_bytes() -> None:
    events = events_at(list(range(0, 10**6, 1000)))
    assert encode_events(events) == encode_events(events)


def test_whole_microseconds_are_stored_as_such() -> None:
    with np.load(io.BytesIO(encode_events(events_at([1000, 2000])))) as archive:
        assert archive["t_us"].tolist() == [1, 2]


@pytest.mark.parametrize(
    ("columns", "cause"),
    [
        ({}, "no times"),
        ({"t": [1], "x": [1], "y": [1]}, "no column polarity"),
        ({"t": [1, 2], "x": [1], "y": [1], "p": [1]}, "unequal length"),
        ({"t": [1], "x": [-1], "y": [1], "p": [1]}, "beyond any sensor"),
        ({"t": np.array([None]), "x": [1], "y": [1], "p": [1]}, "column t is not a list of numbers"),
        ({"t": [1], "x": 1, "y": [1], "p": [1]}, "column x is not a list of numbers"),
        ({"t": [1], "x": [1], "y": [1], "p": ["on"]}, "column p is not a list of numbers"),
        ({"t": [1], "x": [1], "y": [1], "p": [1], "resolution_px": 346}, "not a width and height"),
    ],
)
def test_what_is_no_archive_of_events_is_refused_in_words(columns: dict[str, object], cause: str) -> None:
    buffer = io.BytesIO()
    np.savez(buffer, **columns)
    with pytest.raises(ValueError, match=cause):
        decode_events(buffer.getvalue(), "cam")


@given(cut=st.integers(0, 2000), flip=st.integers(0, 2000))
def test_damage_is_an_error_in_words_or_changes_nothing(cut: int, flip: int) -> None:
    events = events_at(list(range(0, 10**6, 10_000)))
    whole = encode_events(events)
    damaged = bytearray(whole)
    damaged[flip % len(whole)] ^= 0x40
    for data in (whole[: cut % len(whole)], bytes(damaged)):
        try:
            found = decode_events(data, "cam")
        except ValueError as error:
            assert str(error)
        else:
            assert np.array_equal(found.t_ns, events.t_ns)
            assert np.array_equal(found.x, events.x)


def archive(**members: bytes) -> bytes:
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as file:
        for name, content in members.items():
            file.writestr(f"{name}.npy", content)
    return buffer.getvalue()


def npy(shape: tuple[int, ...], content: bytes, descr: object = "<i8") -> bytes:
    buffer = io.BytesIO()
    header = {"descr": descr, "fortran_order": False, "shape": shape}
    np.lib.format.write_array_header_1_0(buffer, header)
    return buffer.getvalue() + content


@pytest.mark.parametrize(
    ("column", "cause"),
    [
        (b"hello", "column t is not an array"),
        (b"", "column t is not an array"),
        (npy((1 << 40,), bytes(80)), "declares 1099511627776 numbers"),
        (npy((1 << 70, 0), b""), "not a list of numbers"),
        (npy((9,), bytes(80)), "declares 9 numbers"),
        (npy((10,), bytes(160), "<c16"), "not a list of numbers"),
        (npy((10,), bytes(80), [("a", "<i4"), ("b", "<i4")]), "not a list of numbers"),
        (npy((10,), bytes(80), "|S8"), "not a list of numbers"),
        (npy((10,), bytes(80), "|O"), "not a list of numbers"),
        (b"\x93NUMPY\x02\x00\xff\xff\xff\xff" + bytes(80), "damaged"),
        (b"\x93NUMPY\x01\x00\xff\xff" + b"(" * 65_535, "damaged"),
        (npy((17_500_000,), bytes(140_000_000)), "declares 140 MB"),
    ],
)
def test_members_that_are_not_what_they_say_are_refused_in_words(column: bytes, cause: str) -> None:
    whole = npy((10,), bytes(80))
    with pytest.raises(ValueError, match=cause):
        decode_events(archive(t=column, x=whole, y=whole, p=whole), "cam")


@pytest.mark.parametrize(
    "times",
    [
        np.array([0.0, np.nan]),
        np.array([0.0, np.inf]),
        np.array([0.0, 1e300]),
        np.array([0.0, -1e300]),
        np.array([0.0, np.inf], np.float16),
        np.array([0, np.finfo(np.longdouble).max], np.longdouble),
        np.array([0, 2**64 - 1], np.uint64),
        np.array([-(2**63), 0]),
    ],
)
def test_times_beyond_any_clock_are_refused_without_a_warning(times: np.ndarray) -> None:
    buffer = io.BytesIO()
    with np.errstate(all="ignore"):
        np.savez(buffer, t=times, x=[1, 2], y=[1, 2], p=[0, 1])
    with pytest.raises(ValueError, match="times beyond any clock"):
        decode_events(buffer.getvalue(), "cam")


@pytest.mark.parametrize("pixels", [[0, np.nan], [0, np.inf], [0, -1], [0, 65_536], [0, 1e300]])
def test_pixels_that_no_sensor_has_are_refused_without_a_warning(pixels: list[float]) -> None:
    buffer = io.BytesIO()
    np.savez(buffer, t=[1, 2], x=pixels, y=[1, 2], p=[0, 1])
    with pytest.raises(ValueError, match="beyond any sensor"):
        decode_events(buffer.getvalue(), "cam")


@pytest.mark.parametrize("size", [[40_000, 40_000], [2**62, 2**62]])
def test_resolutions_that_no_sensor_has_are_refused(size: list[int]) -> None:
    buffer = io.BytesIO()
    np.savez(buffer, t=[1, 2], x=[1, 2], y=[1, 2], p=[0, 1], resolution_px=size)
    with pytest.raises(ValueError, match="beyond any sensor"):
        decode_events(buffer.getvalue(), "cam")


def test_a_long_recording_is_read_in_stretches_whatever_its_columns_are_made_of() -> None:
    n = 3_000_000
    polarity = np.random.default_rng(0).integers(0, 2, n)  # 64 bits for one: it shrinks to a 27th
    t_us, x = np.arange(n), (np.arange(n) % 1280).astype(np.uint16)
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as file:
        for name, column in (("t", t_us), ("x", x), ("y", x // 2), ("p", polarity)):
            file.writestr(f"{name}.npy", npy(column.shape, column.tobytes(), column.dtype.str))
    tracemalloc.start()
    stretches = EventArchive(buffer).stretches(100_000)
    found = [np.array([t[-1] // 1000, x[-1], y[-1], on.sum()]) for t, x, y, on in stretches]
    _, peak_bytes = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    ends = np.arange(100_000, n + 1, 100_000)
    assert np.array([row[:3] for row in found]).tolist() == [[e - 1, x[e - 1], x[e - 1] // 2] for e in ends]
    assert sum(row[3] for row in found) == polarity.sum()
    assert peak_bytes < n * 8


@pytest.mark.long
def test_what_can_be_stored_of_a_flickering_scene_can_be_read() -> None:
    n = 17_500_000
    t_ns = np.arange(n) * 100_000
    x = np.zeros(n, np.uint16)
    data = encode_events(Events("cam", t_ns, x, x, np.ones(n, np.bool_), 1280, 720))
    assert len(decode_events(data, "cam")) == n


def test_a_damaged_end_is_an_error_after_what_lies_before() -> None:
    n = 200_000
    noise = np.random.default_rng(0).integers(0, 1000, n)
    data = archive(t=npy((n,), np.arange(n).tobytes()), **dict.fromkeys("xyp", npy((n,), noise.tobytes())))
    at = data.rindex(b"p.npy", 0, data.rindex(b"t.npy"))
    damaged = bytearray(data)
    damaged[at + 150_000] ^= 0x40
    read = []
    with pytest.raises(ValueError, match="damaged"):
        for t_ns, *_ in EventArchive(io.BytesIO(bytes(damaged))).stretches(10_000):
            read.append(len(t_ns))
    assert 0 < sum(read) < n


def test_two_columns_of_one_name_are_refused() -> None:
    column = npy((10,), bytes(80))
    buffer = io.BytesIO(archive(t=column, x=column, y=column, p=column))
    with zipfile.ZipFile(buffer, "a") as file:
        file.writestr("t", column)
    with pytest.raises(ValueError, match="several columns of one name"):
        decode_events(buffer.getvalue(), "cam")


def test_an_archive_of_very_many_members_is_not_listed() -> None:
    data = archive(**{f"{i:0250d}": b"" for i in range(4000)})
    with pytest.raises(ValueError, match="list of members is longer"):
        decode_events(data, "cam")
