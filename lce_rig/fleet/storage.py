"""Folders on this computer or in an object store (s3://...), by their address."""

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from fsspec.core import url_to_fs

from lce_rig.core.errors import SourceError
from lce_rig.session.durable import write_atomically
from lce_rig.session.replacing import copy_over


@dataclass(frozen=True)
class Storage:
    """A folder, by a path or by an address that fsspec knows.

    Attributes:
        url: absolute; without a slash at its end.
    """

    url: str

    @classmethod
    def at(cls, place: str | Path) -> "Storage":
        """Name a folder; a path becomes absolute."""
        text = str(place).removeprefix("file://")
        return cls(text.rstrip("/") if "://" in text else str(Path(text).resolve()))

    def __truediv__(self, name: str) -> "Storage":
        return Storage(f"{self.url}/{name}")

    @property
    def local(self) -> Path | None:
        """Its path; None if it is elsewhere."""
        return None if "://" in self.url else Path(self.url)

    @property
    def name(self) -> str:
        """The last part of its address."""
        return self.url.rpartition("/")[2]

    @cached_property
    def _opened(self) -> tuple[Any, str]:
        try:
            return url_to_fs(self.url)  # type: ignore[no-any-return]
        except (ImportError, ValueError) as error:
            raise SourceError(f"{self.url} cannot be opened: {error}", "Give a path, or s3://...") from error

    @property
    def fs(self) -> Any:
        """The file system that fsspec has for it."""
        return self._opened[0]

    @property
    def path(self) -> str:
        """Its path in that file system."""
        return self._opened[1]

    def url_of(self, path: str) -> str:
        """Give the address of a path that the file system lists."""
        return path if self.local is not None else f"{self.url.partition('://')[0]}://{path}"

    def exists(self) -> bool:
        """Return whether there is such a file or folder."""
        return bool(self.fs.exists(self.path))

    def is_folder(self) -> bool:
        """Return whether it is a folder."""
        return bool(self.fs.isdir(self.path))

    def read(self) -> bytes | None:
        """Read it as a file; None if there is none."""
        try:
            return bytes(self.fs.cat_file(self.path))
        except (FileNotFoundError, IsADirectoryError, NotADirectoryError):
            return None

    def write(self, content: bytes) -> None:
        """Write it as a file, in one step."""
        if self.local is None:
            self.fs.pipe_file(self.path, content)
            return
        self.local.parent.mkdir(parents=True, exist_ok=True)
        write_atomically(self.local, content)

    def names(self) -> list[str]:
        """List what it holds as a folder, by name; nothing if there is no such folder."""
        try:
            found = self.fs.ls(self.path, detail=False, refresh=True)
        except TypeError:  # file systems without a cache of listings
            found = self.fs.ls(self.path, detail=False)
        except (FileNotFoundError, NotADirectoryError):
            return []
        own = self.path.rstrip("/")
        return sorted({str(each).rstrip("/").rpartition("/")[2] for each in found if each.rstrip("/") != own})

    def fetch(self, target: Path, *, without: frozenset[str] = frozenset()) -> None:
        """Copy it to this computer; on the same disk, files share their data.

        Args:
            target: the copy, which must not exist.
            without: names in the folder that are left out.

        Raises:
            OSError: it is not there, or cannot be read.
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
        if not self.is_folder():
            self.fs.get_file(self.path, str(target))
            return
        target.mkdir(parents=True)
        prefix = self.path.rstrip("/") + "/"
        wanted = {path: path.removeprefix(prefix) for path in self.fs.find(self.path)}
        kept = {p: own for p, own in wanted.items() if own.partition("/")[0] not in without}
        for own in kept.values():
            if ".." in own.split("/"):
                raise OSError(f"{own} leads out of the folder")
            (target / own).parent.mkdir(parents=True, exist_ok=True)
        self.fs.get(list(kept), [str(target / own) for own in kept.values()])
