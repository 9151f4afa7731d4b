"""Bag files with chunks of messages: read by their index, or from the front if it is damaged.

A chunk that cannot be read costs its own messages only. What the index says of places, times and counts is
not believed further than it takes to find the chunks: each is read once, and what all unpack to is limited by
the size of the file.
"""

import os
import struct
from abc import ABC, abstractmethod
from collections.abc import Collection, Iterable, Iterator
from dataclasses import dataclass, field
from heapq import heappop, heappush
from pathlib import Path
from typing import BinaryIO

from lce_rig.core import limits, unpacking
from lce_rig.io.ros.storage import Connection, Contents, Damages, RawMessage, unpack

# What a message takes of a file at least, packed as well as can be.
_MIN_RECORD_BYTES = 4
# Recorders write chunks one after the other: so much may wait for a chunk that begins earlier than it ends.
_MAX_WAITING_BYTES = 1 << 23
BAD_RECORD = (ValueError, KeyError, struct.error)
"""What records that make no sense raise."""


@dataclass(frozen=True)
class Chunk:
    """A chunk, as the index has it.

    Attributes:
        position: of its record in the file.
        start_ns, end_ns: receipt of its first and last message.
        connections: numbers of those it holds messages of; None where that is not known.
    """

    position: int
    start_ns: int
    end_ns: int
    connections: frozenset[int] | None = None

    def holds(self, numbers: frozenset[int]) -> bool:
        """Return whether it may hold messages of some connections."""
        return self.connections is None or not numbers.isdisjoint(self.connections)


@dataclass
class Block:
    """The data read at one position of the file.

    Attributes:
        end: place behind it; None where nothing follows that could be read.
        messages: (number of the connection, message), of the connections wanted.
        damages: what could not be read of it.
    """

    end: int | None
    messages: list[tuple[int, RawMessage]] = field(default_factory=list)
    damages: Damages = field(default_factory=Damages)


class Pass:
    """One pass through a file.

    Attributes:
        file: the file.
        n_bytes: its size.
        wanted: numbers of the connections whose messages are kept; None for all.
    """

    def __init__(self, file: BinaryIO, wanted: frozenset[int] | None = None) -> None:
        self.file = file
        self.n_bytes = os.fstat(file.fileno()).st_size
        self.wanted = wanted
        self._n_records_left = self.n_bytes // _MIN_RECORD_BYTES + limits.MAX_RECORDS
        self._n_left = unpacking.MAX_RATIO * self.n_bytes + 2 * limits.MAX_CHUNK_BYTES

    def take(self, n_bytes: int, max_bytes: int = limits.MAX_CHUNK_BYTES) -> bytes:
        """Read exactly so many bytes.

        Raises:
            ValueError: they are not there, or are more than any recorder writes.
        """
        if not 0 <= n_bytes <= self.n_bytes - self.file.tell():
            raise ValueError(f"it ends within a record at byte {self.file.tell()}")
        limits.check_size(n_bytes, "a record", max_bytes)
        return self.file.read(n_bytes)

    def records(self) -> Iterator[int]:
        """Count the records of a chunk while they are read.

        Raises:
            ValueError: they are more than a chunk, or all chunks of such a file, can hold.
        """
        n_allowed = min(limits.MAX_RECORDS, self._n_records_left)
        for n in range(n_allowed):
            self._n_records_left -= 1
            yield n
        raise ValueError(f"a chunk holds more than {n_allowed} records")

    def unpack(self, compression: str, data: bytes, n_bytes: int) -> bytes:
        """Unpack a chunk that says how large it is.

        Raises:
            ValueError: it is damaged, of another size, or too large for what the file is.
        """
        limits.check_size(n_bytes, "a chunk")
        if n_bytes > self._n_left:
            raise ValueError("its chunks unpack to more than a recording of this size can hold")
        raw = unpack(compression, data, n_bytes) if compression else data
        self._n_left -= len(raw)
        if len(raw) != n_bytes:
            raise ValueError(f"a chunk unpacks to {len(raw)} bytes and declares {n_bytes}")
        return raw


