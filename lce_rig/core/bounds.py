"""Limits on untrusted files: file types, and bytes to read, unpack and decode.

A header may state any size. The data read or unpacked at once are limited to the size of one image, point
cloud or chunk of messages; readers have no limits of their own.
"""

import io
import os
import resource
import stat
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

#: Largest file that is read at once, bytes: image, point cloud, result. Scans as text take 30 MB.
MAX_BYTES = 1 << 28
#: Largest record or unpacked chunk of a recording, bytes. Images take at most 60 MB, typical chunks 4 MB.
MAX_CHUNK_BYTES = 1 << 27
#: Largest file of settings, bytes: YAML of this size is parsed in 2 s.
MAX_TEXT_BYTES = 1 << 18
# Memory for decoding one file, bytes: a whole file, and its pixels or points beside it.
_DECODING_BYTES = 3 * (1 << 27)
# Step of unpacking, bytes: Ctrl-C is handled between two steps.
_STEP_BYTES = 1 << 24
# Largest compression ratio of a recording: images and point clouds shrink to a third.
_MOST_SHRINKAGE = 30

_decoding = threading.Lock()


def require_file(path: Path, most_bytes: int | None = None) -> None:
    """Refuse devices, pipes and sockets, which have no end, and files that are too large.

    Args:
        path: path of a file or folder; missing ones pass, as their reader reports them.
        most_bytes: largest size; None for files that are read piece by piece.

    Raises:
        ValueError: not a plain file or folder, or too large.
    """
    try:
        status = path.stat()
    except OSError:
        return
    if not (stat.S_ISREG(status.st_mode) or stat.S_ISDIR(status.st_mode)):
        raise ValueError("it is a device or a pipe, not a file")
    if most_bytes is not None and stat.S_ISREG(status.st_mode) and status.st_size > most_bytes:
        raise ValueError(f"it has {status.st_size / 1e6:.1f} MB (limit {most_bytes / 1e6:.1f} MB)")


class BoundedFile(io.BufferedReader):
    """A file that bounds reads whose lengths come from its own records."""

    def read(self, size: int | None = -1, /) -> bytes:
        """Read up to `size` bytes.

        Raises:
            ValueError: `size` is more than any record has.
        """
        if size is not None and size > MAX_CHUNK_BYTES:
            limit = f"limit {MAX_CHUNK_BYTES / 1e6:.0f} MB"
            raise ValueError(f"a record claims {size / 1e6:.0f} MB ({limit})")
        return super().read(size)


class BoundedPath(type(Path())):  # type: ignore[misc]
    """A path whose files are read as `BoundedFile`, for libraries that open files themselves."""

    def open(self, mode: str = "r", *arguments: Any, **more: Any) -> Any:
        """Open the file."""
        if mode == "rb":
            return BoundedFile(io.FileIO(os.fspath(self)))
        return super().open(mode, *arguments, **more)


def unpack(decompressor: Callable[[], Any], packed: bytes, most_bytes: int = MAX_CHUNK_BYTES) -> bytes:
    """Decompress all frames of a block of data, step by step.

    Args:
        decompressor: makes an object with the interface of `bz2.BZ2Decompressor`.
        packed: compressed data.
        most_bytes: maximum size after decompression.

    Raises:
        ValueError: the data unpack to more.
        EOFError: the data are truncated.
    """
    pieces, n_bytes = list[bytes](), 0
    while packed:
        stream = decompressor()
        while not stream.eof:
            piece = stream.decompress(packed, _STEP_BYTES)
            packed, n_bytes = b"", n_bytes + len(piece)
            if n_bytes > most_bytes:
                raise ValueError(f"a compressed chunk unpacks to more than {most_bytes / 1e6:.4g} MB")
            pieces.append(piece)
            if not piece and stream.needs_input and not stream.eof:
                raise EOFError("a compressed chunk is truncated")
        packed = bytes(stream.unused_data or b"")
    return b"".join(pieces)


class Unpacking:
    """A compressed recording, decompressed while reading, up to a plausible size.

    Args:
        source: the opened file, which reads unpacked bytes.
        packed_bytes: the size of the compressed file.
    """

    def __init__(self, source: Any, packed_bytes: int) -> None:
        self._source = source
        self._n_left = MAX_CHUNK_BYTES + _MOST_SHRINKAGE * packed_bytes

    def read(self, size: int = _STEP_BYTES, /) -> bytes:
        """Read up to `size` bytes.

        Raises:
            ValueError: the file unpacks to far more than a recording does.
        """
        piece = bytes(self._source.read(min(size, _STEP_BYTES)))
        self._n_left -= len(piece)
        if self._n_left < 0:
            raise ValueError("it unpacks to far more than a recording does")
        return piece

    def __enter__(self) -> "Unpacking":
        return self

    def __exit__(self, *_: object) -> None:
        self._source.close()


@contextmanager
def decoding() -> Iterator[None]:
    """Limit the memory used to decode a file; one file at a time.

    Libraries allocate as much as a header states before they read the data. Beyond the limit their
    allocations fail, with errors that depend on the library. Linux only; elsewhere without effect.
    """
    with _decoding:
        soft, hard = resource.getrlimit(resource.RLIMIT_DATA)
        with suppress(OSError, ValueError, StopIteration):
            lines = Path("/proc/self/status").read_text().splitlines()
            used = next(1024 * int(line.split()[1]) for line in lines if line.startswith("VmData:"))
            limit = used + _DECODING_BYTES
            if soft < 0 or limit < soft:
                resource.setrlimit(resource.RLIMIT_DATA, (limit, hard))
        try:
            yield
        finally:
            resource.setrlimit(resource.RLIMIT_DATA, (soft, hard))
