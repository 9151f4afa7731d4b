"""How much a file may ask for: one place for what a real sensor can reach.

Sizes that a file declares are checked against these limits before memory is taken, and decompression stops at
them. A reader reports a limit as it reports damage, by a ValueError with words that follow the file's name.
"""

import os
import stat
import zipfile
from pathlib import Path
from typing import IO, Any, BinaryIO, Protocol, cast

MAX_PIXELS = 1 << 26
"""Of one image: 67 megapixels."""
MAX_POINTS = 1 << 23
"""Of one scan: 30 times what 128 lasers at 2048 columns give."""
MAX_FIELDS = 256
"""Of one point, counts included: drivers write about ten."""
MAX_CHUNK_BYTES = 1 << 27
"""One unpacked chunk of a bag, packet of events or member of an archive; holds MAX_PIXELS in grey."""
MAX_FILE_BYTES = 1 << 28
"""A file that has to be in memory as a whole."""
MAX_DOCUMENT_BYTES = 1 << 24
"""JSON, YAML and other text that people or programs write as one document."""
MAX_LINE_BYTES = 1 << 12
"""One line of text with figures."""
MAX_EVENTS = 1 << 26
"""Of one file or stretch that has to be in memory as a whole: half a minute at two million a second."""
MAX_NETWORK_BYTES = 1 << 29
"""Voxels and states of one step of a network: E2VID's at 1280 x 720 take 220 MB."""
MAX_EVENT_PIXELS = 1 << 22
"""Of one event camera: four times the largest on sale."""
MAX_TIME_NS = 1 << 62
"""No timestamp is so far from zero: the year 2116 by clocks that count from 1970. Differences fit 64 bits."""
MAX_RATIO = 100
"""Of what is unpacked to what is stored. A hundredth of an event's usual 13 bytes is one bit, and its pixel
alone is more; sensors' recordings shrink to a third or a tenth."""

_PIECE_BYTES = 1 << 20
# What is unpacked in no time, whatever the ratio: short, black, or of one value all over.
_FREE_BYTES = 1 << 24


class _Decompressor(Protocol):
    """What bz2, lzma, zlib's like, zstd and lz4.frame have in common."""

    @property
    def eof(self) -> bool: ...

    @property
    def needs_input(self) -> bool: ...

    def decompress(self, data: bytes, max_length: int = -1) -> bytes: ...


def open_regular(path: Path) -> BinaryIO:
    """Open a file for reading; pipes and devices, which may never end, are refused.

    Raises:
        OSError: it is not there, or may not be read.
        ValueError: it is no regular file.
    """
    # Without O_NONBLOCK opening a pipe waits for whoever writes to it.
    descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)
    try:
        mode = os.fstat(descriptor).st_mode
        if stat.S_ISDIR(mode):
            raise IsADirectoryError(21, "it is a folder", str(path))
        if not stat.S_ISREG(mode):
            raise ValueError("it is a pipe or device, not a file")
        return os.fdopen(descriptor, "rb")
    except BaseException:
        os.close(descriptor)
        raise


def read_file(path: Path, max_bytes: int = MAX_FILE_BYTES) -> bytes:
    """Read a whole file of limited size.

    Raises:
        OSError: it is not there, or cannot be read.
        ValueError: it is no regular file, or larger.
    """
    with open_regular(path) as file:
        n_bytes = os.fstat(file.fileno()).st_size
        if n_bytes > max_bytes:
            raise ValueError(
                f"it is too large: {_megabytes(n_bytes)}, at most {_megabytes(max_bytes)} are read"
            )
        return file.read(max_bytes)


def check_size(n_bytes: int, what: str = "it", max_bytes: int = MAX_CHUNK_BYTES) -> int:
    """Pass a declared size through where a real sensor can reach it.

    Raises:
        ValueError: it is negative, or beyond the limit.
    """
    if not 0 <= n_bytes <= max_bytes:
        raise ValueError(f"{what} declares {_megabytes(n_bytes)}, at most {_megabytes(max_bytes)} are read")
    return n_bytes


