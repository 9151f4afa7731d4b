"""The registry: one folder per session result, and a table of all results.

The table has a row for each camera and LiDAR of a session, or for a session that failed. It is an index: a
folder of the registry holds result.json, and beside it `ROWS` with the columns that result.json lacks:
`SESSION`. `PAIR` selects the other columns from result.json, here and nowhere else.
"""

import io
import json
import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import chain, count
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Literal, TypeAlias

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq

from lce_rig.core.calibration import Calibration, read_result
from lce_rig.core.errors import LceRigError, SessionError, UsageError, reading, reason_of
from lce_rig.core.files import parse_json
from lce_rig.core.geometry import Array
from lce_rig.fleet.findings import DAMAGED
from lce_rig.fleet.storage import Storage
from lce_rig.judge.reach import covariance_alone
from lce_rig.pipeline.result_files import RESULT
from lce_rig.session.durable import replacing, write_atomically

TABLE, ROWS = "fleet.parquet", "fleet.json"
Status: TypeAlias = Literal["ok", "failed", "timed_out", "crashed", "out_of_memory"]
Row: TypeAlias = dict[str, Any]
"""Values by column; a column that is absent or None is not known. docs/fleets.md describes the columns."""

_TEXT, _TEXTS, _FLOAT, _INT = pa.string(), pa.list_(pa.string()), pa.float64(), pa.int32()
_MATRIX, _COVARIANCE = pa.list_(pa.float64(), 16), pa.list_(pa.float64(), 21)
_UPPER = np.triu_indices(6)
SESSION: Mapping[str, Any] = {
    **dict.fromkeys(("robot", "rig", "date", "folder", "source", "session_sha256", "profile_sha256"), _TEXT),
    **dict.fromkeys(("program", "method", "status", "cause", "detail", "finished"), _TEXT),
    "duration_s": _FLOAT,
}
"""Columns of a session, and their types."""
Select: TypeAlias = Callable[[Calibration, Mapping[str, str]], Any]
PAIR: Mapping[str, tuple[Any, Select]] = {
    "camera": (_TEXT, lambda c, _: c.camera),
    "lidar": (_TEXT, lambda c, _: c.lidar),
    "camera_serial": (_TEXT, lambda c, serials: serials.get(c.camera)),
    "lidar_serial": (_TEXT, lambda c, serials: serials.get(c.lidar)),
    "verdict": (_TEXT, lambda c, _: c.verdict),
    "findings": (_TEXTS, lambda c, _: [finding.code for finding in c.findings]),
    "severities": (_TEXTS, lambda c, _: [finding.severity for finding in c.findings]),
    "refusals": (_TEXTS, lambda c, _: [refusal.code for refusal in c.captures_refused.values()]),
    "T_cam_lidar": (_MATRIX, lambda c, _: c.T_cam_lidar.ravel().tolist()),
    "cov": (_COVARIANCE, lambda c, _: covariance_alone(c)[_UPPER].tolist()),
    "cov_shared": (_COVARIANCE, lambda c, _: c.cov_shared[_UPPER].tolist()),
    "n_captures": (_INT, lambda c, _: c.n_captures),
    "n_detected": (_INT, lambda c, _: c.n_detected),
    "n_used": (_INT, lambda c, _: len(c.captures_used)),
    "n_refused": (_INT, lambda c, _: len(c.captures_refused)),
    "sigma_rotation_deg": (_FLOAT, lambda c, _: c.sigma_rotation_deg),
    "sigma_translation_m": (_FLOAT, lambda c, _: c.sigma_translation_m),
    "mpe_m": (_FLOAT, lambda c, _: c.metrics.mpe_m),
    "mee_m": (_FLOAT, lambda c, _: c.metrics.mee_m),
    "reprojection_px": (_FLOAT, lambda c, _: c.metrics.reprojection_px),
    "scene": (_TEXT, lambda c, _: None if c.scene is None else c.scene.state),
}
"""Columns of a camera and a LiDAR: type, and the value in a result with the sensors' serial numbers."""
_TYPES = {**SESSION, **{name: kind for name, (kind, _) in PAIR.items()}}
SCHEMA = pa.schema([pa.field(name, kind) for name, kind in _TYPES.items()])
COLUMNS = f"Columns: {', '.join(SCHEMA.names)}.\nText stands in single quotes: verdict = 'fail'."

