"""Bags that ask for more than a recording can hold cost only what asks for it, and little memory."""

import bz2
import os
import sqlite3
import struct
import subprocess
import sys
from binascii import crc32
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import lz4.frame
import numpy as np
import pytest

from lce_rig.core import limits
from lce_rig.core.data import Image, Scan, join_events
from lce_rig.core.errors import SourceError
from lce_rig.core.losses import Losses
from lce_rig.io import open_recording
from lce_rig.io.events.word_codec import EVT3, WordDecoder
from lce_rig.io.protocol import ContinuousRecording
from lce_rig.io.ros.bag_file import BagFile
from lce_rig.io.ros.event_messages import BagEvents, PacketDecoder, parse_packet
from lce_rig.rig import Rig
from tests.notes import has_note

from .events.bags import write_packet_bag

T0_NS = 1_700_000_000 * 10**9
STEP_NS = 100_000_000
CAM, LIDAR = "/camera/image_raw", "/velodyne_points"
MAGIC = b"\x89MCAP0\r\n"
HUGE = 1 << 28
MESSAGE = b"\0\1\0\0" + bytes(60)


def zeros(packer: Callable[[], Any], n_bytes: int = HUGE) -> bytes:
    """Compress zeros without holding them."""
    compressor, piece = packer(), bytes(1 << 20)
    begin = compressor.begin() if hasattr(compressor, "begin") else b""
    return begin + b"".join(compressor.compress(piece) for _ in range(n_bytes >> 20)) + compressor.flush()


def zstd_compressor() -> Any:
    try:
        from compression import zstd  # type: ignore[import-not-found, unused-ignore]
    except ImportError:
        from backports import zstd
    return zstd.ZstdCompressor()


def record(kind: int, body: bytes) -> bytes:
    return struct.pack("<BQ", kind, len(body)) + body


def text(value: str) -> bytes:
    return struct.pack("<I", len(value)) + value.encode()


def mcap_message(k: int, data: bytes = MESSAGE) -> bytes:
    return record(5, struct.pack("<HIQQ", 1, k, T0_NS + k * STEP_NS, 0) + data)


def mcap_chunk(k: int, packed: bytes, compression: str = "", n_bytes: int = -1, crc: int = 0) -> bytes:
    n_bytes = len(packed) if n_bytes < 0 else n_bytes
    head = struct.pack("<QQQI", T0_NS + k * STEP_NS, T0_NS + k * STEP_NS, n_bytes, crc)
    return record(6, head + text(compression) + struct.pack("<Q", len(packed)) + packed)


CHANNELS = record(3, struct.pack("<H", 1) + text("sensor_msgs/msg/Image") + text("ros2msg") + text("")) + (
    record(4, struct.pack("<HH", 1, 1) + text(CAM) + text("cdr") + text(""))
)
FOOTER = record(2, struct.pack("<QQI", 0, 0, 0)) + MAGIC


def write_mcap(path: Path, *records: bytes) -> Path:
    path.write_bytes(MAGIC + record(1, text("ros2") + text("")) + CHANNELS + b"".join(records) + FOOTER)
    return path


def ros1_record(fields: dict[str, bytes], data: bytes) -> bytes:
    pairs = [name.encode() + b"=" + value for name, value in fields.items()]
    head = b"".join(struct.pack("<I", len(pair)) + pair for pair in pairs)
    return struct.pack("<I", len(head)) + head + struct.pack("<I", len(data)) + data


def ros1_chunk(packed: bytes, compression: str = "none", n_bytes: int = -1) -> bytes:
    n_bytes = len(packed) if n_bytes < 0 else n_bytes
    fields = {"op": b"\5", "compression": compression.encode(), "size": struct.pack("<I", n_bytes)}
    return ros1_record(fields, packed)


