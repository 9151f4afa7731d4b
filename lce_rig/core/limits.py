"""How much a file may ask for: one place for what a real sensor can reach.

Sizes that a file declares are checked against these limits before memory is taken, and decompression stops at
them. A reader reports a limit as it reports damage, by a ValueError with words that follow the file's name.
"""

import os
import stat
from contextlib import suppress
from importlib import import_module
from pathlib import Path
from typing import Any, BinaryIO, Protocol, cast

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
MAX_TOPICS = 1 << 14
"""Of one bag, with every publisher of each counted."""
MAX_RATIO = 256
"""Of what a whole recording unpacks to and its size: pictures of a dark room shrink to a hundredth."""

_PIECE_BYTES = 1 << 20


class _Decompressor(Protocol):
    """What bz2, lzma, zlib's like, zstd and lz4.frame have in common."""

    @property
    def eof(self) -> bool: ...

    @property
    def needs_input(self) -> bool: ...

    @property
    def unused_data(self) -> bytes: ...

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
    n_left, rest = max_bytes, data
    while not decompressor.eof:
        part = decompressor.decompress(rest, min(_PIECE_BYTES, n_left + 1))
        rest = b""
        n_left -= len(part)
        parts.append(part)
        if n_left < 0:
            raise ValueError(f"it unpacks to more than {_megabytes(max_bytes)}")
        if not part and decompressor.needs_input and not decompressor.eof:
            raise ValueError("it is truncated")
    return b"".join(parts)


def _megabytes(n_bytes: int) -> str:
    return f"{n_bytes / 1e6:.0f} MB" if abs(n_bytes) < 1e12 else f"{n_bytes / 1e12:.3g} TB"


def describe(value: Any) -> str:
    """Show a value of a file in a message, cut to a length that fits on a screen."""
    text = repr(value)
    return text if len(text) <= 60 else text[:57] + "..."


def check_points(n_points: int) -> int:
    """Pass a declared number of points through where a scan can have as many.

    Raises:
        ValueError: it is negative, or beyond the limit.
    """
    if not 0 <= n_points <= MAX_POINTS:
        raise ValueError(f"it declares {n_points} points, at most {MAX_POINTS} are read")
    return n_points


def shorten(text: str) -> str:
    """Cut a name that a file gives to a length that fits on a screen."""
    return text if len(text) <= 120 else text[:117] + "..."


def new_decompressor(kind: str) -> _Decompressor:
    """Begin to unpack a stream of bz2, lz4 (frames) or zstd.

    Raises:
        ValueError: another kind.
        ImportError: this Python has no Zstandard, and nothing brought one.
    """
    if kind not in _DECOMPRESSORS:
        raise ValueError(f"compression {describe(kind)} is not known; known are {', '.join(_DECOMPRESSORS)}")
    names, attribute = _DECOMPRESSORS[kind]
    for name in names[:-1]:
        with suppress(ImportError):
            return cast(_Decompressor, getattr(import_module(name), attribute)())
    return cast(_Decompressor, getattr(import_module(names[-1]), attribute)())


def unpack_file(kind: str, packed: BinaryIO, into: BinaryIO) -> None:
    """Unpack a file into another, as far as a recording of its size can grow.

    Raises:
        ValueError: it is damaged, or unpacks to more.
        OSError: a file cannot be read or written.
    """
    n_left = MAX_RATIO * os.fstat(packed.fileno()).st_size + MAX_CHUNK_BYTES
    decompressor, rest = new_decompressor(kind), packed.read(_PIECE_BYTES)
    while rest or not decompressor.needs_input:
        try:
            part = decompressor.decompress(rest, min(_PIECE_BYTES, n_left + 1))
        except (OSError, MemoryError):
            raise
        except Exception as error:  # Each library has its own.
            raise ValueError(f"its {kind} data are damaged ({error})") from None
        n_left -= len(part)
        if n_left < 0:
            raise ValueError("it unpacks to more than a recording of its size can hold")
        into.write(part)
        if decompressor.eof:
            # Some compressors write frame after frame.
            rest = decompressor.unused_data or packed.read(_PIECE_BYTES)
            decompressor = new_decompressor(kind)
        else:
            rest = packed.read(_PIECE_BYTES) if decompressor.needs_input else b""


_DECOMPRESSORS = {
    "bz2": (("bz2",), "BZ2Decompressor"),
    "lz4": (("lz4.frame",), "LZ4FrameDecompressor"),
    "zstd": (("compression.zstd", "backports.zstd"), "ZstdDecompressor"),
}