class ChunkedBag(ABC):
    """One file of a bag, of ROS 1 or mcap; see `BagStorage`."""

    def __init__(self, path: Path) -> None:
        """Read the index; without one, everything.

        Raises:
            OSError: the file cannot be read.
            ValueError: it is not a file, or none of this kind.
        """
        self.path = path
        self.contents = Contents()
        self._chunks: list[Chunk] = []
        self._positions: set[int] = set()
        with limits.open_regular(path) as file:
            whole = Pass(file)
            begin = self._begin(whole)
            try:
                is_indexed = self._read_index(whole)
            except BAD_RECORD as error:
                is_indexed = False
                self.contents.damages.add(_said(error))
            if not is_indexed:
                self._survey(whole, begin)
        self._chunks.sort(key=lambda chunk: chunk.start_ns)
        self.contents.start_ns = self._chunks[0].start_ns if self._chunks else None

    def messages(self, topics: Collection[str], damages: Damages) -> Iterator[RawMessage]:
        """Yield the messages of some topics in the order of receipt; what cannot be read is counted."""
        wanted = self.contents.numbers(topics)
        with limits.open_regular(self.path) as file:
            reading = Pass(file, wanted)
            chunks = [chunk for chunk in self._chunks if chunk.holds(wanted)]
            yield from _in_order(
                (chunk.start_ns, self._read_safely(reading, chunk.position, damages)) for chunk in chunks
            )

    def end_ns(self, topic: str) -> int | None:
        """Find when a topic's last message was received, from the back; None where it has none."""
        wanted = self.contents.numbers({topic})
        chunks = [chunk for chunk in self._chunks if chunk.holds(wanted)]
        last_ns: int | None = None
        with limits.open_regular(self.path) as file:
            reading = Pass(file, wanted)
            for chunk in sorted(chunks, key=lambda chunk: -chunk.end_ns):
                if last_ns is not None and chunk.end_ns <= last_ns:
                    break
                for message in self._read_safely(reading, chunk.position, Damages()):
                    last_ns = message.log_ns if last_ns is None else max(last_ns, message.log_ns)
        return last_ns

    def _add(self, chunk: Chunk) -> None:
        """Take a chunk of the index.

        Raises:
            ValueError: the index has it already.
        """
        if chunk.position in self._positions:
            raise ValueError("its index names a chunk twice")
        self._positions.add(chunk.position)
        self._chunks.append(chunk)

    def _read_safely(self, reading: Pass, position: int, damages: Damages) -> Iterator[RawMessage]:
        """Read a chunk when its first message is asked for."""
        try:
            block = self._read(reading, position)
        except BAD_RECORD as error:
            damages.add(f"at byte {position}: {_said(error)}")
            return
        if block.damages.n_places:
            damages.add(f"at byte {position}: {block.damages}")
        messages = sorted((message for _, message in block.messages), key=lambda message: message.log_ns)
        del block
        yield from messages

    def _find_topic(self, reading: Pass, number: int, block: Block) -> Connection | None:
        """Look up what a message is of; None where it is not wanted or not known."""
        if reading.wanted is not None and number not in reading.wanted:
            return None
        found = self.contents.connections.get(number)
        if found is None:
            block.damages.add(f"a message of no known topic, {number}")
        return found

    def _survey(self, whole: Pass, begin: int) -> None:
        """Go through the file from the front, as far as records follow each other, and count."""
        contents = self.contents
        contents.counts.clear()
        self._chunks.clear()
        position: int | None = begin
        while position is not None and position < whole.n_bytes:
            try:
                block = self._read(whole, position)
            except BAD_RECORD as error:
                contents.damages.add(_said(error))
                break
            if block.damages.n_places:
                contents.damages.add(f"at byte {position}: {block.damages}")
            if block.messages:
                times_ns = [message.log_ns for _, message in block.messages]
                numbers = [number for number, _ in block.messages]
                self._chunks.append(Chunk(position, min(times_ns), max(times_ns), frozenset(numbers)))
                contents.counts.update(numbers)
            position = block.end

    @abstractmethod
    def _begin(self, whole: Pass) -> int:
        """Find where the first record lies.

        Raises:
            ValueError: the file is of another kind.
        """

    @abstractmethod
    def _read_index(self, whole: Pass) -> bool:
        """Fill contents and chunks from the index; False where the file was made without one.

        Raises:
            ValueError, KeyError, struct.error: it is torn, or missing where there should be one.
        """

    @abstractmethod
    def _read(self, reading: Pass, position: int) -> Block:
        """Read the record at a place.

        Raises:
            ValueError, KeyError, struct.error: no record can be read there, or where it ends.
        """


def _in_order(chunks: Iterable[tuple[int, Iterator[RawMessage]]]) -> Iterator[RawMessage]:
    """Merge the messages of chunks that come by when they begin.

    A message is handed on as soon as no later chunk says that it begins before; few wait.
    """
    waiting: list[tuple[int, int, RawMessage]] = []
    n_waiting, n_seen = 0, 0
    for start_ns, messages in chunks:
        while waiting and (waiting[0][0] <= start_ns or n_waiting > _MAX_WAITING_BYTES):
            *_, message = heappop(waiting)
            n_waiting -= len(message.data)
            yield message
            del message
        for message in messages:
            heappush(waiting, (message.log_ns, n_seen, message))
            n_waiting += len(message.data)
            n_seen += 1
    while waiting:
        yield heappop(waiting)[2]


def _said(error: Exception) -> str:
    if isinstance(error, KeyError):
        return f"a record lacks its field {error}"
    return "a record is torn" if isinstance(error, struct.error) else str(error)
