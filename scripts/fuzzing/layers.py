"""What lies inside files: taken out, damaged and put back with lengths and checksums that fit.

Else damage would end at the first checksum, and nothing behind it would ever be tried.
"""

import bz2
import io
import struct
import tempfile
import zipfile
import zlib
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np

from fuzzing.mutations import Form

PNG_MAGIC = b"\x89PNG\r\n\x1a\n"
_ROS1_MAGIC, _MCAP_MAGIC = b"#ROSBAG V2.0\n", b"\x89MCAP0\r\n"
_ROS1_CHUNK = 5
_MCAP_FOOTER, _MCAP_CHUNK, _MCAP_CHUNK_INDEX = 2, 6, 8
_LZ4_MAGIC, _ZSTD_MAGIC = b"\x04\x22\x4d\x18", b"\x28\xb5\x2f\xfd"
_VALUES = "values_json.npy"


@dataclass(frozen=True)
class Layer:
    """How a file's inner parts are reached.

    Attributes:
        form: what the parts are.
        split: the parts of a sound file.
        join: the sound file with other parts in their places.
    """

    form: Form
    split: Callable[[bytes], list[bytes]]
    join: Callable[[bytes, list[bytes]], bytes]


WHOLE = Layer("bytes", lambda data: [data], lambda _data, parts: parts[0])
TEXT = Layer("text", lambda data: [data], lambda _data, parts: parts[0])
JSON = Layer("json", lambda data: [data], lambda _data, parts: parts[0])
LINES = Layer("lines", lambda data: [data], lambda _data, parts: parts[0])


def zstd() -> Any:
    """Import the Zstandard that this Python or rosbags brings."""
    try:
        return import_module("compression.zstd")
    except ImportError:
        return import_module("backports.zstd")


def lz4() -> Any:
    """Import LZ4's frame format."""
    return import_module("lz4.frame")


# Zip and NumPy archives


def _zip_members(data: bytes) -> list[bytes]:
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        return [archive.read(name) for name in archive.namelist()]


def _zip_of(data: bytes, parts: list[bytes]) -> bytes:
    buffer = io.BytesIO()
    with zipfile.ZipFile(io.BytesIO(data)) as old, zipfile.ZipFile(buffer, "w") as new:
        for name, part in zip(old.namelist(), parts, strict=True):
            new.writestr(zipfile.ZipInfo(name), part, zipfile.ZIP_DEFLATED)
    return buffer.getvalue()


ZIP_MEMBERS = Layer("bytes", _zip_members, _zip_of)
ZIP_TEXTS = Layer("text", _zip_members, _zip_of)


def _cached_json(data: bytes, member: str) -> list[bytes]:
    with np.load(io.BytesIO(data)) as archive:
        return [archive[member.removesuffix(".npy")].tobytes()]


def _with_cached_json(data: bytes, parts: list[bytes], member: str) -> bytes:
    with np.load(io.BytesIO(data)) as archive:
        arrays = {name: archive[name] for name in archive.files}
    arrays[member.removesuffix(".npy")] = np.frombuffer(parts[0], np.uint8)
    buffer = io.BytesIO()
    np.savez_compressed(buffer, allow_pickle=False, **arrays)
    return buffer.getvalue()


def cached_json(name: str) -> Layer:
    """Reach a JSON text that lies in a NumPy archive as an array of bytes."""
    return Layer(
        "json",
        lambda data: _cached_json(data, name),
        lambda data, parts: _with_cached_json(data, parts, name),
    )


# PNG


def _png_chunks(data: bytes) -> list[bytes]:
    parts, at = [], len(PNG_MAGIC)
    while at < len(data):
        (length,) = struct.unpack_from(">I", data, at)
        parts.append(data[at + 4 : at + 8 + length])
        at += 12 + length
    return parts


def _png_of(_data: bytes, parts: list[bytes]) -> bytes:
    chunks = (struct.pack(">I", max(len(p) - 4, 0)) + p + struct.pack(">I", zlib.crc32(p)) for p in parts)
    return PNG_MAGIC + b"".join(chunks)


