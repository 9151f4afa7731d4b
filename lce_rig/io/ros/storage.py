"""The common interface of ROS 1, mcap and sqlite3 bag files: topics and raw messages."""

from collections import Counter
from collections.abc import Collection, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple, Protocol

from lce_rig.core import limits, unpacking


class RawMessage(NamedTuple):
    """A raw message of the bag.

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


class Connection(NamedTuple):
    """What a bag says of the messages with one number."""

    topic: str
    msgtype: str
    encoding: str


@dataclass
class Damages:
    """The unreadable parts of a bag: their number, and the fault of the first."""

    n_places: int = 0
    first: str = ""

    def add(self, what: str) -> None:
        """Count one more place."""
        self.n_places += 1
        self.first = self.first or what

    def __str__(self) -> str:
        return self.first if self.n_places < 2 else f"{self.n_places} places, the first: {self.first}"


@dataclass
class Contents:
    """The contents found on opening a bag.

    Attributes:
        connections: by number.
        counts: messages by number of connection, as declared or counted.
        start_ns: receipt of the first message; None where there is none.
        damages: what cannot be read.
    """

    connections: dict[int, Connection] = field(default_factory=dict)
    counts: Counter[int] = field(default_factory=Counter)
    start_ns: int | None = None
    damages: Damages = field(default_factory=Damages)

    def add(self, number: int, topic: str, msgtype: str, encoding: str) -> None:
        """Take a connection; the first of a number stays.

        Raises:
            ValueError: there are more than any recorder makes.
        """
        if number not in self.connections:
            if len(self.connections) >= limits.MAX_TOPICS:
                raise ValueError(f"it declares more than {limits.MAX_TOPICS} topics")
            self.connections[number] = Connection(topic, msgtype.replace("/msg/", "/"), encoding)

    def numbers(self, topics: Collection[str]) -> frozenset[int]:
        """Find the connections of some topics."""
        return frozenset(number for number, found in self.connections.items() if found.topic in topics)


class BagStorage(Protocol):
    """One file of a bag.

    Attributes:
        path: the file.
        contents: what was found on opening it.
    """

    path: Path
    contents: Contents

    def messages(self, topics: Collection[str], damages: Damages) -> Iterator[RawMessage]:
        """Yield the messages of some topics in the order of receipt; what cannot be read is counted."""
        ...

    def end_ns(self, topic: str) -> int | None:
        """Find when a topic's last message was received; None where it has none."""
        ...


def unpack(compression: str, data: bytes, max_bytes: int) -> bytes:
    """Unpack what lies compressed in a bag.

    Raises:
        ValueError: it is damaged, or larger.
    """
    decompressor = unpacking.new_decompressor(compression)
    try:
        return unpacking.decompress(decompressor, data, max_bytes)
    except ValueError:
        raise
    except Exception as error:  # Each library has its own: OSError, RuntimeError, ZstdError.
        raise ValueError(f"{compression} data are damaged ({error})") from None
