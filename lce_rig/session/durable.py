"""Files that survive a power failure, and the lock against a second writer."""

import errno
import fcntl
import io
import os
import secrets
import shutil
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lce_rig.core.errors import SessionError

DRAFT, ASIDE = ".new-", ".old-"


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
    """Replace a file's content by `data` atomically: readers see the old or the new content.

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
    """Convert a failure to write into one error with an action.

    Args:
        path: path of the file or folder.
        n_safe: number of captures already saved.

    Raises:
        SessionError: a full disk, no permission, or something in the file's place.
    """
    try:
        yield
    except OSError as error:
        if isinstance(error, FileExistsError | NotADirectoryError):
            hint = "Move away what is in its place, or choose another folder."
        elif error.errno in (errno.EACCES, errno.EPERM, errno.EROFS):
            hint = "Choose a folder that you may write to, or change its permissions."
        else:
            hint = "Make room or choose another disk. The same command then goes on where it stopped."
        safe = f" The {n_safe} captures before it are safe." if n_safe else ""
        raise SessionError(f"{path} cannot be written: {error.strerror or error}", hint + safe) from error


def write_atomically(path: Path, content: str | bytes) -> None:
    """Write a file and its folder atomically; raises like `writing`."""
    with writing(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        replace_file(path, content.encode() if isinstance(content, str) else content)


def store_arrays(path: Path, arrays: Mapping[str, NDArray[Any]]) -> bool:
    """Write an entry of a cache: arrays by name, without pickle; the same arrays give the same bytes.

    Returns:
        Whether it could be written. A full or read-only disk is no error: the cache only saves time.
    """
    buffer = io.BytesIO()
    np.savez_compressed(buffer, allow_pickle=False, **dict(sorted(arrays.items())))
    with suppress(OSError):
        path.parent.mkdir(parents=True, exist_ok=True)
        replace_file(path, buffer.getvalue())
        return True
    return False


def load_arrays(path: Path) -> dict[str, NDArray[Any]] | None:
    """Read the arrays of `store_arrays`; None if the entry is missing or damaged, by its checksums."""
    try:
        with np.load(io.BytesIO(path.read_bytes()), allow_pickle=False) as file:
            return {name: file[name] for name in file.files}
    except Exception:  # Entries of other versions may fail in any way.
        return None


def flush_folder(path: Path) -> None:
    """Flush a folder's entries (names made, renamed, removed) to the disk."""
    descriptor = os.open(path, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def append_line(path: Path, line: str) -> None:
    """Append one line and flush it.

    A torn last line of an earlier run (killed, or full disk) is terminated first.

    Raises:
        OSError: a full disk, no permission.
    """
    with path.open("a+b") as file:
        file.seek(max(file.tell() - 1, 0))
        is_torn = file.read(1) not in (b"", b"\n")
        file.write((b"\n" if is_torn else b"") + line.encode() + b"\n")
        file.flush()
        os.fsync(file.fileno())


class WriterLock:
    """One writer per session.

    The kernel holds the lock (flock) and releases it when its holder dies, so locks are never stale. The file
    names the holder, for the message only.

    Raises:
        SessionError: another process writes.
    """

    def __init__(self, path: Path) -> None:
        self._descriptor = -1
        self._descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o644)
        try:
            fcntl.flock(self._descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            number = os.pread(self._descriptor, 20, 0).decode("ascii", errors="replace").strip()
            self.release()
            holder = f"process {number}" if number else "another process"
            hint = "Wait for it to end, or stop it."
            raise SessionError(f"{path.parent} is being written by {holder}", hint) from None
        os.ftruncate(self._descriptor, 0)
        os.pwrite(self._descriptor, f"{os.getpid()}\n".encode(), 0)

    def release(self) -> None:
        """Release the lock; a second call does nothing."""
        if self._descriptor >= 0:
            os.close(self._descriptor)
            self._descriptor = -1

    def __del__(self) -> None:
        self.release()


@contextmanager
def replacing(
    root: Path, folder: Path, finish: Callable[[Path, Path], None] = lambda _old, _draft: None
) -> Iterator[Path]:
    """Yield an empty draft that replaces a folder when the block ends, by two renames.

    If the block raises, or anything fails before the renames, the folder stays unchanged. If a process is
    killed between the two, `recover` restores the earlier folder.

    Args:
        root: the session's folder, in which drafts are made.
        folder: the folder to replace, anywhere below `root`; need not exist.
        finish: called with the folder and the draft just before the renames, while no other process may
            replace folders of this session; it copies files to be kept into the draft.

    Raises:
        SessionError: a full disk, no permission; or a file, or a link, is in the folder's place.
    """
    with writing(folder), ExitStack() as lock:
        check_folder(folder)
        draft = root / f"{DRAFT}{folder.name}-{secrets.token_hex(4)}"
        with _locked(root):
            for other in root.glob(f"{DRAFT}{folder.name}-*"):
                # Drafts of killed processes; drafts of running ones are locked.
                with suppress(OSError), _locked(other, waits=False):
                    shutil.rmtree(other, ignore_errors=True)
            draft.mkdir()
            lock.enter_context(_locked(draft))
        try:
            yield draft
            with _locked(root):
                _put_back(root)
                check_folder(folder)
                finish(folder, draft)
                for path, _, _ in os.walk(draft):
                    flush_folder(Path(path))
                folder.parent.mkdir(exist_ok=True)
                aside = root / (ASIDE + "+".join(folder.relative_to(root).parts))
                if folder.exists():
                    folder.rename(aside)
                draft.rename(folder)
                shutil.rmtree(aside, ignore_errors=True)
                for parent in {folder.parent, root}:
                    flush_folder(parent)
        finally:
            shutil.rmtree(draft, ignore_errors=True)


def check_folder(path: Path) -> None:
    """Check that a path is a folder or does not exist.

    Raises:
        NotADirectoryError: there is a file or a link, which a rename would move away.
    """
    if path.is_symlink() or (path.exists() and not path.is_dir()):
        what = "link" if path.is_symlink() else "file"
        raise NotADirectoryError(errno.ENOTDIR, f"{path.name} is a {what}, not a folder", str(path))


def recover(root: Path) -> None:
    """Restore a folder after a process was killed while it replaced it.

    Raises:
        OSError: no permission.
    """
    if any(root.glob(f"{ASIDE}*")):
        with _locked(root):
            _put_back(root)


def copy_over(source: Path, target: Path) -> None:
    """Copy a file or folder, using hard links where the file system has them.

    Raises:
        OSError: a full disk, no permission.
    """
    if source.is_dir() and not source.is_symlink():
        shutil.copytree(source, target, symlinks=True, copy_function=_link_or_copy)
    else:
        _link_or_copy(str(source), str(target))


def _link_or_copy(source: str, target: str) -> None:
    try:
        os.link(source, target, follow_symlinks=False)
    except OSError as error:
        if error.errno not in (errno.EPERM, errno.ENOTSUP, errno.EOPNOTSUPP, errno.EMLINK, errno.EXDEV):
            raise
        shutil.copy2(source, target, follow_symlinks=False)


def _put_back(root: Path) -> None:
    """Move each saved folder back if its place is free, else remove it."""
    for aside in root.glob(f"{ASIDE}*"):
        folder = root.joinpath(*aside.name.removeprefix(ASIDE).split("+"))
        if folder.exists():
            shutil.rmtree(aside, ignore_errors=True)
        else:
            aside.rename(folder)


@contextmanager
def _locked(folder: Path, *, waits: bool = True) -> Iterator[None]:
    """Hold a folder's lock, which the kernel drops with the process; no lock without flock (NFS).

    Raises:
        BlockingIOError: another process holds it, and this one does not wait.
    """
    descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | (0 if waits else fcntl.LOCK_NB))
        except OSError:
            if not waits:
                raise
        yield
    finally:
        os.close(descriptor)
