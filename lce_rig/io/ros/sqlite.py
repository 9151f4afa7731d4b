"""Bags of ROS 2 in sqlite3 files.

A database may hold more than figures: views that never end, columns that are computed. Queries are cut off
where they take longer than a table of the file's size can, and values where they are larger than a message.

References:
    https://github.com/ros2/rosbag2 (rosbag2_storage_sqlite3)
"""

import os
import sqlite3
import sys
from collections.abc import Collection, Iterator
from contextlib import closing
from pathlib import Path

from lce_rig.core import limits, unpacking
from lce_rig.io.ros.storage import Contents, Damages, RawMessage, unpack

_ZSTD_MAGIC = b"\x28\xb5\x2f\xfd"
_PAUSE_STEPS = 100_000
# Ten thousand rows take a hundred thousand steps to sort, and more than 100 kB.
_STEPS_PER_BYTE = 16
_MIN_STEPS = 10_000_000


class SqliteBag:
    """A .db3 file; see `BagStorage`."""

    def __init__(self, path: Path) -> None:
        """Read the list of topics.

        Raises:
            OSError: the file cannot be read.
            ValueError: it is not a file, or no bag.
        """
        self.path = path
        self.contents = Contents()
        with limits.open_regular(path) as file:
            self._n_bytes = os.fstat(file.fileno()).st_size
        try:
            with closing(self._open()) as database:
                for number, topic, msgtype, encoding in database.execute(
                    "SELECT id, name, type, serialization_format FROM topics ORDER BY id"
                ):
                    self.contents.add(int(number), str(topic), str(msgtype), str(encoding))
                self.contents.start_ns = self._count(database)
        except (sqlite3.Error, TypeError, OverflowError) as error:
            raise ValueError(str(error)) from None

    def messages(self, topics: Collection[str], damages: Damages) -> Iterator[RawMessage]:
        """Yield the messages of some topics in the order of receipt; what cannot be read is counted."""
        numbers = sorted(self.contents.numbers(topics))
        n_left = unpacking.MAX_RATIO * self._n_bytes + 2 * limits.MAX_CHUNK_BYTES
        try:
            with closing(self._open()) as database:
                query = (
                    "SELECT topic_id, timestamp, data FROM messages "
                    f"WHERE topic_id IN ({','.join('?' * len(numbers))}) ORDER BY timestamp"
                )
                for number, log_ns, data in database.execute(query, numbers):
                    if not isinstance(data, bytes) or not isinstance(log_ns, int):
                        damages.add("a message holds no bytes, or no time")
                        continue
                    try:
                        content = _unpacked(data, n_left)
                    except ValueError as error:
                        damages.add(f"a message: {error}")
                        continue
                    n_left -= len(content)
                    yield RawMessage(*self.contents.connections[number], log_ns, content)
        except (sqlite3.Error, OverflowError) as error:
            damages.add(str(error))

    def end_ns(self, topic: str) -> int | None:
        """Find when a topic's last message was received; None where it has none."""
        last_ns: int | None = None
        try:
            with closing(self._open()) as database:
                for number in self.contents.numbers({topic}):
                    query = "SELECT max(timestamp) FROM messages WHERE topic_id = ?"
                    (found,) = database.execute(query, [number]).fetchone()
                    if isinstance(found, int):
                        last_ns = found if last_ns is None else max(found, last_ns)
        except (sqlite3.Error, OverflowError):
            return None
        return last_ns

    def _count(self, database: sqlite3.Connection) -> int | None:
        start_ns: int | None = None
        for number, n, first_ns in database.execute(
            "SELECT topic_id, count(*), min(timestamp) FROM messages GROUP BY topic_id"
        ):
            if number in self.contents.connections and isinstance(first_ns, int):
                self.contents.counts[number] += n
                start_ns = first_ns if start_ns is None else min(first_ns, start_ns)
        return start_ns

    def _open(self) -> sqlite3.Connection:
        # Nothing is written beside the bag, even if a journal lies there.
        database = sqlite3.connect(f"{self.path.resolve().as_uri()}?mode=ro&immutable=1", uri=True)
        if sys.version_info >= (3, 11):
            database.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, limits.MAX_CHUNK_BYTES)
        n_steps = 0

        def is_too_long() -> bool:
            nonlocal n_steps
            n_steps += _PAUSE_STEPS
            return n_steps > _MIN_STEPS + _STEPS_PER_BYTE * self._n_bytes

        database.set_progress_handler(is_too_long, _PAUSE_STEPS)
        database.execute("PRAGMA trusted_schema = OFF")
        database.execute("PRAGMA cell_size_check = ON")
        return database


def _unpacked(data: bytes, n_left: int) -> bytes:
    """Unpack a message that was compressed separately: no other begins like that."""
    if not data.startswith(_ZSTD_MAGIC):
        return data
    return unpack("zstd", data, max(0, min(n_left, limits.MAX_CHUNK_BYTES)))
