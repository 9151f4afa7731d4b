"""The table of a fleet's results: a row for each camera and LiDAR of a session, or for a session that failed.

The table is an index. A folder of the registry holds result.json, and beside it `ROWS` with what result.json
does not hold: `SESSION`. `pair_columns` selects the other columns from result.json, here and nowhere else.
"""

import io
import math
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal, TypeAlias

import numpy as np

from lce_rig.core.errors import SessionError, SourceError, UsageError
from lce_rig.judge.reach import covariance_alone

try:
    import pyarrow as pa
    import pyarrow.parquet as pq
except ModuleNotFoundError as error:
    raise SourceError(f"{error.name} is not installed", "pip install 'lce-rig[fleet]'") from error

from lce_rig.core.calibration import Calibration
from lce_rig.core.geometry import Array

TABLE, ROWS = "fleet.parquet", "fleet.json"
Status: TypeAlias = Literal["ok", "failed", "timed_out", "crashed", "out_of_memory"]
STATUSES: tuple[Status, ...] = ("ok", "failed", "timed_out", "crashed", "out_of_memory")
Row: TypeAlias = dict[str, Any]
"""Values by column; a column that is absent or None is not known. docs/fleets.md describes the columns."""

_TEXT, _TEXTS, _FLOAT, _INT = pa.string(), pa.list_(pa.string()), pa.float64(), pa.int32()
_MATRIX, _COVARIANCE = pa.list_(pa.float64(), 16), pa.list_(pa.float64(), 21)
SESSION: Mapping[str, Any] = {
    **dict.fromkeys(("robot", "rig", "date", "folder", "source", "session_sha256", "profile_sha256"), _TEXT),
    **dict.fromkeys(
        ("program", "method", "status", "cause", "detail", "collector", "site", "finished"), _TEXT
    ),
    **dict.fromkeys(("duration_s", "cpu_s", "peak_memory_mb"), _FLOAT),
}
"""Columns of a session, and their types."""
PAIR: Mapping[str, Any] = {
    **dict.fromkeys(("camera", "lidar", "camera_serial", "lidar_serial", "verdict"), _TEXT),
    **dict.fromkeys(("findings", "severities", "refusals"), _TEXTS),
    "T_cam_lidar": _MATRIX,
    "cov": _COVARIANCE,
    "cov_shared": _COVARIANCE,
    **dict.fromkeys(("n_captures", "n_detected", "n_used", "n_refused"), _INT),
    **dict.fromkeys(
        ("sigma_rotation_deg", "sigma_translation_m", "mpe_m", "mee_m", "reprojection_px"), _FLOAT
    ),
    **dict.fromkeys(("time_offset_s", "camera_scale"), _FLOAT),
    "scene": _TEXT,
}
"""Columns of a camera and a LiDAR, and their types."""
SCHEMA = pa.schema([pa.field(name, kind) for name, kind in {**SESSION, **PAIR}.items()])
COLUMNS = f"Columns: {', '.join(SCHEMA.names)}.\nText stands in single quotes: verdict = 'fail'."
_UPPER = np.triu_indices(6)
# Rows that share minima and maxima, by which a query skips them.
_ROWS_PER_GROUP = 1 << 16
# Poses and covariances, most of the bytes, do not shrink: the fastest to read wins.
_COMPRESSION = "lz4"


def pair_columns(c: Calibration, serials: Mapping[str, str]) -> Row:
    """Select the columns `PAIR` from a result.

    Args:
        c: the result of one camera and LiDAR.
        serials: serial numbers by sensor.
    """
    offsets = [channel.time_offset_s for channel in c.channel_results if channel.time_offset_s is not None]
    figures = {
        "sigma_rotation_deg": c.sigma_rotation_deg,
        "sigma_translation_m": c.sigma_translation_m,
        "mpe_m": c.metrics.mpe_m,
        "mee_m": c.metrics.mee_m,
        "reprojection_px": c.metrics.reprojection_px,
        "time_offset_s": float(np.mean(offsets)) if offsets else math.nan,
        "camera_scale": c.diagnostics.camera_scale,
    }
    return {
        "camera": c.camera,
        "lidar": c.lidar,
        "camera_serial": serials.get(c.camera),
        "lidar_serial": serials.get(c.lidar),
        "verdict": c.verdict,
        "findings": [finding.code for finding in c.findings],
        "severities": [finding.severity for finding in c.findings],
        "refusals": [refusal.code for refusal in c.captures_refused.values()],
        "T_cam_lidar": c.T_cam_lidar.ravel().tolist(),
        "cov": covariance_alone(c)[_UPPER].tolist(),
        "cov_shared": c.cov_shared[_UPPER].tolist(),
        "n_captures": c.n_captures,
        "n_detected": c.n_detected,
        "n_used": len(c.captures_used),
        "n_refused": len(c.captures_refused),
        **{name: float(value) if math.isfinite(value) else None for name, value in figures.items()},
        "scene": None if c.scene is None else c.scene.state,
    }


