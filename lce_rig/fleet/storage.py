"""Folders on this computer or in an object store (s3://...), by their address."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from fsspec import get_filesystem_class
from fsspec.archive import AbstractArchiveFileSystem
from fsspec.core import url_to_fs

from lce_rig.core.bounds import MAX_BYTES, require_file
from lce_rig.core.errors import LceRigError, SourceError, UsageError, reason_of
from lce_rig.session.durable import copy_over, write_atomically

_ABSENT = (FileNotFoundError, IsADirectoryError, NotADirectoryError)


@dataclass(frozen=True)
class Storage:
    """A folder or file, given as a path or an fsspec address.

    All methods raise SourceError with one line if the place cannot be reached, for any reason that a library
    reports: missing credentials, no network, no permission.

    Attributes:
        url: absolute address, without a trailing slash.
    """

    url: str

    @classmethod
    def at(cls, place: str | Path) -> "Storage":
        """Name a folder; a path becomes absolute."""
        text = str(place).removeprefix("file://")
        return cls(text.rstrip("/") if "://" in text else str(Path(text).resolve()))

    def require_folder(self) -> "Storage":
        """Return this place if it can be a folder of results.

        Raises:
            UsageError: the place is a file, a device, an archive, or of an unknown kind.
        """
        if self.local is None:
            try:
                kind = get_filesystem_class(self.url.partition("://")[0])
            except (ValueError, ImportError) as error:
                raise UsageError(f"{self.url}: {reason_of(error)}", "Give a folder, or s3://...") from error
            if issubclass(kind, AbstractArchiveFileSystem):
                raise UsageError(f"{self.url}: an archive is not a folder", "Unpack it and give the folder.")
        elif self.local.exists() and not self.local.is_dir():
            raise UsageError(f"{self.url} is not a folder", "Give a folder, or an address such as s3://...")
        return self

    def __truediv__(self, name: str) -> "Storage":
        return Storage(f"{self.url}/{name}")

    @property
    def local(self) -> Path | None:
        """Local path; None if it is remote."""
        return None if "://" in self.url else Path(self.url)

    @property
    def name(self) -> str:
        """The last part of its address."""
        return self.url.rpartition("/")[2]

    @contextmanager
    def reached(self) -> Iterator[tuple[Any, str]]:
        """Return fsspec's file system, and the path in it; see the class."""
        try:
            yield url_to_fs(self.url)
        except (LceRigError, *_ABSENT):
            raise
        except Exception as error:
            raise SourceError(
                f"{self.url} cannot be reached: {reason_of(OSError(str(error)))}",
                ""
                if self.local is not None
                else "Check the address, the credentials and the endpoint (docs/fleets.md#object-stores).",
            ) from error

    def exists(self) -> bool:
        """Check whether the file or folder exists."""
        with self.reached() as (fs, path):
            return bool(fs.exists(path))

    def read(self) -> bytes | None:
        """Read the file; None if it does not exist."""
        try:
            with self.reached() as (fs, path):
                if self.local is not None:
                    require_file(self.local, MAX_BYTES)
                return bytes(fs.cat_file(path))
        except _ABSENT:
            return None

    def write(self, content: bytes) -> None:
        """Write the file in one step; raises SessionError, also for a full disk or missing permission."""
        if self.local is not None:
            write_atomically(self.local, content)
            return
        with self.reached() as (fs, path):
            fs.pipe_file(path, content)

    def names(self) -> list[str]:
        """List the names of a folder's entries, sorted; empty if the folder is missing."""
        try:
            with self.reached() as (fs, path):
                entries = fs.ls(path, detail=False, **({} if self.local is not None else {"refresh": True}))
        except _ABSENT:
            return []
        return sorted(
            {str(e).rstrip("/").rpartition("/")[2] for e in entries if e.rstrip("/") != path.rstrip("/")}
        )

    def files(self) -> list[str]:
        """List the files below this folder, by relative path."""
        with self.reached() as (fs, path):
            fs.invalidate_cache()
            return sorted(str(file).removeprefix(path.rstrip("/") + "/") for file in fs.find(path))

    def folders_with(self, marker: str) -> list[str]:
        """List the outermost folders below this one that hold a file of this name, by relative path.

        The folder itself is "". Folders whose names begin with a dot are skipped.
        """
        folders = []
        with self.reached() as (fs, path):
            for folder, inner, files in fs.walk(path):
                if marker in files:
                    folders.append(str(folder).rstrip("/").removeprefix(path.rstrip("/")).lstrip("/"))
                for name in [name for name in inner if name.startswith(".") or marker in files]:
                    inner.pop(name) if isinstance(inner, dict) else inner.remove(name)
        return sorted(folders)

    def matching(self, pattern: str) -> list[str]:
        """List files and folders that match an fsspec pattern, by relative path."""
        with self.reached() as (fs, path):
            prefix = path.rstrip("/") + "/"
            return sorted(str(match).rstrip("/").removeprefix(prefix) for match in fs.glob(prefix + pattern))

    def move(self, target: "Storage") -> None:
        """Move a folder within the file system; do nothing if it is missing."""
        try:
            with self.reached() as (fs, path):
                if self.local is not None and target.local is not None:
                    target.local.parent.mkdir(parents=True, exist_ok=True)
                    self.local.rename(target.local)
                    return
                names, target_path = self.files(), url_to_fs(target.url)[1]
                for name in names:
                    fs.cp_file(f"{path}/{name}", f"{target_path}/{name}")
                fs.rm([f"{path}/{name}" for name in names])
        except _ABSENT:
            return  # another run was faster

    def upload(self, folder: Path, last: str) -> None:
        """Copy the files of a local folder to one in an object store, one by one, the file `last` last."""
        files = {
            path.relative_to(folder).as_posix(): str(path) for path in folder.rglob("*") if path.is_file()
        }
        end = files.pop(last, None)
        with self.reached() as (fs, path):
            if files:
                fs.put([*files.values()], [f"{path}/{name}" for name in files])
            if end is not None:
                fs.put_file(end, f"{path}/{last}")
            fs.invalidate_cache()

    def fetch(self, target: Path, *, without: frozenset[str] = frozenset()) -> None:
        """Copy it to this computer; copies on the same disk share their data.

        Args:
            target: the copy, which must not exist.
            without: names in the folder that are skipped.

        Raises:
            OSError: the source is missing, or the copy cannot be written.
        """
        if self.local is not None:
            if not self.local.is_dir():
                copy_over(self.local, target)
                return
            target.mkdir(parents=True)
            for entry in sorted(self.local.iterdir()):
                if entry.name not in without:
                    copy_over(entry, target / entry.name)
            return
        with self.reached() as (fs, path):
            if not fs.isdir(path):
                fs.get_file(path, str(target))
                return
            target.mkdir(parents=True)
            names = [name for name in self.files() if name.partition("/")[0] not in without]
            for name in names:
                if ".." in name.split("/"):
                    raise OSError(f"{name} leads out of the folder")
                (target / name).parent.mkdir(parents=True, exist_ok=True)
            fs.get([f"{path.rstrip('/')}/{name}" for name in names], [str(target / name) for name in names])
