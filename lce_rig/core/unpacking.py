"""Compressed data, unpacked piece by piece and no further than a limit, however much they hold."""

import os
import zipfile
from contextlib import suppress
from functools import cache
from importlib import import_module
from typing import IO, Any, BinaryIO, Protocol, cast

from lce_rig.core.limits import MAX_CHUNK_BYTES, check_size, describe, megabytes

MAX_RATIO = 256
"""Of what a whole recording unpacks to and its size: images of a dark room shrink to a hundredth."""
MAX_EVENT_RATIO = 100
"""The same for events. A hundredth of an event's usual 13 bytes is one bit, and its pixel alone is more;
sensors' recordings shrink to a third or a tenth."""

# Sizes that unpack quickly at any ratio: short, black, or of a single value.
_FREE_BYTES = 1 << 24
# Larger than most chunks, which then are not copied once more.
_PIECE_BYTES = 1 << 23
# Some libraries copy what they have not come to at every call.
_FED_BYTES = 1 << 20
_DECOMPRESSORS = {
    "bz2": (("bz2",), "BZ2Decompressor"),
    "lz4": (("lz4.frame",), "LZ4FrameDecompressor"),
    "zstd": (("compression.zstd", "backports.zstd"), "ZstdDecompressor"),
}


class _Decompressor(Protocol):
    """The common interface of bz2, lzma, zlib, zstd and lz4.frame."""

    @property
    def eof(self) -> bool: ...

    @property
    def needs_input(self) -> bool: ...

    def decompress(self, data: bytes, max_length: int = -1) -> bytes: ...


class _FrameDecompressor(_Decompressor, Protocol):
    """One of those that keep what follows the end of their frame."""

    @property
    def unused_data(self) -> bytes: ...


def new_decompressor(kind: str) -> _FrameDecompressor:
    """Begin to unpack a stream of bz2, lz4 (frames) or zstd.

    Raises:
        ValueError: another kind.
        ImportError: this Python has no Zstandard, and no package provides it.
    """
    if kind not in _DECOMPRESSORS:
        raise ValueError(f"compression {describe(kind)} is not known; known are {', '.join(_DECOMPRESSORS)}")
    return cast(_FrameDecompressor, _decompressor_type(kind)())


@cache
def _decompressor_type(kind: str) -> Any:
    names, attribute = _DECOMPRESSORS[kind]
    for name in names[:-1]:
        with suppress(ImportError):
            return getattr(import_module(name), attribute)
    return getattr(import_module(names[-1]), attribute)


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
        fed = data[n_fed : n_fed + _FED_BYTES] if decompressor.needs_input else b""
        n_fed += len(fed)
        part = decompressor.decompress(fed, min(_PIECE_BYTES, n_left + 1))
        n_left -= len(part)
        parts.append(part)
        if n_left < 0:
            raise ValueError(f"it unpacks to more than {megabytes(max_bytes)}")
        if not (part or fed) and decompressor.needs_input and not decompressor.eof:
            raise ValueError("it is truncated")
    return b"".join(parts)


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


def unpacked_limit(n_stored: int) -> int:
    """Compute how many bytes of a recording so many stored ones may unpack to."""
    return MAX_EVENT_RATIO * n_stored + _FREE_BYTES


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
        return b"".join(iter(lambda: file.read(_FED_BYTES), b""))


class _InPieces:
    """A file that is read in pieces only: zipfile reads a list of members, however long, at once."""

    def __init__(self, file: BinaryIO) -> None:
        self._file = file

    def read(self, n_bytes: int = -1) -> bytes:
        data = self._file.read(min(n_bytes, _FED_BYTES + 1) if n_bytes >= 0 else _FED_BYTES + 1)
        if len(data) > _FED_BYTES:
            raise ValueError(f"its list of members is longer than {megabytes(_FED_BYTES)}")
        return data

    def __getattr__(self, name: str) -> Any:
        return getattr(self._file, name)
