"""Bags as streams of raw messages: ROS 1, ROS 2 sqlite3 and mcap, whole or torn."""

import re
from collections.abc import Collection, Iterator, Mapping
from pathlib import Path
from shutil import rmtree
from tempfile import mkdtemp
from weakref import finalize

from lce_rig.core import limits, unpacking
from lce_rig.core.errors import SourceError
from lce_rig.io.fingerprint import fingerprint
from lce_rig.io.ros.mcap import McapBag
from lce_rig.io.ros.ros1 import Ros1Bag
from lce_rig.io.ros.sqlite import SqliteBag
from lce_rig.io.ros.storage import BagStorage, Damages, RawMessage

SUFFIXES = (".bag", ".db3", ".mcap")
_PACKED = ".zstd"
_MAX_LISTED = 40
_LISTED_FILE = re.compile(r"^\s*-\s*[\"']?([^\"'\n]+\.(?:db3|mcap)(?:\.zstd)?)[\"']?\s*$", re.MULTILINE)


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
        self.topics: dict[str, tuple[str, int]] = {}
        self._ends_ns: dict[str, int | None] = {}
        self._damages = Damages()
        self._readable: list[Path] = []
        self._parts = self._open_parts()
        for part in self._parts:
            for number, (topic, msgtype, _) in part.contents.connections.items():
                n_before = self.topics.get(topic, ("", 0))[1]
                self.topics[topic] = msgtype, n_before + part.contents.counts[number]
        if not self.topics and self._damages.n_places:
            raise SourceError(
                f"{self.path} cannot be read: {self.damage}",
                "Record again, or try to reindex it.",
            )

    @property
    def damage(self) -> str:
        """What is wrong with the bag, as far as it was read; "" where nothing is."""
        return str(self._damages)

    def fingerprint(self) -> str:
        """Hash names, sizes and both ends of the files: enough to know a recording again."""
        return fingerprint(self._readable)

    def unmerged_journals(self) -> list[Path]:
        """List write-ahead journals of sqlite that a recorder left behind when it was killed."""
        journals = (file.with_name(file.name + "-wal") for file in self._files())
        return [journal for journal in journals if journal.exists() and journal.stat().st_size > 0]

    def end_ns(self, topic: str) -> int | None:
        """Find when the recorder received a topic's last message, from the back; None where it has none."""
        if topic not in self._ends_ns:
            ends_ns = (_end_ns(part, topic) for part in reversed(self._parts))
            self._ends_ns[topic] = next((end_ns for end_ns in ends_ns if end_ns is not None), None)
        return self._ends_ns[topic]

    def messages(self, topics: Collection[str]) -> Iterator[RawMessage]:
        """Yield the messages of some topics in the order the recorder received them.

        Raises:
            SourceError: the bag is damaged; after everything that can be read.
        """
        n_read, first_ns, last_ns = 0, 0, 0
        damages = Damages(self._damages.n_places, self._damages.first)
        for part in self._parts:
            try:
                for message in part.messages(topics, damages):
                    n_read, last_ns = n_read + 1, message.log_ns
                    first_ns = message.log_ns if n_read == 1 else first_ns
                    yield message
            except (OSError, ValueError) as error:  # The file was there when the bag was opened.
                damages.add(_describe(part.path, error))
        if damages.n_places:
            length_s = (last_ns - first_ns) * 1e-9
            raise SourceError(
                f"{self.path} is damaged ({damages}): {n_read} messages over {length_s:.1f} s were read",
                "What was captured from them is kept. Reindexing with ROS's own tools may bring back more.",
            )

    def _open_parts(self) -> list[BagStorage]:
        """Open the files, in the order of time; one that cannot be read is damage."""
        parts: list[BagStorage] = []
        for file in self._files():
            try:
                part = self._open(file)
            except (OSError, ValueError) as error:
                self._damages.add(_describe(file, error))
                continue
            if part.contents.damages.n_places:
                where = f"{file.name}: " if file != self.path else ""
                self._damages.add(f"{where}{part.contents.damages}")
            parts.append(part)
            self._readable.append(file)
        for name in self._missing():
            self._damages.add(f"metadata.yaml lists {limits.describe(name)}, which is missing")
        return sorted(parts, key=lambda part: part.contents.start_ns or 0)

    def _open(self, file: Path) -> BagStorage:
        if file.suffix.lower() == _PACKED:
            file = self._unpack(file)
        if file.suffix.lower() == ".bag":
            return Ros1Bag(file)
        return McapBag(file) if file.suffix.lower() == ".mcap" else SqliteBag(file)

    def _unpack(self, file: Path) -> Path:
        """Unpack a file that was compressed as a whole, for as long as the bag is open."""
        folder = mkdtemp(prefix="lce-rig-")
        finalize(self, rmtree, folder, ignore_errors=True)
        unpacked = Path(folder) / file.stem
        with limits.open_regular(file) as packed, unpacked.open("wb") as into:
            unpacking.unpack_file("zstd", packed, into)
        return unpacked

    def _files(self) -> list[Path]:
        if not self.path.is_dir():
            return [self.path]
        return sorted(file for file in self.path.iterdir() if is_bag_file(file))

    def _missing(self) -> list[str]:
        """List the files that a folder's metadata.yaml names and that are not there."""
        metadata = self.path / "metadata.yaml"
        if not self.path.is_dir() or not metadata.exists():
            return []
        try:
            text = limits.read_file(metadata, limits.MAX_DOCUMENT_BYTES).decode(errors="replace")
        except (OSError, ValueError) as error:
            self._damages.add(_describe(metadata, error))
            return []
        there = {file.name for file in self._files()}
        return sorted({Path(name).name for name in _LISTED_FILE.findall(text)} - there)


def is_bag_file(path: Path) -> bool:
    """Return whether a file's name is that of a bag, or of one that was compressed as a whole."""
    suffixes = [suffix.lower() for suffix in path.suffixes[-2:]]
    return suffixes[-1:] != [] and (suffixes[-1] in SUFFIXES or _is_packed(suffixes))


def kind_of(path: Path) -> str:
    """Name the kind of a recording: its suffix, ".bag" for a folder with bag files, else "folder"."""
    if not path.is_dir():
        return path.suffix.lower()
    return ".bag" if any(is_bag_file(file) for file in path.iterdir()) else "folder"


def list_topics(topics: Mapping[str, tuple[str, int]]) -> str:
    """List the topics of a bag, for messages.

    Args:
        topics: (message type, number of messages) by topic.
    """
    shown = sorted(topics.items())[:_MAX_LISTED]
    listed = [f"{limits.shorten(name)} ({limits.shorten(kind)}, {n})" for name, (kind, n) in shown]
    listed += [f"and {len(topics) - len(shown)} more"] if len(topics) > len(shown) else []
    return f"topics: {', '.join(listed) or 'none'}"


def _is_packed(suffixes: list[str]) -> bool:
    return len(suffixes) == 2 and suffixes[0] in SUFFIXES and suffixes[1] == _PACKED


def _end_ns(part: BagStorage, topic: str) -> int | None:
    try:
        return part.end_ns(topic)
    except (OSError, ValueError):
        return None  # Reported when the bag is read.


def _describe(path: Path, error: Exception) -> str:
    text = (error.strerror if isinstance(error, OSError) else str(error)) or type(error).__name__
    return f"{path.name}: {text}"
