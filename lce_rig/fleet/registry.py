"""The registry: a folder of each session's result, and the table of them all."""

import io
import json
from collections.abc import Iterable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass
from itertools import chain, count
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import pyarrow as pa
import pyarrow.compute as pc

from lce_rig.core.documents import parse_json
from lce_rig.core.errors import LceRigError, SessionError
from lce_rig.fleet.storage import Storage
from lce_rig.fleet.table import ROWS, TABLE, Row, as_table, merged, read_table, table_bytes, write_table
from lce_rig.session.durable import write_atomically
from lce_rig.session.replacing import replacing

FORMAT_VERSION = 1
# Earlier results of sources that have a later one; no folder of a robot begins with a dot.
SUPERSEDED = ".superseded"
# Small files from an object store take their time, not the processor's.
_READERS = 16


@dataclass(frozen=True)
class Registry:
    """Results of many sessions.

    Attributes:
        place: its folder.
    """

    place: Storage

    @contextmanager
    def result(self, folder: str) -> Iterator[Path]:
        """Yield an empty folder on this computer that becomes a session's result when the block ends.

        `ROWS` is what makes it a result; `write_rows` writes it. Here the folder appears in one step; in an
        object store its files are written one by one, and `ROWS` last. What an earlier result in this folder
        held, and the new one does not, is kept below `SUPERSEDED`.

        Args:
            folder: "robot/date-hash".

        Raises:
            SessionError: it cannot be written; an earlier result stays.
        """
        root = self.place.local
        try:
            if root is not None:
                root.mkdir(parents=True, exist_ok=True)
                with replacing(root, root / folder, lambda _, new: self._keep(folder, new)) as draft:
                    yield draft
                return
            with TemporaryDirectory(prefix="lce-rig-") as scratch:
                draft = Path(scratch) / "result"
                draft.mkdir()
                yield draft
                self._keep(folder, draft)
                self._upload(draft, self.place / folder)
        except OSError as error:
            raise SessionError(
                f"{self.place.url}/{folder} cannot be written: {error.strerror or error}",
                "Free space or choose another registry, and run again.",
            ) from error

    def _upload(self, draft: Path, target: Storage) -> None:
        files = {path.relative_to(draft).as_posix(): path for path in draft.rglob("*") if path.is_file()}
        last = files.pop(ROWS, None)
        if files:
            target.fs.put([str(each) for each in files.values()], [f"{target.path}/{own}" for own in files])
        target.fs.invalidate_cache()
        prefix = target.path.rstrip("/") + "/"
        held = {path.removeprefix(prefix) for path in target.fs.find(target.path)}
        stale = [prefix + own for own in sorted(held - set(files) - {ROWS})]
        if stale:
            target.fs.rm(stale)
        if last is not None:
            target.fs.pipe_file(f"{target.path}/{ROWS}", last.read_bytes())

    def folders(self) -> list[str]:
        """List the folders of results, "robot/date-hash"."""
        robots = [name for name in self.place.names() if not name.startswith(".") and name != TABLE]
        with ThreadPoolExecutor(_READERS) as pool:
            inner = pool.map(lambda robot: (self.place / robot).names(), robots)
            return [f"{robot}/{name}" for robot, names in zip(robots, inner, strict=True) for name in names]

    def rows(self, folder: str) -> list[dict[str, Any]]:
        """Read the rows of one result; none if it is no result."""
        content = (self.place / folder / ROWS).read()
        if content is None:
            return []
        try:
            document = parse_json(content)
            rows = document["rows"] if document["format_version"] == FORMAT_VERSION else []
        except (ValueError, KeyError, TypeError):
            return []  # damaged by other hands: the session is run again
        return [{**row, "folder": folder} for row in rows if isinstance(row, dict)]

    def found(self, robot: str, ending: str) -> str | None:
        """Find a robot's result by the end of its folder's name, its fingerprint."""
        names = [name for name in (self.place / robot).names() if name.endswith(f"-{ending}")]
        return f"{robot}/{names[-1]}" if names else None

    def set_aside(self, folder: str) -> None:
        """Move a result below `SUPERSEDED`, where the table does not find it.

        Raises:
            SessionError: it cannot be written; the result stays.
        """
        place, target = self.place / folder, self._aside(folder)
        try:
            if place.local is not None and target.local is not None:
                target.local.parent.mkdir(parents=True, exist_ok=True)
                with suppress(FileNotFoundError):  # another run was faster
                    place.local.rename(target.local)
                return
            self._copy_aside(place, target)
            if (place / ROWS).exists():
                place.fs.rm_file((place / ROWS).path)
            if place.exists():
                place.fs.rm(place.path, recursive=True)
        except OSError as error:
            raise SessionError(
                f"{place.url} cannot be moved to {target.url}: {error.strerror or error}",
                "Free space, or see to the registry's permissions, and run again.",
            ) from error

    def _keep(self, folder: str, draft: Path) -> None:
        """Copy an earlier result of a folder aside, unless all its files are in the new one."""
        place = self.place / folder
        prefix = place.path.rstrip("/") + "/"
        held = {path: draft / path.removeprefix(prefix) for path in place.fs.find(place.path)}
        own = [(path, new) for path, new in held.items() if path != prefix + ROWS]
        if any(not new.is_file() or place.fs.cat_file(path) != new.read_bytes() for path, new in own):
            self._copy_aside(place, self._aside(folder))

    def _aside(self, folder: str) -> Storage:
        """Give the place of a result that is set aside: numbered, if there is one already."""
        endings = chain([""], (f"-{n}" for n in count(2)))
        places = (self.place / f"{SUPERSEDED}/{folder}{ending}" for ending in endings)
        return next(place for place in places if not place.names())

    def _copy_aside(self, place: Storage, target: Storage) -> None:
        """Copy a result's files."""
        prefix = place.path.rstrip("/") + "/"
        for name in [path.removeprefix(prefix) for path in place.fs.find(place.path)]:
            copy = target / name
            if copy.local is not None:
                copy.local.parent.mkdir(parents=True, exist_ok=True)
            place.fs.cp_file((place / name).path, copy.path)

    def read_table(self, columns: Iterable[str] | None = None) -> Any:
        """Read the table as a `pyarrow.Table`; raises as `lce_rig.fleet.table.read_table`."""
        names = None if columns is None else list(columns)
        if self.place.local is not None:
            return read_table(self.place.local / TABLE, names)
        content = (self.place / TABLE).read()
        if content is None:
            raise SessionError(
                f"{self.place.url} has no {TABLE}", "`lce-rig fleet run` writes it, `table --rebuild` too."
            )
        return read_table(io.BytesIO(content), names)

    def write_table(self, table: Any) -> None:
        """Write the table in one step; raises SessionError."""
        if self.place.local is not None:
            write_table(self.place.local / TABLE, table)
        else:
            self.place.fs.pipe_file((self.place / TABLE).path, table_bytes(table))

    def consolidate(self, fresh: Iterable[Mapping[str, Any]] = (), *, rebuild: bool = False) -> Any:
        """Bring the table in line with the folders and write it.

        Rows of folders that are gone are dropped, those of folders that the table lacks are read. Of two
        results of one source the later one stays; the other's folder is moved below `SUPERSEDED`.

        Args:
            fresh: rows written since the table was; they replace those of the same folder.
            rebuild: read every folder, as if there were no table.

        Returns:
            The table.

        Raises:
            SessionError: the registry is a file, or cannot be written.
        """
        if self.place.exists() and not self.place.is_folder():
            raise SessionError(f"{self.place.url} is a file, not a registry", "Give a folder.")
        new = as_table(fresh)
        try:
            old = as_table([]) if rebuild else self.read_table()
        except LceRigError:
            old = as_table([])
        folders = self.folders()
        old = _without(old, new["folder"])
        known = set(old["folder"].unique().to_pylist()) | set(new["folder"].unique().to_pylist())
        with ThreadPoolExecutor(_READERS) as pool:
            read = pool.map(self.rows, [folder for folder in folders if folder not in known])
            unknown = as_table(row for rows in read for row in rows)
        table = pa.concat_tables([old, new, unknown])
        table = table.filter(pc.is_in(table["folder"], value_set=pa.array(folders, pa.string())))
        outdated = _superseded(table)
        for folder in outdated:
            self.set_aside(folder)
        table = merged([_without(table, pa.array(outdated, pa.string()))])
        self.write_table(table)
        return table


