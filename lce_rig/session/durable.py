"""Files that survive a power failure, and the lock against a second writer."""

import errno
import fcntl
import io
import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lce_rig.core.errors import SessionError


def write_new_file(path: Path, data: bytes) -> None:
    """Write a new file and flush it to the disk.

    Raises:
        OSError: FileExistsError, a full disk, no permission.
    """
    with path.open("xb") as file:
        file.write(data)
        file.flush()
        os.fsync(file.fileno())


def replace_file(path: Path, data: bytes) -> None:
    """Replace a file's content by `data` in one step: readers see the old or the new content, never a part.

    Raises:
        OSError: a full disk, no permission.
    """
    draft = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        draft.unlink(missing_ok=True)
        write_new_file(draft, data)
        draft.replace(path)
    except OSError:
        draft.unlink(missing_ok=True)
        raise
    flush_folder(path.parent)


@contextmanager
def writing(path: Path, n_safe: int = 0) -> Iterator[None]:
    """Turn a failure to write into one error with the action against it.

    Args:
        path: of the file or folder.
        n_safe: captures before it, which are safe.

    Raises:
        SessionError: a full disk, no permission, or something in the file's place.
    """
    try:
        yield
    except OSError as error:
        if isinstance(error, FileExistsError | NotADirectoryError):
            hint = "Move away what is in its place, or choose another folder."
        elif error.errno in (errno.EACCES, errno.EPERM, errno.EROFS):
            hint = "Choose a folder that you may write to, or see to its permissions."
        else:
            hint = "Make room or choose another disk. The same command then goes on where it stopped."
        safe = f" The {n_safe} captures before it are safe." if n_safe else ""
        raise SessionError(f"{path} cannot be written: {error.strerror or error}", hint + safe) from error


def write_atomically(path: Path, content: str | bytes) -> None:
    """Write a file, and its folder, so that it is there whole or not at all; raises as `writing`."""
    with writing(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        replace_file(path, content.encode() if isinstance(content, str) else content)


def store_arrays(path: Path, arrays: Mapping[str, NDArray[Any]]) -> bool:
    """Write an entry of a cache: arrays by name, without pickle; the same arrays give the same bytes.

    Returns:
        Whether it could be written: a full or read-only disk only costs the time saved.
    """
    buffer = io.BytesIO()
    np.savez_compressed(buffer, allow_pickle=False, **dict(sorted(arrays.items())))
    with suppress(OSError):
        path.parent.mkdir(parents=True, exist_ok=True)
        replace_file(path, buffer.getvalue())
        return True
    return False


def load_arrays(path: Path) -> dict[str, NDArray[Any]] | None:
    """Read what `store_arrays` wrote; None if there is no entry or it is damaged, by its checksums."""
    try:
        with np.load(io.BytesIO(path.read_bytes()), allow_pickle=False) as file:
            return {name: file[name] for name in file.files}
    except Exception:  # An entry of another version can fail in any way.
        return None


def flush_folder(path: Path) -> None:
    """Flush a folder's entries (names made, renamed, removed) to the disk."""
    descriptor = os.open(path, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def append_line(path: Path, line: str) -> None:
    """Append one line and flush it; undo a partial write if the disk is full.

    A torn last line of an earlier run that was killed is closed by a line break first.

    Raises:
        OSError: a full disk, no permission.
    """
    descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o644)
    try:
        size = os.lseek(descriptor, 0, os.SEEK_END)
        is_torn = size > 0 and os.pread(descriptor, 1, size - 1) != b"\n"
        data = (b"\n" if is_torn else b"") + line.encode() + b"\n"
        try:
            written = 0
            while written < len(data):
                written += os.write(descriptor, data[written:])
            os.fsync(descriptor)
        except OSError:
            os.ftruncate(descriptor, size)
            raise
    finally:
        os.close(descriptor)


class WriterLock:
    """One writer per session.

    The kernel holds the lock (flock) and drops it when its holder dies, however that happens: a lock is never
    stale. The file names the holder, for the message only.

    Raises:
        BlockingIOError: another process writes; the argument is its process id, or "".
    """

    def __init__(self, path: Path) -> None:
        self._descriptor = -1
        self._descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o644)
        try:
            fcntl.flock(self._descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            holder = os.pread(self._descriptor, 20, 0).decode("ascii", errors="replace").strip()
            self.release()
            raise BlockingIOError(holder) from None
        os.ftruncate(self._descriptor, 0)
        os.pwrite(self._descriptor, f"{os.getpid()}\n".encode(), 0)

    def release(self) -> None:
        """Release the lock; a second call does nothing."""
        if self._descriptor >= 0:
            os.close(self._descriptor)
            self._descriptor = -1

    def __del__(self) -> None:
        self.release()
