"""Bags of ROS 2 in mcap files, and those of ROS 1 that were converted.

References:
    https://mcap.dev/spec
"""

import struct
from binascii import crc32

from lce_rig.core import limits
from lce_rig.io.ros.chunks import BAD_RECORD, Block, Chunk, ChunkedBag, Pass
from lce_rig.io.ros.storage import RawMessage

_MAGIC = b"\x89MCAP0\r\n"
_FOOTER, _SCHEMA, _CHANNEL, _MESSAGE, _CHUNK, _CHUNK_INDEX, _STATISTICS, _DATA_END = 2, 3, 4, 5, 6, 8, 11, 15
_HEAD = struct.Struct("<BQ")
_FOOTER_BYTES = _HEAD.size + 20 + len(_MAGIC)
_MESSAGE_HEAD = struct.Struct("<HIQQ")
_CHUNK_HEAD = struct.Struct("<QQQII")
_MAX_NAME_BYTES = 64
# So many bytes of messages that lie outside of chunks are read at once.
_RUN_BYTES = 1 << 20


class McapBag(ChunkedBag):
    """An .mcap file; see `BagStorage`."""

    def _begin(self, whole: Pass) -> int:
        self._schemas: dict[int, str] = {}
        if whole.file.read(len(_MAGIC)) != _MAGIC:
            raise ValueError("it is not an mcap file" if whole.n_bytes else "it is empty")
        return len(_MAGIC)

    def _read_index(self, whole: Pass) -> bool:
        end = max(whole.n_bytes - _FOOTER_BYTES, len(_MAGIC))
        whole.file.seek(end)
        footer = whole.file.read()
        is_whole = len(footer) == _FOOTER_BYTES and footer.endswith(_MAGIC)
        if not is_whole or _HEAD.unpack_from(footer) != (_FOOTER, 20):
            raise ValueError("it has no end: its recorder was killed")
        (position,) = struct.unpack_from("<Q", footer, _HEAD.size)
        if position == 0:
            return False
        n_messages = -1
        while position < end:
            whole.file.seek(position)
            kind, n_bytes = _HEAD.unpack(whole.take(_HEAD.size))
            if kind in (_SCHEMA, _CHANNEL):
                self._describe(kind, whole.take(n_bytes, limits.MAX_DOCUMENT_BYTES))
            elif kind == _CHUNK_INDEX:
                self._add_chunk(_Fields(whole.take(n_bytes, limits.MAX_DOCUMENT_BYTES)))
            elif kind == _STATISTICS:
                fields = _Fields(whole.take(n_bytes, limits.MAX_DOCUMENT_BYTES))
                n_messages = fields.unpack("<QHIIIIQQ")[0]
                self.contents.counts.update(dict(struct.iter_unpack("<HQ", fields.block("<I"))))
            position += _HEAD.size + n_bytes
        if n_messages == 0:
            return True
        # Some writers omit from the index what can be found without it.
        return bool(n_messages > 0 and self._chunks and self.contents.connections)

    def _add_chunk(self, fields: "_Fields") -> None:
        start_ns, end_ns, position, _ = fields.unpack("<QQQQ")
        numbers = frozenset(number for number, _ in struct.iter_unpack("<HQ", fields.block("<I")))
        # Without an index of its messages a chunk may hold any.
        self._add(Chunk(position, start_ns, end_ns, numbers or None))

    def _describe(self, kind: int, record: bytes) -> None:
        fields = _Fields(record)
        if kind == _SCHEMA:
            (number,) = fields.unpack("<H")
            if len(self._schemas) < limits.MAX_TOPICS:
                self._schemas[number] = fields.text()
            return
        number, schema = fields.unpack("<HH")
        topic, encoding = fields.text(), fields.text()
        self.contents.add(number, topic, self._schemas.get(schema, ""), encoding)

    def _read(self, reading: Pass, position: int) -> Block:
        """Read a chunk; or a run of messages that lie outside of chunks."""
        block = Block(position)
        at = position
        while at - position <= _RUN_BYTES and at < reading.n_bytes:
            try:
                kind = self._read_record(reading, at, block)
            except BAD_RECORD:
                if at == position:
                    raise
                # The next block says what is wrong, and this one keeps what it has.
                block.end = at
                break
            if kind == _CHUNK or block.end is None:
                break
            at = block.end
        return block

    def _read_record(self, reading: Pass, at: int, block: Block) -> int:
        reading.file.seek(at)
        kind, n_bytes = _HEAD.unpack(reading.take(_HEAD.size))
        begin = at + _HEAD.size
        if begin + n_bytes > reading.n_bytes:
            raise ValueError(f"it ends within a record at byte {begin}")
        if kind == _CHUNK:
            if block.messages:
                return int(kind)  # A block of its own.
            block.end = begin + n_bytes
            try:
                self._read_chunk(reading, block)
            except BAD_RECORD as error:
                block.damages.add(str(error))
        elif kind == _MESSAGE:
            record = reading.take(n_bytes)
            self._add_message(reading, record, 0, len(record), block)
        elif kind in (_SCHEMA, _CHANNEL):
            self._describe(kind, reading.take(n_bytes, limits.MAX_DOCUMENT_BYTES))
        block.end = None if kind in (_FOOTER, _DATA_END) else begin + n_bytes
        return int(kind)

    def _read_chunk(self, reading: Pass, block: Block) -> None:
        *_, n_bytes, crc, n_name = _CHUNK_HEAD.unpack(reading.take(_CHUNK_HEAD.size))
        compression = reading.take(n_name, _MAX_NAME_BYTES).decode()
        n_packed = int.from_bytes(reading.take(8), "little")
        if reading.file.tell() + n_packed > (block.end or 0):
            raise ValueError("a chunk ends behind its record")
        raw = reading.unpack(compression, reading.take(n_packed), n_bytes)
        if crc and crc32(raw) != crc:
            raise ValueError("a chunk's checksum is wrong")
        at = 0
        for _ in reading.records():
            if at == len(raw):
                break
            kind, n_record = _HEAD.unpack_from(raw, at)
            begin = at + _HEAD.size
            at = begin + n_record
            if at > len(raw):
                raise ValueError("a record ends behind its chunk")
            if kind == _MESSAGE:
                self._add_message(reading, raw, begin, at, block)
            elif kind in (_SCHEMA, _CHANNEL):
                self._describe(kind, raw[begin:at])
            else:
                raise ValueError(f"a chunk holds a record of kind {kind}")

    def _add_message(self, reading: Pass, raw: bytes, begin: int, end: int, block: Block) -> None:
        if end - begin < _MESSAGE_HEAD.size:
            raise ValueError("a message is shorter than its head")
        number, _, log_ns, _ = _MESSAGE_HEAD.unpack_from(raw, begin)
        found = self._find_topic(reading, number, block)
        if found is None:
            return
        block.messages.append((number, RawMessage(*found, log_ns, raw[begin + _MESSAGE_HEAD.size : end])))


class _Fields:
    """A record's fields, one after the other; struct.error and ValueError where they are not there."""

    def __init__(self, record: bytes) -> None:
        self._record = record
        self._at = 0

    def unpack(self, form: str) -> tuple[int, ...]:
        values = struct.unpack_from(form, self._record, self._at)
        self._at += struct.calcsize(form)
        return values

    def block(self, form: str) -> bytes:
        """Read bytes that follow their number."""
        (n_bytes,) = self.unpack(form)
        if n_bytes > len(self._record) - self._at:
            raise ValueError("a field ends behind its record")
        self._at += n_bytes
        return self._record[self._at - n_bytes : self._at]

    def text(self) -> str:
        return self.block("<I").decode()
