"""The registry: a folder of each session's result, and the table of them all."""

import io
import json
from collections.abc import Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import chain, count
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import pyarrow as pa
import pyarrow.compute as pc

from lce_rig.core.calibration import read_result
from lce_rig.core.errors import LceRigError, SessionError, UsageError, reason_of
from lce_rig.core.files import parse_json
from lce_rig.fleet.findings import DAMAGED
from lce_rig.fleet.storage import Storage
from lce_rig.fleet.table import (
    COLUMNS,
    ROWS,
    SCHEMA,
    TABLE,
    Row,
    as_table,
    chosen_rows,
    in_order,
    read_table,
    table_bytes,
    with_pairs,
)
from lce_rig.pipeline.result_files import RESULT
from lce_rig.session.durable import write_atomically
from lce_rig.session.replacing import replacing

FORMAT_VERSION = 1
SUPERSEDED = ".superseded"
"""Folder of earlier results of sources that have a later one; no folder of a robot begins with a dot."""
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

        `ROWS` makes it a result; `write_rows` writes it. On this computer the folder appears in one step; in
        an object store its files are written one by one, `ROWS` last. An earlier result in this folder is
        moved below `SUPERSEDED`, unless the new one holds all its files.

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
                (self.place / folder).upload(draft, last=ROWS)
        except OSError as error:
            raise SessionError(
                f"{self.place.url}/{folder} cannot be written: {error.strerror or error}",
                "Free space or choose another registry, and run again.",
            ) from error

    def _keep(self, folder: str, draft: Path) -> None:
        """Set an earlier result of a folder aside, unless all its files are in the new one."""
        place = self.place / folder
        for name in place.files():
            if name != ROWS and not (
                (draft / name).is_file() and (place / name).read() == (draft / name).read_bytes()
            ):
                self.set_aside(folder)
                return

    def set_aside(self, folder: str) -> None:
        """Move a result below `SUPERSEDED`, where the table does not find it; numbered, if one is there.

        Raises:
            SessionError: it cannot be written; the result stays.
        """
        endings = chain([""], (f"-{n}" for n in count(2)))
        targets = (self.place / f"{SUPERSEDED}/{folder}{ending}" for ending in endings)
        (self.place / folder).move(next(target for target in targets if not target.names()))

    def folders(self) -> list[str]:
        """List the folders of results, "robot/date-hash"."""
        robots = [name for name in self.place.names() if not name.startswith(".") and name != TABLE]
        with ThreadPoolExecutor(_READERS) as pool:
            inner = pool.map(lambda robot: (self.place / robot).names(), robots)
            return [f"{robot}/{name}" for robot, names in zip(robots, inner, strict=True) for name in names]

    def found(self, robot: str, ending: str) -> str | None:
        """Find a robot's result by the end of its folder's name, its fingerprint."""
        names = [name for name in (self.place / robot).names() if name.endswith(f"-{ending}")]
        return f"{robot}/{names[-1]}" if names else None

    def rows(self, folder: str) -> list[Row]:
        """Read the rows of one result: none if it is no result, one with a cause if its files are damaged."""
        place = self.place / folder
        robot, _, name = folder.partition("/")
        names = {"robot": robot, "folder": folder}
        content, result = (place / ROWS).read(), (place / RESULT).read()
        if content is None:
            return []
        try:
            document = parse_json(content)
            if document["format_version"] != FORMAT_VERSION:
                raise ValueError(f"{ROWS} has format_version {document['format_version']!r}")
            rows = [dict(row) for row in document["rows"]]
            if any(row["status"] == "ok" for row in rows):
                with TemporaryDirectory(prefix="lce-rig-") as scratch:
                    copy = Path(scratch) / RESULT
                    copy.write_bytes(result or b"")
                    saved = read_result(copy)
                rows = with_pairs(rows, saved.pairs, saved.provenance.serials)
            rows = [{**row, **names} for row in rows]
            as_table(rows)  # checks the types
            return rows
        except Exception as error:
            cause = DAMAGED(what=error.what if isinstance(error, LceRigError) else reason_of(error))
            date = f"{name[:4]}-{name[4:6]}-{name[6:11]}:{name[11:13]}:{name[13:16]}"
            known = {"source": place.url, "date": date if name[:1].isdigit() else None}
            return [{**names, **known, "status": "failed", "cause": cause.code, "detail": cause.text}]

    def read_table(self, columns: Iterable[str] | None = None, where: str = "") -> Any:
        """Read the table, or some of its rows, as a `pyarrow.Table`.

        Args:
            columns: their names; None for all.
            where: condition in SQL, such as "verdict = 'fail' and date > '2026-01-01'" or
                "list_contains(findings, 'verdict.control_failed')"; "" for all rows.

        Raises:
            SessionError: there is no table, or it cannot be read.
            UsageError: the condition or a column is wrong; the columns are named.
        """
        names = list(columns or SCHEMA.names)
        unknown = sorted(set(names) - set(SCHEMA.names))
        if unknown:
            raise UsageError(f"the table has no column {unknown[0]!r}", COLUMNS)
        source: Path | io.BytesIO
        if self.place.local is not None:
            source = self.place.local / TABLE
        else:
            content = (self.place / TABLE).read()
            if content is None:
                raise SessionError(
                    f"{self.place.url} has no {TABLE}",
                    "`lce-rig fleet run ROOT --registry FOLDER` writes it.",
                )
            source = io.BytesIO(content)
        if not where.strip():
            return read_table(source, names)
        return chosen_rows(read_table(source), where).select(names)

    def write_table(self, table: Any) -> None:
        """Write the table in one step; raises SessionError."""
        (self.place / TABLE).write(table_bytes(table))

    def consolidate(self, fresh: Iterable[Row] = (), *, rebuild: bool = False) -> Any:
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
        if self.place.local is not None and self.place.local.is_file():
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
        # Of the results of one source, the last stays.
        finished = table.select(["source", "folder", "finished"]).group_by(["source", "folder"])
        finished = finished.aggregate([("finished", "max")])
        order = [("source", "ascending"), ("finished_max", "ascending"), ("folder", "ascending")]
        finished = finished.sort_by(order)
        sources, n = finished["source"].combine_chunks(), max(len(finished) - 1, 0)
        outdated = finished["folder"].slice(0, n).filter(pc.equal(sources[:n], sources[1:])).to_pylist()
        for folder in outdated:
            self.set_aside(folder)
        table = in_order(_without(table, pa.array(outdated, pa.string())))
        self.write_table(table)
        return table


def _without(table: Any, folders: Any) -> Any:
    values = folders.combine_chunks() if isinstance(folders, pa.ChunkedArray) else folders
    return table.filter(pc.invert(pc.is_in(table["folder"], value_set=values)))


def write_rows(draft: Path, rows: Iterable[Row]) -> None:
    """Write the rows of a result into its folder; raises SessionError on a full disk."""
    content = {"format_version": FORMAT_VERSION, "rows": list(rows)}
    write_atomically(draft / ROWS, json.dumps(content, indent=1, allow_nan=False) + "\n")
