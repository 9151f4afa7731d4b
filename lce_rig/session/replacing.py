"""Replace folders of results in one step: a reader always finds all earlier files or all new ones.

The writer fills a draft beside the session's other folders (`.new-calibration-XXXX`), then exchanges both in
one system call (renameat2). A killed process leaves one complete folder, and a draft that the next process
removes. A draft is locked (flock) while its writer lives.
"""

import ctypes
import errno
import fcntl
import os
import secrets
import shutil
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path

from lce_rig.session.durable import flush_folder

DRAFT, ASIDE = ".new-", ".old-"
_AT_FDCWD, _RENAME_EXCHANGE = -100, 2
# Errors if this kernel, C library or file system (NFS, FAT) cannot exchange.
_NO_EXCHANGE = {errno.ENOSYS, errno.EINVAL, errno.ENOTSUP, errno.EOPNOTSUPP, errno.EPERM}


@contextmanager
def replacing(
    root: Path,
    folder: Path,
    finish: Callable[[Path, Path], None] = lambda _old, _draft: None,
    *,
    can_exchange: bool = True,
) -> Iterator[Path]:
    """Yield an empty draft that replaces a folder when the block ends.

    If the block raises, or anything fails before the exchange, the folder stays unchanged.

    Args:
        root: the session's folder, in which drafts are made.
        folder: the folder to replace, anywhere below `root`; need not exist.
        finish: called with the folder and the draft just before the exchange, while no other process may
            replace folders of this session; it copies files to be kept into the draft.
        can_exchange: False uses the method for file systems that cannot exchange two folders in one step.

    Raises:
        OSError: a full disk, no permission; or a file, or a link, is in the folder's place.
    """
    with ExitStack() as lock:
        check_folder(folder)
        draft = root / f"{DRAFT}{folder.name}-{secrets.token_hex(4)}"
        with _locked(root):
            for other in root.glob(f"{DRAFT}{folder.name}-*"):
                # Of a killed process; those of living ones are locked.
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
                _change_places(draft, folder, root, can_exchange=can_exchange)
        finally:
            shutil.rmtree(draft, ignore_errors=True)


def check_folder(path: Path) -> None:
    """Check that a path is a folder or does not exist.

    Raises:
        NotADirectoryError: there is a file or a link, which an exchange would move away.
    """
    if path.is_symlink() or (path.exists() and not path.is_dir()):
        what = "link" if path.is_symlink() else "file"
        raise NotADirectoryError(errno.ENOTDIR, f"{path.name} is a {what}, not a folder", str(path))


def recover(root: Path) -> None:
    """Restore a folder after a process was killed, on file systems that cannot exchange two.

    Raises:
        OSError: no permission.
    """
    if any(root.glob(f"{ASIDE}*")):
        with _locked(root):
            _put_back(root)


def copy_over(source: Path, target: Path) -> None:
    """Copy a file or folder, its data shared with the source's where the file system has hard links.

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


def _change_places(draft: Path, folder: Path, root: Path, *, can_exchange: bool) -> None:
    if not folder.exists():
        draft.rename(folder)
    elif not (can_exchange and _exchange(draft, folder)):
        aside = root / (ASIDE + "+".join(folder.relative_to(root).parts))
        folder.rename(aside)
        # A process that is killed here has left both: `recover` puts the earlier folder back.
        draft.rename(folder)
        shutil.rmtree(aside, ignore_errors=True)
    flush_folder(folder.parent)
    if folder.parent != root:
        flush_folder(root)


def _exchange(a: Path, b: Path) -> bool:
    """Exchange two folders in one step; False if the system cannot."""
    try:
        renameat2 = ctypes.CDLL(None, use_errno=True).renameat2
    except AttributeError:
        return False
    if renameat2(_AT_FDCWD, os.fsencode(a), _AT_FDCWD, os.fsencode(b), _RENAME_EXCHANGE) == 0:
        return True
    number = ctypes.get_errno()
    if number in _NO_EXCHANGE:
        return False
    raise OSError(number, os.strerror(number), str(a), None, str(b))


def _put_back(root: Path) -> None:
    """Move each folder that was put aside back if its place is free, else remove it."""
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
