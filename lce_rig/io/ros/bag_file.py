"""Bags of ROS 1 and ROS 2 as raw messages, read by rosbags.

rosbags' readers of single files are used, not its AnyReader: that one parses every message definition of a
bag, and refuses the whole bag for one that it cannot parse or for older bags without any.
"""

import os
import shutil
import sys
from bz2 import BZ2Decompressor
from collections.abc import Collection, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from functools import cache, partial
from heapq import merge
from importlib import import_module
from pathlib import Path
from tempfile import TemporaryDirectory
from types import SimpleNamespace
from typing import Any, NamedTuple

from lce_rig.core.bounds import MAX_CHUNK_BYTES, BoundedPath, Unpacking, unpack
from lce_rig.core.errors import SourceError, reading, reason_of

SUFFIXES = (".bag", ".db3", ".mcap")
_MAX_LISTED = 40
# Suffixes added by recorders: of compressed files, and of unclosed ROS 1 files.
_COMPRESSED = (".zstd", ".zst")
_ADDED = (*_COMPRESSED, ".active")
_MAGIC = {".bag": b"#ROSBAG V", ".db3": b"SQLite format 3\0", ".mcap": b"\x89MCAP0\r\n"}
_ZSTD_MAGIC = b"\x28\xb5\x2f\xfd"


class RawMessage(NamedTuple):
    """An undecoded message from a bag or a live topic.

    Attributes:
        msgtype: "sensor_msgs/PointCloud2", without ROS 2's "/msg".
        encoding: "ros1" or "cdr".
        log_ns: time of receipt by the recorder.
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
        files: files of the bag that hold messages.
        topics: (message type, number of messages) by topic.
        damages: errors of files that cannot be opened, beside others that can.
        end_ns: time of receipt of the last message.
    """

    def __init__(self, path: Path) -> None:
        """Read the list of topics.

        Raises:
            SourceError: the bag cannot be read.
        """
        self.path = path
        self.topics: dict[str, tuple[str, int]] = {}
        self.damages: list[SourceError] = []
        self.files = _bag_files(path) if path.is_dir() else [path]
        self.end_ns = 0
        with self._readers() as readers:
            for reader in readers:
                self.end_ns = max(self.end_ns, reader.end_time)
                for connection in reader.connections:
                    n_before = self.topics.get(connection.topic, ("", 0))[1]
                    self.topics[connection.topic] = _type_of(connection), n_before + connection.msgcount
            if not readers:
                raise self.damages[0]

    def messages(self, topics: Collection[str]) -> Iterator[RawMessage]:
        """Yield the messages of some topics in the order the recorder received them.

        Raises:
            SourceError: the bag is damaged; raised after all messages before the damage.
        """
        n_read = 0
        with self._readers() as readers:
            try:
                passes = []
                for reader in readers:
                    wanted = [c for c in reader.connections if c.topic in topics]
                    passes += [reader.messages(wanted)] if wanted else []
                for connection, log_ns, data in merge(*passes, key=lambda entry: int(entry[1])):
                    encoding = getattr(connection.ext, "serialization_format", "ros1")
                    data = bytes(data)
                    # A bag without metadata.yaml does not state that each message is compressed; CDR begins
                    # with a zero.
                    if encoding != "ros1" and data.startswith(_ZSTD_MAGIC):
                        data = unpack(_zstd().ZstdDecompressor, data)
                    yield RawMessage(connection.topic, _type_of(connection), encoding, int(log_ns), data)
                    n_read += 1
            except Exception as error:
                raise SourceError(
                    f"{self.path} is damaged: {reason_of(error)}; {n_read} messages were read before",
                    f"What was captured from them is kept. {_repair(self.path)}",
                ) from error
        if self.damages:
            raise self.damages[0]

    @contextmanager
    def _readers(self) -> Iterator[list[Any]]:
        """Open the bag's files; note those that cannot be opened in `damages`."""
        from rosbags.rosbag1 import Reader as Ros1Reader
        from rosbags.rosbag2 import Reader as Ros2Reader

        _bound_rosbags()
        # A folder's metadata.yaml lists its files; without it each file is opened separately.
        is_described = self.path.is_dir() and (self.path / "metadata.yaml").is_file()
        self.damages.clear()
        with ExitStack() as stack:
            readers: list[Any] = []
            for file in [self.path] if is_described else self.files:
                try:
                    with reading(file, hint=_repair(file)):
                        plain = BoundedPath(file) if is_described else stack.enter_context(_plain(file))
                        is_ros1 = not is_described and kind_of(file) == ".bag"
                        reader = Ros1Reader(plain) if is_ros1 else Ros2Reader(plain)
                        readers.append(stack.enter_context(reader))
                except SourceError as error:
                    self.damages.append(error)
            yield readers


