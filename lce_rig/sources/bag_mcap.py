"""Bags of ROS 2 in mcap files, and those of ROS 1 that were converted.

References:
    https://mcap.dev/spec
"""

import struct
from binascii import crc32

from lce_rig.core import limits
from lce_rig.sources.bag_chunks import BAD_RECORD, Block, Chunk, ChunkedBag, Pass
from lce_rig.sources.bag_storage import RawMessage

_MAGIC = b"\x89MCAP0\r\n"
_FOOTER, _SCHEMA, _CHANNEL, _MESSAGE, _CHUNK, _CHUNK_INDEX, _STATISTICS, _DATA_END = 2, 3, 4, 5, 6, 8, 11, 15
_HEAD = struct.Struct("<BQ")
_FOOTER_BYTES = _HEAD.size + 20 + len(_MAGIC)
_MESSAGE_HEAD = struct.Struct("<HIQQ")
_CHUNK_HEAD = struct.Struct("<QQQI")
# So many bytes of messages that lie outside of chunks are read at once.
_RUN_BYTES = 1 << 20


class McapBag(ChunkedBag):
    """An .mcap file; see `BagStorage`."""

    def _begin(self, whole: Pass) -> int:
        self._schemas: dict[int, str] = {}
        if whole.file.read(len(_MAGIC)) != _MAGIC:
            raise ValueError("it is no mcap file" if whole.n_bytes else "it is empty")
        return len(_MAGIC)

    def _read_index(self, whole: Pass) -> bool:
        end = max(whole.n_bytes - _FOOTER_BYTES, len(_MAGIC))
        whole.file.seek(end)
        footer = whole.file.read()
        is_whole = len(footer) == _FOOTER_BYTES and footer.endswith(_MAGIC)
        if not is_whole or _HEAD.unpack_from(footer) != (_FOOTER, 20):
            raise ValueError("it has no end, its recorder was killed")
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
        # Some writers leave out of the index what can be found without it.
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
        reading.file.seek(position)
        while block.end is not None:
            kind, n_bytes = _HEAD.unpack(reading.take(_HEAD.size))
            begin = reading.file.tell()
            if kind == _CHUNK and block.end > position:
                break
            block.end = begin + n_bytes
            if kind == _CHUNK:
                try:
                    self._read_chunk(reading, reading.take(n_bytes), block)
                except BAD_RECORD as error:
                    block.damages.add(str(error))
                break
            if kind in (_FOOTER, _DATA_END):
                block.end = None
            elif kind in (_SCHEMA, _CHANNEL, _MESSAGE):
                limit = limits.MAX_CHUNK_BYTES if kind == _MESSAGE else limits.MAX_DOCUMENT_BYTES
                record = reading.take(n_bytes, limit)
                if kind == _MESSAGE:
                    self._add_message(reading, record, 0, len(record), block)
                else:
                    self._describe(kind, record)
            elif block.end > reading.n_bytes:
                raise ValueError(f"it ends within a record at byte {begin}")
            else:
                reading.file.seek(block.end)
            if block.end is not None and (block.end - position > _RUN_BYTES or block.end >= reading.n_bytes):
                break
        return block

    def _read_chunk(self, reading: Pass, record: bytes, block: Block) -> None:
        fields = _Fields(record)
        *_, n_bytes, crc = fields.unpack(_CHUNK_HEAD.format)
        compression, packed = fields.text(), fields.block("<Q")
        del record, fields
        raw = reading.unpack(compression, packed, n_bytes)
        if crc and crc32(raw) != crc:
            raise ValueError("a chunk's checksum is wrong")
        at = 0
        while at < len(raw):
            kind, n_record = _HEAD.unpack_from(raw, at)
            begin = at + _HEAD.size
            at = begin + n_record
            if at > len(raw):
                raise ValueError("a record ends behind its chunk")
            if kind == _MESSAGE:
                self._add_message(reading, raw, begin, at, block)
            elif kind in (_SCHEMA, _CHANNEL):
                self._describe(kind, raw[begin:at])

    def _add_message(self, reading: Pass, raw: bytes, begin: int, end: int, block: Block) -> None:
        if end - begin < _MESSAGE_HEAD.size:
            raise ValueError("a message is shorter than its head")
        number, _, log_ns, _ = _MESSAGE_HEAD.unpack_from(raw, begin)
        if reading.wanted is not None and number not in reading.wanted:
            return
        found = self.contents.connections.get(number)
        if found is None:
            block.damages.add(f"a message of no known topic, {number}")
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