_WRITE_AGAIN = "`lce-rig fleet table --registry FOLDER --rebuild` writes it again."
# Rows per group; queries skip groups by their minimum and maximum.
_ROWS_PER_GROUP = 1 << 16
# Poses and covariances, most of the bytes, do not compress, so the fastest to read wins.
_COMPRESSION = "lz4"


def with_pairs(rows: Iterable[Row], pairs: Iterable[Calibration], serials: Mapping[str, str]) -> list[Row]:
    """Add the columns `PAIR` of each result to its row; figures that are not finite are null.

    Args:
        rows: rows of one session: one with status "ok" for all results, and one for each camera and
            LiDAR without a result.
        pairs: the results.
        serials: serial numbers by sensor.
    """
    known = list(rows)
    solved = []
    for session in [row for row in known if row["status"] == "ok"][:1]:
        for c in pairs:
            row = {name: session.get(name) for name in SESSION}
            row |= {name: select(c, serials) for name, (_, select) in PAIR.items()}
            solved.append(
                {
                    name: None if isinstance(value, float) and not math.isfinite(value) else value
                    for name, value in row.items()
                }
            )
    return solved + [row for row in known if row["status"] != "ok"]


def covariances(column: Any) -> Array:
    """Unpack a column of covariances (21 values per row, none null) into (N, 6, 6)."""
    values = _flat(column).reshape(-1, len(_UPPER[0]))
    cov = np.zeros((len(values), 6, 6))
    cov[:, _UPPER[0], _UPPER[1]] = values
    cov[:, _UPPER[1], _UPPER[0]] = values
    return cov


def poses(column: Any) -> Array:
    """Unpack a column of poses (16 values per row, none null) into (N, 4, 4)."""
    return _flat(column).reshape(-1, 4, 4)


def _flat(column: Any) -> Array:
    packed = column.combine_chunks() if isinstance(column, pa.ChunkedArray) else column
    return np.asarray(packed.flatten().to_numpy(zero_copy_only=False))


def as_table(rows: Iterable[Row]) -> Any:
    """Build a `pyarrow.Table` of `SCHEMA` from rows; other names are ignored."""
    return pa.Table.from_pylist(list(rows), schema=SCHEMA)


def in_order(table: Any) -> Any:
    """Sort a table by robot, camera, LiDAR and date."""
    return table.sort_by([(name, "ascending") for name in ("robot", "camera", "lidar", "date", "folder")])


def table_bytes(table: Any) -> bytes:
    """Encode a table of `SCHEMA` as Parquet; equal tables give equal bytes."""
    buffer = io.BytesIO()
    repeated = [field.name for field in SCHEMA if pa.types.is_string(field.type)]
    pq.write_table(
        table.cast(SCHEMA),
        buffer,
        compression=_COMPRESSION,
        use_dictionary=repeated,
        row_group_size=_ROWS_PER_GROUP,
    )
    return buffer.getvalue()


def read_table(place: Path | str | Storage, columns: Sequence[str] | None = None) -> Any:
    """Read a table as a `pyarrow.Table`.

    Args:
        place: path or address of its file.
        columns: names of the columns to read; None for all.

    Raises:
            SessionError: the file is missing, or not such a table.
    """
    place = place if isinstance(place, Storage) else Storage.at(place)
    names = list(SCHEMA.names if columns is None else columns)
    try:
        with (
            place.reached() as (fs, path),
            fs.open(path) as file,
            reading(place.url, SessionError, _WRITE_AGAIN),
        ):
            table = pq.read_table(file, columns=names)
            if table.column_names != names:
                raise ValueError("it lacks columns of this version")
    except FileNotFoundError:
        raise SessionError(
            f"{place.url}: there is no such table", "`lce-rig fleet run ROOT --registry FOLDER` writes it."
        ) from None
    return table.cast(pa.schema([SCHEMA.field(name) for name in names]))