def with_pairs(rows: Iterable[Row], pairs: Iterable[Calibration], serials: Mapping[str, str]) -> list[Row]:
    """Put the columns of each result into its row.

    Args:
        rows: of one session, as in `ROWS`: one with status "ok" for all results, and one for each camera and
            LiDAR without a result. Earlier versions wrote one with all columns for each result.
        pairs: the results.
        serials: serial numbers by sensor.
    """
    known = list(rows)
    sessions = [{name: row.get(name) for name in SESSION} for row in known if row["status"] == "ok"]
    solved = [{**sessions[0], **pair_columns(pair, serials)} for pair in pairs] if sessions else []
    return solved + [row for row in known if row["status"] != "ok"]


def covariances(column: Any) -> Array:
    """Unpack a column of covariances (21 values a row, none null) into (N, 6, 6)."""
    values = _flat(column).reshape(-1, len(_UPPER[0]))
    cov = np.zeros((len(values), 6, 6))
    cov[:, _UPPER[0], _UPPER[1]] = values
    cov[:, _UPPER[1], _UPPER[0]] = values
    return cov


def poses(column: Any) -> Array:
    """Unpack a column of poses (16 values a row, none null) into (N, 4, 4)."""
    return _flat(column).reshape(-1, 4, 4)


def _flat(column: Any) -> Array:
    packed = column.combine_chunks() if isinstance(column, pa.ChunkedArray) else column
    return np.asarray(packed.flatten().to_numpy(zero_copy_only=False))


def as_table(rows: Iterable[Row]) -> Any:
    """Put rows into a `pyarrow.Table` of `SCHEMA`; other names are ignored."""
    return pa.Table.from_pylist(list(rows), schema=SCHEMA)


def in_order(table: Any) -> Any:
    """Sort a table by robot, camera, LiDAR and date."""
    return table.sort_by([(name, "ascending") for name in ("robot", "camera", "lidar", "date", "folder")])


def table_bytes(table: Any) -> bytes:
    """Write a table of `SCHEMA` as Parquet; equal tables give equal bytes."""
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


def read_table(source: Path | io.BytesIO, columns: Sequence[str] | None = None) -> Any:
    """Read a table as a `pyarrow.Table`; columns that an earlier version did not write are null.

    Args:
        source: its file, or the file's content.
        columns: the names of those to read; None for all.

    Raises:
        SessionError: there is no such file, or it is not such a table.
    """
    names = list(SCHEMA.names if columns is None else columns)
    try:
        with pq.ParquetFile(source) as file:
            held = set(file.schema_arrow.names)
            table = file.read(columns=[name for name in names if name in held])
    except FileNotFoundError:
        raise SessionError(
            f"{source}: there is no such table", "`lce-rig fleet run ROOT --registry FOLDER` writes it."
        ) from None
    except (OSError, pa.ArrowException) as error:
        raise SessionError(
            f"{source} cannot be read as a table: {error}",
            "`lce-rig fleet table --registry FOLDER --rebuild` writes it again.",
        ) from error
    if "robot" not in held:
        raise SessionError(f"{source} is not a table of results: it has no column robot")
    for name in names:
        if name not in held:
            table = table.append_column(SCHEMA.field(name), pa.nulls(len(table), SCHEMA.field(name).type))
    return table.select(names).cast(pa.schema([SCHEMA.field(name) for name in names]))


def chosen_rows(table: Any, where: str) -> Any:
    """Choose rows of a table of `SCHEMA` by a condition in SQL; they keep their order.

    Raises:
        UsageError: the condition is wrong; the columns are named.
    """
    import duckdb

    # A condition reads the table and nothing else.
    settings: dict[str, Any] = {"enable_external_access": False, "python_enable_replacements": False}
    with duckdb.connect(config={"memory_limit": "1GB", "threads": 2, **settings}) as connection:
        try:
            # `filter` takes one condition and nothing else.
            return connection.from_arrow(table).filter(where).to_arrow_table().cast(SCHEMA)
        except duckdb.Error as error:
            first = str(error).splitlines()[0]
            raise UsageError(f"--where {where!r}: {first}", COLUMNS) from error