def _png_rows(data: bytes) -> list[bytes]:
    return [zlib.decompress(b"".join(p[4:] for p in _png_chunks(data) if p[:4] == b"IDAT"))]


def _png_of_rows(data: bytes, parts: list[bytes]) -> bytes:
    others = [p for p in _png_chunks(data) if p[:4] != b"IDAT"]
    return _png_of(data, [*others[:-1], b"IDAT" + zlib.compress(parts[0]), others[-1]])


PNG_CHUNKS = Layer("bytes", _png_chunks, _png_of)
PNG_ROWS = Layer("bytes", _png_rows, _png_of_rows)


# PCD


def _lzf_raw(data: bytes) -> list[bytes]:
    from lce_rig.core.pcd import decode_pcd

    cloud = decode_pcd(data)
    return [b"".join(cloud[name].tobytes() for name in cloud.dtype.names or ())]


def lzf_literals(raw: bytes) -> bytes:
    """Pack bytes as LZF without references."""
    runs = (raw[at : at + 32] for at in range(0, len(raw), 32))
    return b"".join(bytes([len(run) - 1]) + run for run in runs)


def _pcd_of_raw(data: bytes, parts: list[bytes]) -> bytes:
    head = data[: data.index(b"DATA binary_compressed\n") + 23]
    packed = lzf_literals(parts[0])
    return head + struct.pack("<II", len(packed), len(parts[0])) + packed


PCD_COLUMNS = Layer("bytes", _lzf_raw, _pcd_of_raw)


# AEDAT4


def aedat4_packets(data: bytes) -> Iterator[tuple[int, bytes]]:
    """Yield place and content of the packets of a file that was never closed: no table follows them."""
    from lce_rig.io.events.aedat4_file import MAGIC

    at = len(MAGIC) + 4 + int(struct.unpack_from("<I", data, len(MAGIC))[0])
    while at + 8 <= len(data):
        _stream, size = struct.unpack_from("<ii", data, at)
        if size < 0 or at + 8 + size > len(data):
            return
        yield at, data[at + 8 : at + 8 + size]
        at += 8 + size


def unpack_frame(data: bytes) -> bytes:
    """Decompress LZ4 or Zstandard; anything else stays."""
    if data[:4] == _LZ4_MAGIC:
        return bytes(lz4().decompress(data))
    return bytes(zstd().decompress(data)) if data[:4] == _ZSTD_MAGIC else data


def _pack_like(data: bytes, like: bytes) -> bytes:
    if like[:4] == _LZ4_MAGIC:
        return bytes(lz4().compress(data))
    return bytes(zstd().compress(data)) if like[:4] == _ZSTD_MAGIC else data


def _aedat4_tables(data: bytes) -> list[bytes]:
    return [unpack_frame(packet) for _, packet in aedat4_packets(data)]


def _aedat4_of(data: bytes, parts: list[bytes]) -> bytes:
    packets = list(aedat4_packets(data))
    body = b""
    for (at, packet), part in zip(packets, parts, strict=True):
        packed = _pack_like(part, packet)
        body += data[at : at + 4] + struct.pack("<i", len(packed)) + packed
    return data[: packets[0][0]] + body


AEDAT4_TABLES = Layer("bytes", _aedat4_tables, _aedat4_of)


def aedat4_recompressed(data: bytes, pack: Callable[[bytes], bytes]) -> bytes:
    """Write a file's packets with another compression."""
    packets = list(aedat4_packets(data))
    body = b"".join(
        data[at : at + 4] + struct.pack("<i", len(packed)) + packed
        for at, packed in ((at, pack(unpack_frame(packet))) for at, packet in packets)
    )
    return data[: packets[0][0]] + body


# ROS 1 bags


@dataclass(frozen=True)
class _Record:
    header: bytes
    data: bytes

    @property
    def kind(self) -> int:
        at = self.header.index(b"op=")
        return self.header[at + 3]

    def pack(self) -> bytes:
        return (
            struct.pack("<I", len(self.header)) + self.header + struct.pack("<I", len(self.data)) + self.data
        )