def chosen_rows(table: Any, where: str) -> Any:
    """Select rows of a table of `SCHEMA` by an SQL condition, in their order.

    Raises:
        UsageError: the condition is wrong; the columns are named.
    """
    import duckdb

    # Settings that restrict a condition to reading the table.
    settings: dict[str, Any] = {"enable_external_access": False, "python_enable_replacements": False}
    with duckdb.connect(config={"memory_limit": "1GB", "threads": 2, **settings}) as connection:
        try:
            # `filter` accepts exactly one condition.
            return connection.from_arrow(table).filter(where).to_arrow_table().cast(SCHEMA)
        except duckdb.Error as error:
            first = str(error).splitlines()[0]
            raise UsageError(f"--where {where!r}: {first}", COLUMNS) from error


FORMAT_VERSION = 1
SUPERSEDED = ".superseded"
"""Folder of earlier results of sources that have a later one; no folder of a robot begins with a dot."""
# Threads: small files in an object store are limited by latency, not by the processor.
_READERS = 16


@dataclass(frozen=True)
class Registry:
    """Results of many sessions.

    Attributes:
        place: folder of the registry.
    """

    place: Storage

    @contextmanager
    def result(self, folder: str) -> Iterator[Path]:
        """Yield an empty local folder that becomes a session's result when the block ends.

        `ROWS` makes it a result; `write_rows` writes it. On this computer the folder appears in one step; in
        an object store its files are written one by one, `ROWS` last. An earlier result in this folder is
        moved below `SUPERSEDED`, unless the new one holds all its files.

        Args:
            folder: "robot/date-hash".

        Raises:
            SessionError: the folder cannot be written; an earlier result stays.
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
        """Keep an earlier result of a folder, unless all its files are in the new one."""
        place = self.place / folder
        for name in place.files():
            if name != ROWS and not (
                (draft / name).is_file() and (place / name).read() == (draft / name).read_bytes()
            ):
                self.set_aside(folder)
                return

    def set_aside(self, folder: str) -> None:
        """Move a result below `SUPERSEDED`, outside the table; add a number if the name exists.

        Raises:
            SessionError: the folder cannot be written; the result stays.
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
        """Find a robot's result by the fingerprint at the end of its folder's name."""
        names = [name for name in (self.place / robot).names() if name.endswith(f"-{ending}")]
        return f"{robot}/{names[-1]}" if names else None

    def rows(self, folder: str) -> list[Row]:
        """Read the rows of one result: none without a result; one with the cause for damaged files."""
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
            columns: names of the columns; None for all.
            where: condition in SQL, such as "verdict = 'fail' and date > '2026-01-01'" or
                "list_contains(findings, 'verdict.moved')"; "" for all rows.

        Raises:
            SessionError: the table is missing, or cannot be read.
            UsageError: the condition or a column is wrong; the columns are named.
        """
        names = list(columns or SCHEMA.names)
        unknown = sorted(set(names) - set(SCHEMA.names))
        if unknown:
            raise UsageError(f"the table has no column {unknown[0]!r}", COLUMNS)
        if not where.strip():
            return read_table(self.place / TABLE, names)
        return chosen_rows(read_table(self.place / TABLE), where).select(names)

    def write_table(self, table: Any) -> None:
        """Write the table in one step; raises SessionError."""
        (self.place / TABLE).write(table_bytes(table))

    def consolidate(self, fresh: Iterable[Row] = (), *, rebuild: bool = False) -> Any:
        """Update the table from the folders and write it.

        Rows of folders that are gone are dropped, those of folders that the table lacks are read. Of two
        results of one source the later one stays; the other's folder is moved below `SUPERSEDED`.

        Args:
            fresh: rows newer than the table; they replace those of the same folder.
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
        # Keep only the last result of each source.
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
