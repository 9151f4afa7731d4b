"""Bags of ROS 1.

References:
    http://wiki.ros.org/Bags/Format/2.0
"""

import struct

from lce_rig.core import limits
from lce_rig.io.ros.chunks import BAD_RECORD, Block, Chunk, ChunkedBag, Pass
from lce_rig.io.ros.storage import RawMessage

_MAGIC = b"#ROSBAG V2.0\n"
_MESSAGE, _HEADER, _CHUNK, _CHUNK_INFO, _CONNECTION = 2, 3, 5, 6, 7
_MAX_HEADER_BYTES = 1 << 20
_COMPRESSIONS = {b"none": "", b"bz2": "bz2", b"lz4": "lz4"}
_SIZE = struct.Struct("<I")
_TIME = struct.Struct("<II")
_PLACE = struct.Struct("<Q")


class Ros1Bag(ChunkedBag):
    """A .bag file; see `BagStorage`."""

    def _begin(self, whole: Pass) -> int:
        if whole.file.read(len(_MAGIC)) != _MAGIC:
            raise ValueError("it is not a ROS 1 bag of version 2.0" if whole.n_bytes else "it is empty")
        return len(_MAGIC)

    def _read_index(self, whole: Pass) -> bool:
        fields, _ = _record(whole)
        _expect(fields, _HEADER)
        (index_at,) = _PLACE.unpack(fields[b"index_pos"])
        n_connections, n_chunks = (_number(fields[name]) for name in (b"conn_count", b"chunk_count"))
        if index_at == 0:
            raise ValueError("it has no index: its recorder was killed")
        if n_chunks == 0:
            return True
        if index_at >= whole.n_bytes:
            raise ValueError("it ends before its index")
        whole.file.seek(index_at)
        for _ in range(n_connections):
            fields, n_bytes = _record(whole)
            _expect(fields, _CONNECTION)
            self._add_connection(fields, whole.take(n_bytes, limits.MAX_DOCUMENT_BYTES))
        for _ in range(n_chunks):
            fields, n_bytes = _record(whole)
            _expect(fields, _CHUNK_INFO)
            self._add_chunk(fields, whole.take(n_bytes, limits.MAX_DOCUMENT_BYTES))
        return True

    def _add_connection(self, fields: dict[bytes, bytes], data: bytes) -> None:
        topic = fields[b"topic"].decode()
        msgtype = _fields(data)[b"type"].decode()
        root = "/" if topic.startswith("/") else ""
        topic = root + "/".join(part for part in topic.split("/") if part)
        self.contents.add(_number(fields[b"conn"]), topic, msgtype, "ros1")

    def _add_chunk(self, fields: dict[bytes, bytes], data: bytes) -> None:
        counts = dict(_TIME.iter_unpack(data))
        if not any(counts.values()):
            return
        self.contents.counts.update(counts)
        numbers = frozenset(number for number, n in counts.items() if n)
        (position,) = _PLACE.unpack(fields[b"chunk_pos"])
        begin_ns, end_ns = _time_ns(fields[b"start_time"]), _time_ns(fields[b"end_time"])
        self._add(Chunk(position, begin_ns, end_ns, numbers))

    def _read(self, reading: Pass, position: int) -> Block:
        reading.file.seek(position)
        fields, n_bytes = _record(reading)
        kind = fields[b"op"][:1]
        block = Block(reading.file.tell() + n_bytes)
        if kind == bytes([_CHUNK]):
            try:
                data = reading.take(n_bytes)
                compression = _COMPRESSIONS.get(fields[b"compression"])
                if compression is None:
                    raise ValueError(f"compression {limits.describe(fields[b'compression'])} is not known")
                self._read_chunk(reading, reading.unpack(compression, data, _number(fields[b"size"])), block)
            except BAD_RECORD as error:
                block.damages.add(str(error))
        elif kind == bytes([_CONNECTION]):
            self._add_connection(fields, reading.take(n_bytes, limits.MAX_DOCUMENT_BYTES))
        elif kind == bytes([_MESSAGE]):
            self._add_message(reading, fields, reading.take(n_bytes), 0, n_bytes, block)
        return block

    def _read_chunk(self, reading: Pass, raw: bytes, block: Block) -> None:
        at = 0
        for _ in reading.records():
            if at == len(raw):
                break
            n_head = _SIZE.unpack_from(raw, at)[0]
            fields = _fields(raw[at + 4 : at + 4 + min(n_head, _MAX_HEADER_BYTES)])
            begin = at + 8 + n_head
            at = begin + _SIZE.unpack_from(raw, begin - 4)[0]
            if at > len(raw):
                raise ValueError("a record ends behind its chunk")
            kind = fields[b"op"][0] if fields[b"op"] else 0
            if kind == _MESSAGE:
                self._add_message(reading, fields, raw, begin, at, block)
            elif kind == _CONNECTION:
                self._add_connection(fields, raw[begin:at])
            else:
                raise ValueError(f"a chunk holds a record of kind {kind}")

    def _add_message(
        self, reading: Pass, fields: dict[bytes, bytes], raw: bytes, begin: int, end: int, block: Block
    ) -> None:
        number = _number(fields[b"conn"])
        found = self._find_topic(reading, number, block)
        if found is None:
            return
        block.messages.append((number, RawMessage(*found, _time_ns(fields[b"time"]), raw[begin:end])))


def _record(reading: Pass) -> tuple[dict[bytes, bytes], int]:
    """Read a record's header, and how long the data are that follow."""
    fields = _fields(reading.take(_number(reading.take(4)), _MAX_HEADER_BYTES))
    return fields, _number(reading.take(4))


def _fields(header: bytes) -> dict[bytes, bytes]:
    fields = {}
    position = 0
    while position < len(header):
        (size,) = _SIZE.unpack_from(header, position)
        position += 4 + size
        if position > len(header):
            raise ValueError("a field ends behind its header")
        name, _, value = header[position - size : position].partition(b"=")
        fields[name] = value
    return fields


def _expect(fields: dict[bytes, bytes], kind: int) -> None:
    if fields[b"op"] != bytes([kind]):
        raise ValueError(f"its index is damaged: a record is of kind {fields[b'op'].hex()}, not {kind:02x}")


def _number(value: bytes) -> int:
    return int(_SIZE.unpack(value)[0])


def _time_ns(value: bytes) -> int:
    seconds, nanoseconds = _TIME.unpack(value)
    return int(seconds * 10**9 + nanoseconds)
