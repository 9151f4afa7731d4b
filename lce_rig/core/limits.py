"""Limits on file contents, from what a real sensor can deliver.

Sizes that a file declares are checked against these limits before memory is taken, and unpacking stops at
them. A reader reports a limit as it reports damage, by a ValueError with words that follow the file's name.
"""

import os
import stat
from pathlib import Path
from typing import Any, BinaryIO

from lce_rig.core.data import MAX_TIME_NS as MAX_TIME_NS

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
"""Of one file or stretch that has to be in memory as a whole: half a minute at two million per second."""
MAX_NETWORK_BYTES = 1 << 29
"""Voxels and states of one step of a network: E2VID's at 1280 x 720 take 220 MB."""
MAX_EVENT_PIXELS = 1 << 22
"""Of one event camera: four times the largest on sale."""
MAX_PACKET_BYTES = 1 << 24
"""Of events in one message: drivers send some ms at a time."""
MAX_TOPICS = 1 << 14
"""Of one bag, with every publisher of each counted."""
MAX_RECORDS = 1 << 18
"""Of one chunk of a bag."""

# File systems that compress store recordings in a tenth of their size, not in a hundredth.
_MAX_HOLES = 100


def open_regular(path: Path) -> BinaryIO:
    """Open a file for reading; pipes and devices, which may never end, and files of holes are refused.

    Raises:
        OSError: it is not there, or may not be read.
        ValueError: it is not a regular file, or hardly anything was ever written to it.
    """
    # Without O_NONBLOCK opening a pipe waits for whoever writes to it.
    descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)
    try:
        status = os.fstat(descriptor)
        if stat.S_ISDIR(status.st_mode):
            raise IsADirectoryError(21, "it is a folder", str(path))
        if not stat.S_ISREG(status.st_mode):
            raise ValueError("it is a pipe or device, not a file")
        n_stored = 512 * status.st_blocks
        if status.st_size > _MAX_HOLES * (n_stored + MAX_CHUNK_BYTES):
            raise ValueError(
                f"it has {megabytes(status.st_size)}, of which {megabytes(n_stored)} were written"
            )
        return os.fdopen(descriptor, "rb")
    except BaseException:
        os.close(descriptor)
        raise


def read_file(path: Path, max_bytes: int = MAX_FILE_BYTES) -> bytes:
    """Read a whole file of limited size.

    Raises:
        OSError: it is not there, or cannot be read.
        ValueError: it is not a regular file, or larger.
    """
    with open_regular(path) as file:
        n_bytes = os.fstat(file.fileno()).st_size
        if n_bytes > max_bytes:
            raise ValueError(
                f"it is too large: {megabytes(n_bytes)}, at most {megabytes(max_bytes)} are read"
            )
        return file.read(max_bytes)


def check_size(n_bytes: int, what: str = "it", max_bytes: int = MAX_CHUNK_BYTES) -> int:
    """Pass a declared size through where a real sensor can reach it.

    Raises:
        ValueError: it is negative, or beyond the limit.
    """
    if not 0 <= n_bytes <= max_bytes:
        raise ValueError(f"{what} declares {megabytes(n_bytes)}, at most {megabytes(max_bytes)} are read")
    return n_bytes


def check_points(n_points: int) -> int:
    """Pass a declared number of points through where a scan can have as many.

    Raises:
        ValueError: it is negative, or beyond the limit.
    """
    if not 0 <= n_points <= MAX_POINTS:
        raise ValueError(f"it declares {n_points} points, at most {MAX_POINTS} are read")
    return n_points


def megabytes(n_bytes: int) -> str:
    """Write a size as messages show it."""
    return f"{n_bytes / 1e6:.0f} MB" if abs(n_bytes) < 1e12 else f"{n_bytes / 1e12:.3g} TB"


def describe(value: Any) -> str:
    """Show a value of a file in a message, cut to a length that fits on a screen."""
    text = repr(value)
    return text if len(text) <= 60 else text[:57] + "..."


def shorten(text: str) -> str:
    """Cut a name that a file gives to a length that fits on a screen."""
    return text if len(text) <= 120 else text[:117] + "..."