def _ros1_records(data: bytes) -> list[_Record]:
    records, at = [], len(_ROS1_MAGIC)
    while at < len(data):
        (n,) = struct.unpack_from("<I", data, at)
        header, at = data[at + 4 : at + 4 + n], at + 4 + n
        (n,) = struct.unpack_from("<I", data, at)
        records.append(_Record(header, data[at + 4 : at + 4 + n]))
        at += 4 + n
    return records


def _with_field(header: bytes, name: bytes, change: Callable[[bytes], bytes]) -> bytes:
    at = header.index(name + b"=")
    (size,) = struct.unpack_from("<I", header, at - 4)
    begin, end = at + len(name) + 1, at + size
    value = change(header[begin:end])
    return (
        header[: at - 4] + struct.pack("<I", len(name) + 1 + len(value)) + name + b"=" + value + header[end:]
    )


def _ros1_codec(header: bytes) -> tuple[Callable[[bytes], bytes], Callable[[bytes], bytes]]:
    if b"compression=bz2" in header:
        return bz2.decompress, bz2.compress
    if b"compression=lz4" in header:
        return lz4().decompress, lz4().compress
    return bytes, bytes


def _ros1_chunks(data: bytes) -> list[bytes]:
    return [_ros1_codec(r.header)[0](r.data) for r in _ros1_records(data) if r.kind == _ROS1_CHUNK]


def _ros1_of(data: bytes, parts: list[bytes]) -> bytes:
    """Put the chunk of a bag of one chunk back."""
    if len(parts) != 1:
        raise ValueError(f"{len(parts)} chunks, not one")
    header = next(r.header for r in _ros1_records(data) if r.kind == _ROS1_CHUNK)
    return ros1_with_chunk(data, _ros1_codec(header)[1](parts[0]), len(parts[0]))


def ros1_with_chunk(data: bytes, packed: bytes, n_raw: int) -> bytes:
    """Replace the chunk of a bag of one chunk; the index behind it moves along.

    Args:
        data: the bag.
        packed: the chunk's compressed content.
        n_raw: its size as it is declared.
    """
    records = _ros1_records(data)
    at = next(number for number, record in enumerate(records) if record.kind == _ROS1_CHUNK)
    grown = len(packed) - len(records[at].data)
    records[at] = _Record(
        _with_field(records[at].header, b"size", lambda _: struct.pack("<I", n_raw)), packed
    )
    moved = _with_field(
        records[0].header, b"index_pos", lambda old: struct.pack("<Q", struct.unpack("<Q", old)[0] + grown)
    )
    records[0] = _Record(moved, records[0].data)
    return _ROS1_MAGIC + b"".join(record.pack() for record in records)


ROS1_CHUNKS = Layer("bytes", _ros1_chunks, _ros1_of)


def ros1_unindexed(data: bytes) -> bytes:
    """Cut a bag off behind its last chunk, as a recorder that was killed leaves it."""
    records = _ros1_records(data)
    last = max(number for number, record in enumerate(records) if record.kind == _ROS1_CHUNK)
    unknown = _with_field(records[0].header, b"index_pos", lambda _: bytes(8))
    kept = [_Record(unknown, records[0].data), *records[1 : last + 1]]
    return _ROS1_MAGIC + b"".join(record.pack() for record in kept)


# mcap


def _mcap_records(data: bytes) -> list[tuple[int, bytes]]:
    records, at = [], len(_MCAP_MAGIC)
    while at + 9 <= len(data) - len(_MCAP_MAGIC):
        kind, size = struct.unpack_from("<BQ", data, at)
        records.append((kind, data[at + 9 : at + 9 + size]))
        at += 9 + size
    return records


def _mcap_text(data: bytes, at: int) -> tuple[bytes, int]:
    (n,) = struct.unpack_from("<I", data, at)
    return data[at + 4 : at + 4 + n], at + 4 + n