def kind_of(path: Path) -> str:
    """Return the kind of a recording: its suffix, ".bag" for a folder with bag files, else "folder".

    The suffix is in lower case; for compressed or unclosed bags, it is that of the bag itself.
    """
    if not path.is_dir():
        name = path.name.lower()
        for added in _ADDED:
            if Path(name.removesuffix(added)).suffix in SUFFIXES:
                name = name.removesuffix(added)
        return Path(name).suffix
    return ".bag" if (path / "metadata.yaml").is_file() or _bag_files(path) else "folder"


def _bag_files(folder: Path) -> list[Path]:
    """List the files of a bag in a folder, without compressed duplicates."""
    files = sorted(file for file in folder.iterdir() if not file.is_dir() and kind_of(file) in SUFFIXES)
    return [file for file in files if file.with_suffix("") not in files]


@contextmanager
def _plain(file: Path) -> Iterator[Path]:
    """Yield a path of a file that rosbags can open: decompressed, with its suffix in lower case.

    Raises:
        ValueError: not a bag, or damaged.
    """
    kind = kind_of(file)
    with TemporaryDirectory() as folder:
        plain = BoundedPath(folder) / f"bag{kind}"
        if file.suffix.lower() in _COMPRESSED:
            try:
                with (
                    file.open("rb") as packed,
                    _open_unpacked(packed, "rb") as unpacked,
                    plain.open("wb") as target,
                ):
                    shutil.copyfileobj(unpacked, target)
            except (_zstd().ZstdError, EOFError):
                raise ValueError("it is truncated, or not compressed by zstd") from None
        else:
            plain.symlink_to(file.resolve())
        with plain.open("rb") as opened:
            if not opened.read(16).startswith(_MAGIC[kind]):
                raise ValueError(f"its content is not that of a {kind} file")
        yield plain


@cache
def _bound_rosbags() -> None:
    """Make rosbags unpack chunks, messages and files within the limits of `core.bounds`.

    The tables of decompressors are replaced, as the original ones unpack a chunk without a size limit.
    """
    lz4 = import_module("lz4.frame")
    from rosbags.rosbag1 import reader as ros1
    from rosbags.rosbag2 import reader as ros2
    from rosbags.rosbag2 import storage_mcap

    makers = {
        "bz2": BZ2Decompressor,
        "lz4": lz4.LZ4FrameDecompressor,
        "zstd": _zstd().ZstdDecompressor,
    }
    ros1.decompressors |= {name: partial(unpack, makers[name]) for name in ("bz2", "lz4")}

    def unpack_chunk(name: str, packed: bytes, size: int) -> bytes:
        if size > MAX_CHUNK_BYTES:
            raise ValueError(f"a chunk claims {size / 1e6:.0f} MB (limit {MAX_CHUNK_BYTES / 1e6:.0f} MB)")
        return unpack(makers[name], packed, size)

    storage_mcap.DECOMPRESSORS |= {name: partial(unpack_chunk, name) for name in ("lz4", "zstd")}
    bounded = SimpleNamespace(decompress=partial(unpack, makers["zstd"]), open=_open_unpacked)
    vars(ros2)["zstd"] = bounded


def _open_unpacked(packed: Any, _mode: str) -> Unpacking:
    return Unpacking(_zstd().open(packed, "rb"), os.fstat(packed.fileno()).st_size)


def _zstd() -> Any:
    """Import a module of which rosbags requires the same version."""
    return import_module("compression.zstd" if sys.version_info >= (3, 14) else "backports.zstd")


def list_topics(topics: Mapping[str, tuple[str, int]]) -> str:
    """List the topics of a bag, for messages.

    Args:
        topics: (message type, number of messages) by topic.
    """
    listed = [f"{name} ({kind}, {n})" for name, (kind, n) in sorted(topics.items())[:_MAX_LISTED]]
    listed += [f"and {len(topics) - _MAX_LISTED} more"] if len(topics) > _MAX_LISTED else []
    return f"topics: {', '.join(listed) or 'none'}"


def _type_of(connection: Any) -> str:
    return str(connection.msgtype).replace("/msg/", "/")


def _repair(path: Path) -> str:
    """Return the name of the tool that restores the index of a bag with a killed recorder."""
    commands = {".bag": f"rosbag reindex {path.name}", ".mcap": f"mcap recover {path.name}"}
    folder = (path if path.is_dir() else path.parent).resolve()
    command = commands.get(kind_of(path), f"ros2 bag reindex {folder.name}")
    return f"If its recorder was killed, repair it: {command}"