def _without(table: Any, folders: Any) -> Any:
    values = folders.combine_chunks() if isinstance(folders, pa.ChunkedArray) else folders
    return table.filter(pc.invert(pc.is_in(table["folder"], value_set=values)))


def _superseded(table: Any) -> list[str]:
    """List the folders of earlier results of a source that has a later one."""
    each = table.select(["source", "folder", "finished"]).group_by(["source", "folder"])
    each = each.aggregate([("finished", "max")])
    counted = each.group_by("source").aggregate([("folder", "count")])
    several = counted.filter(pc.greater(counted["folder_count"], 1))["source"].combine_chunks()
    twice = each.filter(pc.is_in(each["source"], value_set=several)).to_pylist()
    last: dict[str, dict[str, Any]] = {}
    for result in sorted(twice, key=lambda result: (result["finished_max"] or "", result["folder"])):
        last[result["source"]] = result
    return sorted(result["folder"] for result in twice if last[result["source"]] is not result)


def write_rows(draft: Path, rows: Iterable[Row]) -> list[dict[str, Any]]:
    """Write the rows of a result into its folder and return them as plain values.

    Raises:
        SessionError: a full disk, no permission.
    """
    documents = [asdict(row) for row in rows]
    content = {"format_version": FORMAT_VERSION, "rows": documents}
    write_atomically(draft / ROWS, json.dumps(content, indent=1, allow_nan=False) + "\n")
    return documents