def _mcap_codec(name: bytes) -> tuple[Callable[[bytes], bytes], Callable[[bytes], bytes]]:
    if name == b"zstd":
        return zstd().decompress, zstd().compress
    return (lz4().decompress, lz4().compress) if name == b"lz4" else (bytes, bytes)


def _mcap_chunks(data: bytes) -> list[bytes]:
    parts = []
    for kind, record in _mcap_records(data):
        if kind == _MCAP_CHUNK:
            name, at = _mcap_text(record, 28)
            parts.append(_mcap_codec(name)[0](record[at + 8 :]))
    return parts


def _mcap_of(data: bytes, parts: list[bytes], compression: bytes | None = None) -> bytes:
    """Put the chunk of a file of one chunk back, and its index."""
    if len(parts) != 1:
        raise ValueError(f"{len(parts)} chunks, not one")
    old = next(_mcap_text(record, 28)[0] for kind, record in _mcap_records(data) if kind == _MCAP_CHUNK)
    name = old if compression is None else compression
    return mcap_with_chunk(data, _mcap_codec(name)[1](parts[0]), len(parts[0]), zlib.crc32(parts[0]), name)


def mcap_with_chunk(data: bytes, packed: bytes, n_raw: int, crc: int, compression: bytes) -> bytes:
    """Replace the chunk of a file of one chunk.

    Args:
        data: the file.
        packed: the chunk's compressed content.
        n_raw: its size as it is declared.
        crc: its checksum; 0 for none.
        compression: its name.
    """
    records, grown = _mcap_records(data), 0
    for number, (kind, record) in enumerate(records):
        if kind == _MCAP_CHUNK:
            new = record[:16] + struct.pack("<QI", n_raw, crc)
            new += struct.pack("<I", len(compression)) + compression + struct.pack("<Q", len(packed)) + packed
            grown = len(new) - len(record)
            records[number] = kind, new
    grown_before_footer = grown
    for number, (kind, record) in enumerate(records):
        if kind == _MCAP_CHUNK_INDEX:
            new = _moved_chunk_index(record, grown, n_raw, len(packed), compression)
            grown_before_footer += len(new) - len(record)
            records[number] = kind, new
    for number, (kind, record) in enumerate(records):
        if kind == _MCAP_FOOTER:
            summary, offsets, _ = struct.unpack("<QQI", record)
            moved = offsets + grown_before_footer if offsets else 0
            records[number] = kind, struct.pack("<QQI", summary + grown if summary else 0, moved, 0)
    body = b"".join(struct.pack("<BQ", kind, len(record)) + record for kind, record in records)
    return _MCAP_MAGIC + body + _MCAP_MAGIC


def _moved_chunk_index(record: bytes, grown: int, n_raw: int, n_packed: int, name: bytes) -> bytes:
    start, end, at, length = struct.unpack_from("<4Q", record)
    (n_map,) = struct.unpack_from("<I", record, 32)
    offsets = b"".join(
        struct.pack("<HQ", channel, offset + grown)
        for channel, offset in struct.iter_unpack("<HQ", record[36 : 36 + n_map])
    )
    rest = 36 + n_map
    index_length = record[rest : rest + 8]
    head = struct.pack("<4Q", start, end, at, length + grown) + struct.pack("<I", n_map) + offsets
    return head + index_length + struct.pack("<I", len(name)) + name + struct.pack("<QQ", n_packed, n_raw)


MCAP_CHUNKS = Layer("bytes", _mcap_chunks, _mcap_of)


def mcap_recompressed(data: bytes, compression: str) -> bytes:
    """Write a file's chunks with another compression: "", "lz4", "zstd"."""
    return _mcap_of(data, _mcap_chunks(data), compression.encode())


def mcap_unindexed(data: bytes) -> bytes:
    """Cut a file off behind its last chunk, as a recorder that was killed leaves it."""
    records = _mcap_records(data)
    last = max(number for number, (kind, _) in enumerate(records) if kind == _MCAP_CHUNK)
    return _MCAP_MAGIC + b"".join(struct.pack("<BQ", k, len(r)) + r for k, r in records[: last + 1])


# Messages of any bag


