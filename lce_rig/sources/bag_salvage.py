"""Messages of a bag whose index is missing or torn: read from the front as far as it goes.

A recorder that is killed, or whose disk is full, leaves such bags.

References:
    http://wiki.ros.org/Bags/Format/2.0
    https://mcap.dev/spec
"""

import io
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO, TypeAlias

Found: TypeAlias = tuple[str, str, str, int, bytes]
"""Topic, message type, encoding, time of receipt in ns, data."""

MAX_RECORD_BYTES = 2**31
_CHUNK, _CONNECTION, _MESSAGE = 5, 7, 2
_MCAP_SCHEMA, _MCAP_CHANNEL, _MCAP_MESSAGE, _MCAP_CHUNK = 3, 4, 5, 6
_MCAP_MAGIC = b"\x89MCAP0\r\n"


def salvage(path: Path) -> Iterator[Found]:
    """Yield every message in front of the damage; none where the file is no bag of a known kind.

    Sqlite3 files are left to sqlite's own tools.
    """
    with path.open("rb") as stream:
        magic = stream.readline(16)
        try:
            if magic == b"#ROSBAG V2.0\n":
                yield from _ros1_messages(stream, {})
            elif magic.startswith(_MCAP_MAGIC):
                stream.seek(len(_MCAP_MAGIC))
                yield from _mcap_messages(stream, {}, {})
        except Exception:  # Torn records fail in any way: struct, unicode, lz4, zstd, checksums.
            return


def _take(stream: BinaryIO, n_bytes: int) -> bytes:
    data = stream.read(n_bytes) if 0 <= n_bytes <= MAX_RECORD_BYTES else b""
    if len(data) != n_bytes:
        raise EOFError
    return data


def _ros1_messages(stream: BinaryIO, connections: dict[int, tuple[str, str]]) -> Iterator[Found]:
    while head := stream.read(4):
        fields = _ros1_fields(_take(stream, *struct.unpack("<I", head)))
        data = _take(stream, *struct.unpack("<I", _take(stream, 4)))
        kind = fields["op"][0]
        if kind == _CHUNK:
            yield from _ros1_messages(io.BytesIO(_decompress_ros1(data, fields["compression"])), connections)
        elif kind == _CONNECTION:
            (number,) = struct.unpack("<I", fields["conn"])
            connections[number] = fields["topic"].decode(), _ros1_fields(data)["type"].decode()
        elif kind == _MESSAGE:
            (number,) = struct.unpack("<I", fields["conn"])
            seconds, nanoseconds = struct.unpack("<II", fields["time"])
            topic, msgtype = connections[number]
            yield topic, msgtype, "ros1", seconds * 10**9 + nanoseconds, data


def _ros1_fields(header: bytes) -> dict[str, bytes]:
    fields = {}
    position = 0
    while position < len(header):
        (size,) = struct.unpack_from("<I", header, position)
        name, _, value = header[position + 4 : position + 4 + size].partition(b"=")
        fields[name.decode()] = value
        position += 4 + size
    return fields


def _decompress_ros1(data: bytes, compression: bytes) -> bytes:
    from rosbags.rosbag1.reader import decompressors

    return decompressors[compression.decode()](data)


def _mcap_messages(
    stream: BinaryIO, schemas: dict[int, str], channels: dict[int, tuple[str, str, str]]
) -> Iterator[Found]:
    while head := stream.read(9):
        kind, size = struct.unpack("<BQ", head)
        record = io.BytesIO(_take(stream, size))
        if kind == _MCAP_SCHEMA:
            (number,) = struct.unpack("<H", record.read(2))
            schemas[number] = _mcap_string(record)
        elif kind == _MCAP_CHANNEL:
            number, schema = struct.unpack("<HH", record.read(4))
            channels[number] = _mcap_string(record), schemas.get(schema, ""), _mcap_string(record)
        elif kind == _MCAP_MESSAGE:
            number, _, log_ns, _ = struct.unpack("<HIQQ", record.read(22))
            topic, msgtype, encoding = channels[number]
            yield topic, msgtype, encoding, log_ns, record.read()
        elif kind == _MCAP_CHUNK:
            yield from _mcap_messages(_mcap_chunk(record), schemas, channels)


def _mcap_string(record: BinaryIO) -> str:
    return _take(record, *struct.unpack("<I", record.read(4))).decode()


def _mcap_chunk(record: BinaryIO) -> BinaryIO:
    from rosbags.rosbag2.storage_mcap import decompress

    _, _, size, crc = struct.unpack("<QQQI", record.read(28))
    compression = _mcap_string(record)
    data = _take(record, *struct.unpack("<Q", record.read(8)))
    return io.BytesIO(decompress(data, compression, size, crc))