def decompress(decompressor: _Decompressor, data: bytes, max_bytes: int = MAX_CHUNK_BYTES) -> bytes:
    """Unpack one stream, bit by bit, and stop where it grows beyond a limit.

    Args:
        decompressor: a new one of bz2, lzma, zstd or lz4.frame.
        data: the whole stream.
        max_bytes: of what it unpacks to.

    Raises:
        ValueError: it is larger, or ends before its end.
        Exception: it is damaged, as the library says.
    """
    parts: list[bytes] = []
    n_left, n_fed = max_bytes, 0
    while not decompressor.eof:
        # Some libraries copy what they have not come to at every call.
        fed = data[n_fed : n_fed + _PIECE_BYTES] if decompressor.needs_input else b""
        n_fed += len(fed)
        part = decompressor.decompress(fed, min(_PIECE_BYTES, n_left + 1))
        n_left -= len(part)
        parts.append(part)
        if n_left < 0:
            raise ValueError(f"it unpacks to more than {_megabytes(max_bytes)}")
        if not (part or fed) and decompressor.needs_input and not decompressor.eof:
            raise ValueError("it is truncated")
    return b"".join(parts)


def _megabytes(n_bytes: int) -> str:
    return f"{n_bytes / 1e6:.0f} MB" if abs(n_bytes) < 1e12 else f"{n_bytes / 1e12:.3g} TB"


def describe(value: Any) -> str:
    """Show a value of a file in a message, cut to a length that fits on a screen."""
    text = repr(value)
    return text if len(text) <= 60 else text[:57] + "..."


def unpacked_limit(n_stored: int) -> int:
    """Tell how many bytes of a recording so many stored ones may unpack to."""
    return MAX_RATIO * n_stored + _FREE_BYTES


def open_archive(file: BinaryIO) -> zipfile.ZipFile:
    """Open a zip whose list of members is of a sane size.

    Raises:
        ValueError: the list is too long.
        Exception: it is damaged, as zipfile says.
    """
    return zipfile.ZipFile(cast(BinaryIO, _InPieces(file)))


def open_member(archive: zipfile.ZipFile, member: zipfile.ZipInfo, max_bytes: int) -> IO[bytes]:
    """Open a member of `open_archive`, to be read in pieces of at most a megabyte; it ends where it declares.

    Raises:
        ValueError: it declares more than the limit, or is packed in an unusual way.
        Exception: it is damaged, as zipfile says.
    """
    # Python unpacks the other methods without a limit.
    if member.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
        raise ValueError(f"{member.filename} is compressed by method {member.compress_type}, not by deflate")
    check_size(member.file_size, describe(member.filename), max_bytes)
    return archive.open(member)


def read_member(archive: zipfile.ZipFile, member: zipfile.ZipInfo, max_bytes: int = MAX_CHUNK_BYTES) -> bytes:
    """Read a member of `open_archive` whole.

    Raises:
        ValueError, Exception: as `open_member` does.
    """
    with open_member(archive, member, max_bytes) as file:
        return b"".join(iter(lambda: file.read(_PIECE_BYTES), b""))


class _InPieces:
    """A file that is read in pieces only: zipfile reads a list of members, however long, at once."""

    def __init__(self, file: BinaryIO) -> None:
        self._file = file

    def read(self, n_bytes: int = -1) -> bytes:
        data = self._file.read(min(n_bytes, _PIECE_BYTES + 1) if n_bytes >= 0 else _PIECE_BYTES + 1)
        if len(data) > _PIECE_BYTES:
            raise ValueError(f"its list of members is longer than {_megabytes(_PIECE_BYTES)}")
        return data

    def __getattr__(self, name: str) -> Any:
        return getattr(self._file, name)