def ros1_message(k: int) -> bytes:
    seconds, nanoseconds = divmod(T0_NS + k * STEP_NS, 10**9)
    time = struct.pack("<II", seconds, nanoseconds)
    return ros1_record({"op": b"\2", "conn": struct.pack("<I", 1), "time": time}, MESSAGE)


def write_ros1(path: Path, *records: bytes) -> Path:
    numbers = {"index_pos": bytes(8), "conn_count": bytes(4), "chunk_count": bytes(4)}
    connection = ros1_record(
        {"op": b"\7", "conn": struct.pack("<I", 1), "topic": CAM.encode()},
        ros1_record({"type": b"sensor_msgs/Image"}, b"")[4:-4],
    )
    path.write_bytes(
        b"#ROSBAG V2.0\n" + ros1_record({"op": b"\3", **numbers}, b"") + connection + b"".join(records)
    )
    return path


def read_damaged(path: Path) -> tuple[int, str]:
    """Count the messages, and say what is wrong."""
    bag = BagFile(path)
    n_read = 0
    with pytest.raises(SourceError, match="is damaged") as caught:
        for _ in bag.messages({CAM}):
            n_read += 1
    return n_read, caught.value.what


@pytest.mark.parametrize("n_declared", [HUGE, 1 << 20, (1 << 63) + 5])
@pytest.mark.parametrize(
    ("compression", "packer"), [("zstd", zstd_compressor), ("lz4", lz4.frame.LZ4FrameCompressor)]
)
def test_an_mcap_chunk_that_unpacks_to_a_quarter_of_a_gigabyte_costs_that_chunk_only(
    tmp_path: Path, compression: str, packer: Callable[[], Any], n_declared: int
) -> None:
    bomb = mcap_chunk(1, zeros(packer), compression, n_declared)
    chunks = mcap_chunk(0, mcap_message(0)), bomb, mcap_chunk(2, mcap_message(2))
    n_read, what = read_damaged(write_mcap(tmp_path / "a.mcap", *chunks))
    assert n_read == 2
    assert ("declares" in what) is (n_declared > limits.MAX_CHUNK_BYTES)
    assert has_note([what], "unpacks to", "1 MB") is (n_declared < limits.MAX_CHUNK_BYTES)


@pytest.mark.parametrize("n_declared", [HUGE, 1 << 20])
@pytest.mark.parametrize(
    ("compression", "packer"), [("bz2", bz2.BZ2Compressor), ("lz4", lz4.frame.LZ4FrameCompressor)]
)
def test_a_ros1_chunk_that_unpacks_to_more_than_it_may_costs_that_chunk_only(
    tmp_path: Path, compression: str, packer: Callable[[], Any], n_declared: int
) -> None:
    bomb = ros1_chunk(zeros(packer, 1 << 25), compression, n_declared)
    n_read, what = read_damaged(
        write_ros1(tmp_path / "a.bag", ros1_chunk(ros1_message(0)), bomb, ros1_chunk(ros1_message(2)))
    )
    assert n_read == 2
    assert has_note([what], "2 places", "no index")


