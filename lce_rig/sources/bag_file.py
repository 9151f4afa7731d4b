"""Bags as streams of raw messages: ROS 1, ROS 2 sqlite3 and mcap, whole or torn."""

from collections.abc import Collection, Iterator
from contextlib import AbstractContextManager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from lce_rig.core.errors import SourceError
from lce_rig.sources.bag_salvage import salvage
from lce_rig.sources.fingerprint import fingerprint

SUFFIXES = (".bag", ".db3", ".mcap")
_FIRST_LOOK_NS = 1_000_000_000


@dataclass(frozen=True, eq=False)
class RawMessage:
    """A message as it lies in the bag.

    Attributes:
        msgtype: "sensor_msgs/PointCloud2", without ROS 2's "/msg".
        encoding: "ros1" or "cdr".
        log_ns: when the recorder received it.
    """

    topic: str
    msgtype: str
    encoding: str
    log_ns: int
    data: bytes


class BagFile:
    """One bag: a .bag, .db3 or .mcap file, or a ROS 2 folder.

    Attributes:
        path: the file or folder.
        topics: (message type, number of messages) by topic.
        damage: what is wrong with the bag, "" where nothing is; what can be read is read all the same.
    """

    def __init__(self, path: Path) -> None:
        """Read the list of topics.

        Raises:
            SourceError: nothing can be read.
        """
        self.path = path
        self.damage = ""
        self.topics: dict[str, tuple[str, int]] = {}
        self._ends_ns: dict[str, int] = {}
        self._parts = self._find_parts()
        try:
            for part in self._parts:
                with _reader(part) as reader:
                    for connection in reader.connections:
                        self._count(connection.topic, connection.msgtype, connection.msgcount)
        except Exception as error:  # A torn file makes the reader fail in any way: struct, assert, zlib, ...
            self._survey_damaged(error)

    @property
    def n_messages(self) -> int:
        """Number of messages of all topics."""
        return sum(count for _, count in self.topics.values())

    def fingerprint(self) -> str:
        """Hash names, sizes and both ends of the files: enough to know a recording again."""
        return fingerprint(self._files())

    def unmerged_journals(self) -> list[Path]:
        """List write-ahead journals of sqlite that a recorder left behind when it was killed."""
        journals = (file.with_name(file.name + "-wal") for file in self._files())
        return [journal for journal in journals if journal.exists() and journal.stat().st_size > 0]

    def end_ns(self, topic: str) -> int | None:
        """Find when the recorder received a topic's last message, from the back; None where it has none."""
        for part in reversed(self._parts):
            if topic not in self._ends_ns and not self.damage:
                with suppress(Exception), _reader(part) as reader:  # Damage is said when the bag is read.
                    self._ends_ns |= _find_end(reader, topic)
        return self._ends_ns.get(topic)

    def messages(self, topics: Collection[str]) -> Iterator[RawMessage]:
        """Yield the messages of some topics in the order the recorder received them.

        Raises:
            SourceError: at the place where the bag is damaged, after everything before it.
        """
        n_read, last_ns = 0, None
        first_ns: int | None = None
        try:
            for part in self._parts:
                for message in self._part_messages(part, topics):
                    n_read, last_ns = n_read + 1, message.log_ns
                    first_ns = message.log_ns if first_ns is None else first_ns
                    yield message
        except SourceError:
            raise
        except Exception as error:  # As above: damage shows in any way.
            self.damage = _describe(error)
        if self.damage:
            length_s = 0.0 if first_ns is None or last_ns is None else (last_ns - first_ns) * 1e-9
            raise SourceError(
                f"{self.path} is damaged ({self.damage}): {n_read} messages over {length_s:.1f} s were read",
                "What was captured from them is kept. Reindexing with ROS's own tools may bring back more.",
            )

    def _part_messages(self, part: Path, topics: Collection[str]) -> Iterator[RawMessage]:
        if self.damage:
            for topic, msgtype, encoding, log_ns, data in salvage(part):
                if topic in topics:
                    yield RawMessage(topic, _short_type(msgtype), encoding, log_ns, data)
            return
        with _reader(part) as reader:
            wanted = [c for c in reader.connections if c.topic in topics]
            if not wanted:
                return
            for connection, log_ns, data in reader.messages(connections=wanted):
                encoding = getattr(connection.ext, "serialization_format", "ros1")
                msgtype = _short_type(connection.msgtype)
                yield RawMessage(connection.topic, msgtype, encoding, log_ns, bytes(data))

    def _survey_damaged(self, error: Exception) -> None:
        self.damage = _describe(error)
        self.topics.clear()
        for part in self._parts:
            if not part.is_dir():
                for topic, msgtype, _, log_ns, _ in salvage(part):
                    self._count(topic, msgtype, 1)
                    self._ends_ns[topic] = log_ns
        if not self.topics:
            raise SourceError(
                f"{self.path} cannot be read: {self.damage}", "Record again, or try to reindex it."
            )

    def _count(self, topic: str, msgtype: str, n: int) -> None:
        self.topics[topic] = (_short_type(msgtype), self.topics.get(topic, ("", 0))[1] + n)

    def _find_parts(self) -> list[Path]:
        """List what readers open: the path itself, or the files in a folder whose index was never written."""
        if not self.path.is_dir() or (self.path / "metadata.yaml").is_file():
            return [self.path]
        return self._files()

    def _files(self) -> list[Path]:
        if not self.path.is_dir():
            return [self.path]
        return sorted(p for p in self.path.iterdir() if p.suffix.lower() in SUFFIXES)


def _reader(part: Path) -> AbstractContextManager[Any]:
    if part.suffix.lower() == ".bag":
        from rosbags.rosbag1 import Reader as Ros1Reader

        return Ros1Reader(part)
    from rosbags.rosbag2 import Reader as Ros2Reader

    return Ros2Reader(part)


def _find_end(reader: Any, topic: str) -> dict[str, int]:
    """Look for a topic's last message in ever longer stretches of the bag's end."""
    wanted = [connection for connection in reader.connections if connection.topic == topic]
    length_ns, begin_ns = _FIRST_LOOK_NS, reader.end_time
    while wanted and begin_ns > reader.start_time:
        begin_ns = reader.end_time - length_ns
        found = [log_ns for _, log_ns, _ in reader.messages(connections=wanted, start=begin_ns)]
        if found:
            return {topic: max(found)}
        length_ns *= 4
    return {}


def _short_type(msgtype: str) -> str:
    return msgtype.replace("/msg/", "/")


def _describe(error: Exception) -> str:
    text = " ".join(str(error).split()).rstrip(".")
    return text[:200] if text else type(error).__name__