def messages_of(suffix: str) -> Layer:
    """Reach the messages of a bag file; they are put back by rosbags, with everything else right."""
    return Layer(
        "bytes", lambda data: [m[-1] for m in messages_in(data, suffix)], lambda d, p: _bag_of(d, p, suffix)
    )


def messages_in(data: bytes, suffix: str) -> list[tuple[Any, int, bytes]]:
    """List (connection, time of receipt, serialised message) of a bag file."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"a{suffix}"
        path.write_bytes(data)
        with _bag_reader(path) as reader:
            return [(connection, stamp, bytes(raw)) for connection, stamp, raw in reader.messages()]


def _bag_reader(path: Path) -> Any:
    if path.suffix == ".bag":
        from rosbags.rosbag1 import Reader as Reader1

        return Reader1(path)
    from rosbags.rosbag2 import Reader as Reader2

    return Reader2(path)


def _bag_of(data: bytes, parts: list[bytes], suffix: str) -> bytes:
    messages = messages_in(data, suffix)
    changed = [(c, stamp, part) for (c, stamp, _), part in zip(messages, parts, strict=True)]
    return write_raw_messages(changed, suffix)


def write_raw_messages(messages: list[tuple[Any, int, bytes]], suffix: str) -> bytes:
    """Write serialised messages, with connections as rosbags' readers give them, as one bag file."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"a{'.bag' if suffix == '.bag' else ''}"
        with bag_writer(path, suffix) as writer:
            add_raw_messages(writer, messages, is_ros1=suffix == ".bag")
        file = path if suffix == ".bag" else next(path.glob(f"*{suffix}"))
        return file.read_bytes()


def add_raw_messages(writer: Any, messages: list[tuple[Any, int, bytes]], *, is_ros1: bool) -> None:
    """Write serialised messages into an open bag."""
    known: dict[int, Any] = {}
    for connection, stamp, raw in messages:
        if connection.id not in known:
            # A file without its folder's metadata does not say the hash of a type.
            digest = {"md5sum" if is_ros1 else "rihs01": connection.digest or "RIHS01_" + 64 * "0"}
            known[connection.id] = writer.add_connection(
                connection.topic, connection.msgtype, msgdef=connection.msgdef.data, **digest
            )
        writer.write(known[connection.id], stamp, raw)


def bag_writer(path: Path, suffix: str) -> Any:
    """Begin a bag: ROS 1, or the folder of a ROS 2 bag with a file of that suffix."""
    if suffix == ".bag":
        from rosbags.rosbag1 import Writer as Writer1

        return Writer1(path)
    from rosbags.rosbag2 import StoragePlugin
    from rosbags.rosbag2 import Writer as Writer2

    plugin = StoragePlugin.MCAP if suffix == ".mcap" else StoragePlugin.SQLITE3
    return Writer2(path, version=9, storage_plugin=plugin)


# Packets of the network


def _pcap_payloads(data: bytes) -> list[bytes]:
    return [data[begin + 42 : begin + n] for begin, n in _pcap_frames(data)]


def _pcap_frames(data: bytes) -> Iterator[tuple[int, int]]:
    at = 24
    while at + 16 <= len(data):
        (n,) = struct.unpack_from("<I", data, at + 8)
        yield at + 16, n
        at += 16 + n


def _pcap_of(data: bytes, parts: list[bytes]) -> bytes:
    """Put UDP payloads back; IP's and UDP's lengths follow."""
    from lce_rig.io.velodyne.datagrams import ETHERNET, build_frame, read_datagram

    out = data[:24]
    for (begin, n), part in zip(_pcap_frames(data), parts, strict=True):
        datagram = read_datagram(ETHERNET, 0, data[begin : begin + n], Counter())
        frame = data[begin : begin + n]
        if datagram is not None:
            frame = build_frame(replace(datagram, payload=part[:60_000]))
        out += data[begin - 16 : begin - 8] + struct.pack("<II", len(frame), len(frame)) + frame
    return out


PCAP_PAYLOADS = Layer("bytes", _pcap_payloads, _pcap_of)