@pytest.mark.parametrize("n_each", [100, 3000])
def test_chunks_of_very_many_messages_are_cut_short(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, n_each: int
) -> None:
    monkeypatch.setattr(limits, "MAX_RECORDS", 1000)
    raw = mcap_message(0, b"") * n_each
    chunk = mcap_chunk(0, lz4.frame.compress(raw), "lz4", len(raw))
    n_read, what = read_damaged(write_mcap(tmp_path / "a.mcap", *[chunk] * (3000 // n_each)))
    assert n_read < 3000 and "records" in what


def test_chunks_that_are_each_allowed_are_not_in_any_number(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(limits, "MAX_CHUNK_BYTES", 1 << 20)
    raw = mcap_message(0, bytes((1 << 20) - 31))
    packer = zstd_compressor()
    chunk = mcap_chunk(0, packer.compress(raw) + packer.flush(), "zstd", len(raw))
    n_read, what = read_damaged(write_mcap(tmp_path / "a.mcap", *[chunk] * 20))
    assert 2 <= n_read < 10 and has_note([what], "unpack to", "this size")


PEAK = """
import sys
from pathlib import Path
from lce_rig.core.errors import LceRigError
from lce_rig.rig import load_rig
from lce_rig.io import open_recording
try:
    recording = open_recording(Path(sys.argv[1]), load_rig("rlfs"))
    n_samples = sum(1 for _ in recording.samples())
except LceRigError as error:
    print(error.what)
# Of this program alone; ru_maxrss is also that of the program which started it.
status = Path("/proc/self/status").read_text()
print(int(status.partition("VmHWM:")[2].split()[0]) // 1024)
"""


def peak_mb(path: Path) -> tuple[str, int]:
    """Read a recording in another process; give what it said, and the memory it took."""
    done = subprocess.run(
        [sys.executable, "-c", PEAK, str(path)], capture_output=True, text=True, timeout=60, check=True
    )
    *said, peak = done.stdout.splitlines()
    return " ".join(said), int(peak)


@pytest.mark.long
def test_a_chunk_as_large_as_any_may_be_takes_less_than_half_a_gigabyte(tmp_path: Path) -> None:
    n_bytes = limits.MAX_CHUNK_BYTES
    raw = mcap_message(0, bytes(n_bytes - 31))
    packed = lz4.frame.compress(raw)
    path = write_mcap(tmp_path / "a.mcap", mcap_chunk(0, packed, "lz4", n_bytes, crc32(raw)))
    del raw
    said, peak = peak_mb(path)
    assert "single topic" in said or "no topic" in said
    assert peak < 500


@pytest.mark.parametrize("place", range(3))
def test_lengths_beyond_the_file_are_not_taken(tmp_path: Path, place: int) -> None:
    huge = struct.pack("<Q", 1 << 40)
    tail = [
        struct.pack("<B", 5) + huge + bytes(100),
        struct.pack("<B", 6) + huge + bytes(100),
        record(6, struct.pack("<QQQI", 0, 0, 10, 0) + text("") + huge + bytes(10)),
    ][place]
    n_read, what = read_damaged(write_mcap(tmp_path / "a.mcap", mcap_chunk(0, mcap_message(0)), tail))
    assert n_read == 1
    assert "ends within" in what or "ends behind" in what


def indexed_mcap(path: Path, chunks: list[bytes], index: Callable[[list[int]], list[int]]) -> Path:
    """Write chunks, and an index that names the places that `index` makes of theirs."""
    head = MAGIC + record(1, text("ros2") + text("")) + CHANNELS
    places = np.cumsum([len(head), *map(len, chunks)]).tolist()[:-1]
    body = head + b"".join(chunks)
    counts = struct.pack("<IHQ", 10, 1, len(chunks))
    summary = CHANNELS + record(11, struct.pack("<QHIIIIQQ", 9, 1, 1, 0, 0, 1, T0_NS, T0_NS) + counts)
    for k, place in enumerate(index(places)):
        times = struct.pack("<QQQQ", T0_NS + k * STEP_NS, T0_NS + k * STEP_NS, place, 0)
        offsets = struct.pack("<IHQ", 10, 1, place)
        summary += record(8, times + offsets + struct.pack("<Q", 0) + text("") + struct.pack("<QQ", 0, 0))
    end = record(2, struct.pack("<QQI", len(body), 0, 0)) + MAGIC
    path.write_bytes(body + summary + end)
    return path


def test_an_index_that_names_a_chunk_a_thousand_times_is_not_believed(tmp_path: Path) -> None:
    chunks = [mcap_chunk(k, mcap_message(k)) for k in range(3)]
    whole = BagFile(indexed_mcap(tmp_path / "whole.mcap", chunks, lambda places: places))
    assert len(list(whole.messages({CAM}))) == 3 and whole.damage == ""
    n_read, what = read_damaged(indexed_mcap(tmp_path / "a.mcap", chunks, lambda places: places * 1000))
    assert n_read == 3 and "chunk twice" in what


def test_one_broken_chunk_of_an_indexed_bag_costs_no_other(tmp_path: Path) -> None:
    chunks = [mcap_chunk(k, mcap_message(k), crc=crc32(mcap_message(k)) ^ (k == 1)) for k in range(5)]
    n_read, what = read_damaged(indexed_mcap(tmp_path / "a.mcap", chunks, lambda places: places))
    assert n_read == 4 and "checksum" in what


def test_more_topics_than_any_robot_has_are_refused(tmp_path: Path) -> None:
    channels = [
        record(4, struct.pack("<HH", k, 1) + text(f"/t{k}") + text("cdr") + text(""))
        for k in range(2, limits.MAX_TOPICS + 5)
    ]
    n_read, what = read_damaged(
        write_mcap(
            tmp_path / "a.mcap", mcap_chunk(0, mcap_message(0)), *channels, mcap_chunk(1, mcap_message(1))
        )
    )
    assert n_read == 1 and f"more than {limits.MAX_TOPICS} topics" in what


def test_an_error_lists_no_more_topics_than_fit_on_a_screen(tmp_path: Path, rig: Rig) -> None:
    channels = [
        record(4, struct.pack("<HH", k, 1) + text(f"/t{k}" + "x" * 5000) + text("cdr") + text(""))
        for k in range(2, 1000)
    ]
    path = write_mcap(tmp_path / "a.mcap", *channels, mcap_chunk(0, mcap_message(0)))
    with pytest.raises(SourceError) as caught:
        open_recording(path, rig)
    assert "and 959 more" in caught.value.hint and len(str(caught.value)) < 10_000


def database(path: Path, columns: str, rows: list[tuple[Any, ...]] = []) -> Path:  # noqa: B006
    with sqlite3.connect(path) as base:
        base.execute(
            "CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT, type TEXT, serialization_format TEXT)"
        )
        base.execute(f"CREATE TABLE messages({columns})")
        base.execute("INSERT INTO topics VALUES (1, ?, 'sensor_msgs/msg/Image', 'cdr')", [CAM])
        for row in rows:
            base.execute(f"INSERT INTO messages VALUES ({','.join('?' * len(row))})", row)
    base.close()
    return path


PLAIN = "id INTEGER PRIMARY KEY, topic_id INTEGER, timestamp INTEGER, data BLOB"


def test_a_compressed_message_of_a_database_that_unpacks_to_a_quarter_of_a_gigabyte_costs_itself_only(
    tmp_path: Path,
) -> None:
    packer = zstd_compressor()
    small = packer.compress(MESSAGE) + packer.flush()
    rows = [(k, 1, T0_NS + k, zeros(zstd_compressor) if k == 1 else small) for k in range(3)]
    path = database(tmp_path / "a.db3", PLAIN, rows)
    assert [m.data for m in _until_damage(BagFile(path))] == [MESSAGE, MESSAGE]
    assert has_note([read_damaged(path)[1]], "unpacks to", "134 MB")


def _until_damage(bag: BagFile) -> Iterator[Any]:
    try:
        yield from bag.messages({CAM})
    except SourceError:
        return


@pytest.mark.skipif(sys.version_info < (3, 11), reason="sqlite3 takes no limits from Python 3.10")
def test_a_computed_column_of_a_database_is_not_filled_with_a_gigabyte(tmp_path: Path) -> None:
    columns = "topic_id INTEGER, timestamp INTEGER, data BLOB AS (CAST(hex(zeroblob(70000000)) AS BLOB))"
    path = database(tmp_path / "a.db3", columns, [(1, T0_NS)])
    n_read, what = read_damaged(path)
    assert n_read == 0 and "too big" in what


def test_a_query_that_never_ends_is_cut_off(tmp_path: Path) -> None:
    path = database(tmp_path / "a.db3", PLAIN)
    with sqlite3.connect(path) as base:
        base.execute("DROP TABLE messages")
        base.execute(
            "CREATE VIEW messages AS WITH RECURSIVE n(i) AS (SELECT 1 UNION ALL SELECT i + 1 FROM n) "
            "SELECT i AS id, 1 AS topic_id, i AS timestamp, x'00' AS data FROM n"
        )
    base.close()
    with pytest.raises(SourceError, match="cannot be read"):
        BagFile(path)


def test_a_file_that_was_compressed_as_a_whole_is_read_and_a_bomb_refused(tmp_path: Path) -> None:
    path = database(tmp_path / "a.db3", PLAIN, [(1, 1, T0_NS, MESSAGE)])
    packer = zstd_compressor()
    folder = tmp_path / "bag"
    folder.mkdir()
    (folder / "a_0.db3.zstd").write_bytes(packer.compress(path.read_bytes()) + packer.flush())
    assert [m.data for m in BagFile(folder).messages({CAM})] == [MESSAGE]
    (folder / "a_0.db3.zstd").write_bytes(zeros(zstd_compressor))
    with pytest.raises(SourceError, match="unpacks to more than a recording of its size can hold"):
        BagFile(folder)


@pytest.mark.parametrize(
    "text", ["[" * 100_000, "a: &a [x,x]\nb: &b [*a,*a]\nc: [*b,*b]\n", "\0" * 1000, "x: " + "y" * (1 << 25)]
)
def test_nothing_in_metadata_can_stop_a_bag_from_being_read(tmp_path: Path, text: str) -> None:
    folder = tmp_path / "bag"
    folder.mkdir()
    database(folder / "a_0.db3", PLAIN, [(1, 1, T0_NS, MESSAGE)])
    (folder / "metadata.yaml").write_text(text)
    assert [m.data for m in _until_damage(BagFile(folder))] == [MESSAGE]


def test_a_piece_of_a_bag_that_metadata_lists_and_that_is_not_there_is_told(tmp_path: Path) -> None:
    folder = tmp_path / "bag"
    folder.mkdir()
    database(folder / "a_0.db3", PLAIN, [(1, 1, T0_NS, MESSAGE)])
    listed = "  relative_file_paths:\n    - a_0.db3\n    - a_1.db3\n"
    (folder / "metadata.yaml").write_text(f"rosbag2_bagfile_information:\n{listed}")
    n_read, what = read_damaged(folder)
    assert n_read == 1 and has_note([what], "metadata.yaml", "'a_1.db3'", "missing")


def test_clouds_and_pictures_of_absurd_sizes_are_left_out_and_the_others_read(
    tmp_path: Path, rig: Rig, room: Any, write_bag: Any, cloud_message: Any, image_message: Any
) -> None:
    def messages() -> Iterator[tuple[str, str, int, dict[str, Any]]]:
        for k in range(6):
            stamp_ns = T0_NS + k * STEP_NS
            cloud = cloud_message(room, stamp_ns)
            image = image_message(np.zeros((24, 32, 3), np.uint8), stamp_ns)
            if k == 1:
                cloud["fields"] = [("x", 0, 2, 1)] * (limits.MAX_FIELDS + 1)
                image |= {"width": (1 << 32) - 1, "height": (1 << 32) - 1}
            elif k == 2:
                # All points are the same byte.
                n_bytes = limits.MAX_POINTS + 1
                cloud |= {"fields": [(axis, 0, 2, 1) for axis in "xyz"], "point_step": 1, "width": n_bytes}
                cloud |= {"row_step": 0, "data": np.zeros(n_bytes, np.uint8)}
                image |= {"step": (1 << 32) - 1}
            elif k == 3:
                cloud |= {"point_step": 0, "width": (1 << 32) - 1, "height": (1 << 32) - 1, "fields": []}
            elif k == 4:
                cloud["fields"] = [(name, at, kind, 2) for name, at, kind, _ in cloud["fields"][:3]]
            yield LIDAR, "PointCloud2", stamp_ns, cloud
            yield CAM, "Image", stamp_ns, image

    recording = open_recording(write_bag(tmp_path / "bag", "mcap", messages()), rig)
    assert isinstance(recording, ContinuousRecording)
    samples = list(recording.samples())
    images = sum(isinstance(sample, Image) for sample in samples)
    assert (images, sum(isinstance(sample, Scan) for sample in samples)) == (4, 2)
    assert has_note(recording.notes, LIDAR, "4 could not", "257 fields")
    assert has_note(recording.notes, CAM, "2 could not", "4294967295x4294967295")


@pytest.mark.parametrize("suffix", [".bag", ".mcap", ".db3", ".pcap", ".pcapng"])
def test_pipes_and_devices_in_place_of_recordings_are_refused_at_once(
    tmp_path: Path, rig: Rig, suffix: str
) -> None:
    os.mkfifo(tmp_path / f"pipe{suffix}")
    (tmp_path / f"zero{suffix}").symlink_to("/dev/zero")
    for name in ("pipe", "zero"):
        with pytest.raises(SourceError, match="it is a pipe or device, not a file"):
            open_recording(tmp_path / f"{name}{suffix}", rig)


def test_a_pipe_beside_the_pieces_of_a_bag_costs_nothing_else(tmp_path: Path, rig: Rig) -> None:
    folder = tmp_path / "bag"
    folder.mkdir()
    database(folder / "a_0.db3", PLAIN, [(1, 1, T0_NS, MESSAGE)])
    os.mkfifo(folder / "a_1.mcap")
    bag = BagFile(folder)
    assert len(bag.fingerprint()) == 64
    n_read, what = read_damaged(folder)
    assert n_read == 1 and has_note([what], "a_1.mcap", "or device")


def packet_message(payload: bytes) -> bytes:
    """An EventPacket of ROS 1 in EVT3."""
    head = struct.pack("<III", 0, T0_NS // 10**9, 0) + text("cam") + struct.pack("<II", 260, 346)
    return head + struct.pack("<QQ", 0, 0) + text("evt3") + b"\0" + struct.pack("<I", len(payload)) + payload


def test_a_packet_that_holds_more_events_than_any_camera_sends_is_left_out(tmp_path: Path) -> None:
    words = np.array([0x8000, 0x6001, 0x0005, 0x2007], "<u2").tobytes()
    sizes = 1, limits.MAX_PACKET_BYTES // 8 + 1, 1
    messages = [("/davis/events", T0_NS + k, packet_message(words * n)) for k, n in enumerate(sizes)]
    losses = Losses()
    events = list(BagEvents(write_packet_bag(tmp_path / "a.bag", messages), None).stretches(losses))
    assert sum(map(len, events)) == 2
    assert "17 MB" in str(losses.findings()[0].figures["where"])


def test_a_packet_whose_words_hold_many_events_each_is_decoded_in_pieces() -> None:
    rng = np.random.default_rng(0)
    words = np.tile(np.array([0x8000, 0x6001, 0x0005, 0x3000, 0x4FFF, 0x4FFF, 0x50FF], "<u2"), 40_000)
    words[1::7] = 0x6000 | np.sort(rng.integers(0, 4096, 40_000))
    decoder = PacketDecoder()
    packet = parse_packet(packet_message(words.tobytes()), "ros1")
    pieces = [*decoder.decode(packet), *decoder.finish()]
    whole = WordDecoder(EVT3).decode(words.astype(np.uint16))
    assert len(pieces) > 2 and max(map(len, pieces)) < len(whole) / 2
    together = join_events(pieces)
    assert np.array_equal(together.t_ns, whole.t_ns) and np.array_equal(together.x, whole.x)
