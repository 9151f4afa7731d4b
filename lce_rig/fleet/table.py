"""The table of a fleet's results: a row for each camera and LiDAR of a session, or for a session that failed.

The table is an index. The folders of the registry hold the results, and each its own rows (`ROWS`).
"""

import io
import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any, Literal

import numpy as np

try:
    import pyarrow as pa
    import pyarrow.parquet as pq
except ModuleNotFoundError as error:
    from lce_rig.core.errors import SourceError

    raise SourceError(f"{error.name} is not installed", "pip install 'lce-rig[fleet]'") from error

from lce_rig.core.calibration import Calibration
from lce_rig.core.errors import SessionError
from lce_rig.core.geometry import Array
from lce_rig.rig import Rig
from lce_rig.session.durable import write_atomically

TABLE, ROWS = "fleet.parquet", "fleet.json"
Status = Literal["ok", "failed", "timed_out", "crashed", "out_of_memory"]
STATUSES: tuple[Status, ...] = ("ok", "failed", "timed_out", "crashed", "out_of_memory")
_UPPER = np.triu_indices(6)
# So many rows share minima and maxima, by which a query skips them.
_ROWS_PER_GROUP = 1 << 16
# Poses and covariances, most of the bytes, do not shrink: what is read fastest wins.
_COMPRESSION = "lz4"


@dataclass(frozen=True)
class Row:
    """One row; what is not known is None or empty.

    Attributes:
        robot: its name.
        rig: name of the profile.
        date: of the session's last capture, UTC, such as "2026-11-20T10:22:03Z"; these sort as text.
        folder: of the session's result in the registry, "robot/date-hash".
        source: of the session or recording, a path or an address such as s3://...
        session_sha256: fingerprint of captures and profile, as in result.json.
        profile_sha256: of the session's rig.yaml.
        program: version of lce-rig.
        method: of the estimate.
        status: "ok", or why there is no result.
        cause: code of the finding that says why there is none.
        detail: the same in words.
        camera, lidar: names in the profile.
        camera_serial, lidar_serial: their serial numbers.
        verdict: "pass", "marginal" or "fail".
        findings, severities: codes of the findings behind the verdict, worst first, and how severe each is.
        T_cam_lidar: 16 values, row by row, p_cam = R p_lidar + t.
        cov: 21 values, the upper triangle row by row of (6, 6), tangent (translation m, rotation rad), axes
            of the camera.
        cov_shared: likewise, the part that all sessions of one lens and board have in common.
        sigma_rotation_deg, sigma_translation_m: sizes of the standard deviations.
        nominal: 16 values of the profile's T_cam_lidar.
        nominal_source: "cad" or "typical".
        nominal_tolerance_deg, nominal_tolerance_m: of the nominal pose.
        n_captures, n_detected, n_used, n_refused: captures in all, with the board in both sensors, behind the
            estimate, and refused.
        refusals: code of each refused capture.
        mpe_m, mee_m, reprojection_px: residuals, see docs/conventions.md.
        laser_range_m, laser_range_sigma_m: range offset of each laser, by ring, and its standard deviation.
        lens_error, lens_error_sigma: errors of the profile's intrinsics as the session's boards see them,
            given less seen: focal length (relative), principal point x and y (px), distortion (px in the
            image's corner); standard deviations.
        time_offset_s: mean over the camera's channels.
        camera_scale: of the camera's distances.
        scene: opinion of the scene: "agrees", "contradicts" or "unknown".
        collector, site: who collected the session, and where.
        duration_s, cpu_s: time that the session took, and of a processor.
        peak_memory_mb: of its process.
        finished: when the result was written, UTC.
    """

    robot: str
    rig: str | None = None
    date: str | None = None
    folder: str = ""
    source: str = ""
    session_sha256: str | None = None
    profile_sha256: str | None = None
    program: str = ""
    method: str | None = None
    status: Status = "ok"
    cause: str | None = None
    detail: str | None = None
    camera: str | None = None
    lidar: str | None = None
    camera_serial: str | None = None
    lidar_serial: str | None = None
    verdict: str | None = None
    findings: tuple[str, ...] = ()
    severities: tuple[str, ...] = ()
    T_cam_lidar: tuple[float, ...] | None = None
    cov: tuple[float, ...] | None = None
    cov_shared: tuple[float, ...] | None = None
    sigma_rotation_deg: float | None = None
    sigma_translation_m: float | None = None
    nominal: tuple[float, ...] | None = None
    nominal_source: str | None = None
    nominal_tolerance_deg: float | None = None
    nominal_tolerance_m: float | None = None
    n_captures: int | None = None
    n_detected: int | None = None
    n_used: int | None = None
    n_refused: int | None = None
    refusals: tuple[str, ...] = ()
    mpe_m: float | None = None
    mee_m: float | None = None
    reprojection_px: float | None = None
    laser_range_m: tuple[float, ...] | None = None
    laser_range_sigma_m: tuple[float, ...] | None = None
    lens_error: tuple[float, ...] | None = None
    lens_error_sigma: tuple[float, ...] | None = None
    time_offset_s: float | None = None
    camera_scale: float | None = None
    scene: str | None = None
    collector: str | None = None
    site: str | None = None
    duration_s: float | None = None
    cpu_s: float | None = None
    peak_memory_mb: float | None = None
    finished: str | None = None


def _type(name: str, annotation: Any) -> Any:
    """Choose the column type of an attribute of `Row`."""
    if name in ("T_cam_lidar", "nominal"):
        return pa.list_(pa.float64(), 16)
    if name in ("cov", "cov_shared"):
        return pa.list_(pa.float64(), len(_UPPER[0]))
    text = str(annotation)
    kind = pa.float64() if "float" in text else pa.int32() if "int" in text else pa.string()
    return pa.list_(kind) if "tuple" in text else kind


SCHEMA = pa.schema([pa.field(each.name, _type(each.name, each.type)) for each in fields(Row)])
"""The columns, in the order of `Row`."""


def result_columns(calibration: Calibration, rig: Rig, serials: Mapping[str, str]) -> dict[str, Any]:
    """Give what the result of one camera and LiDAR puts into its row.

    Args:
        calibration: the result.
        rig: the session's profile.
        serials: serial numbers by sensor.
    """
    c = calibration
    offsets = [each.time_offset_s for each in c.channel_results if each.time_offset_s is not None]
    nominal = rig.nominal(c.camera, c.lidar)
    columns: dict[str, Any] = {
        "method": c.method,
        "camera": c.camera,
        "lidar": c.lidar,
        "camera_serial": serials.get(c.camera),
        "lidar_serial": serials.get(c.lidar),
        "verdict": c.verdict,
        "findings": tuple(finding.code for finding in c.findings),
        "severities": tuple(finding.severity for finding in c.findings),
        "T_cam_lidar": _values(c.T_cam_lidar),
        "cov": _values(c.cov[_UPPER]),
        "cov_shared": _values(c.cov_shared[_UPPER]),
        "sigma_rotation_deg": c.sigma_rotation_deg,
        "sigma_translation_m": c.sigma_translation_m,
        "n_captures": c.n_captures,
        "n_detected": c.n_detected,
        "n_used": len(c.captures_used),
        "n_refused": len(c.captures_refused),
        "refusals": tuple(refusal.code for refusal in c.captures_refused.values()),
        "mpe_m": _known(c.metrics.mpe_m),
        "mee_m": _known(c.metrics.mee_m),
        "reprojection_px": _known(c.metrics.reprojection_px),
        "lens_error": c.lens_error or None,
        "lens_error_sigma": c.lens_error_sigma or None,
        "laser_range_m": c.laser_range_m or None,
        "laser_range_sigma_m": c.laser_range_sigma_m or None,
        "time_offset_s": float(np.mean(offsets)) if offsets else None,
        "camera_scale": _known(c.diagnostics.camera_scale),
        "scene": None if c.scene is None else c.scene.state,
    }
    if nominal is not None:
        columns |= {
            "nominal": _values(nominal.to_matrix()),
            "nominal_source": nominal.source,
            "nominal_tolerance_deg": nominal.tolerance_deg,
            "nominal_tolerance_m": nominal.tolerance_m,
        }
    return columns


def _values(matrix: Array) -> tuple[float, ...]:
    return tuple(map(float, matrix.ravel()))


def _known(value: float) -> float | None:
    return float(value) if math.isfinite(value) else None


def covariances(column: Any) -> Array:
    """Unpack a column of covariances (21 values a row, none null) into (N, 6, 6)."""
    packed = column.combine_chunks() if isinstance(column, pa.ChunkedArray) else column
    values = packed.flatten().to_numpy(zero_copy_only=False).reshape(-1, len(_UPPER[0]))
    cov = np.zeros((len(values), 6, 6))
    cov[:, _UPPER[0], _UPPER[1]] = values
    cov[:, _UPPER[1], _UPPER[0]] = values
    return cov


def poses(column: Any) -> Array:
    """Unpack a column of poses (16 values a row, none null) into (N, 4, 4)."""
    packed = column.combine_chunks() if isinstance(column, pa.ChunkedArray) else column
    return np.asarray(packed.flatten().to_numpy(zero_copy_only=False).reshape(-1, 4, 4))


def as_table(rows: Iterable[Row | Mapping[str, Any]]) -> Any:
    """Put rows, or what `Row` holds by name, into a `pyarrow.Table` of `SCHEMA`; other names are ignored."""
    documents = [asdict(row) if isinstance(row, Row) else dict(row) for row in rows]
    return pa.Table.from_pylist(documents, schema=SCHEMA)


def merged(tables: Sequence[Any]) -> Any:
    """Put tables one below the other, by robot, camera, LiDAR and date; of equal rows one stays."""
    whole = pa.concat_tables(tables) if tables else SCHEMA.empty_table()
    return whole.sort_by([(name, "ascending") for name in ("robot", "camera", "lidar", "date", "folder")])


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


def write_table(path: Path, table: Any) -> None:
    """Write a table into a file in one step: readers find the earlier one or the new one, whole.

    Raises:
        SessionError: a full disk, no permission.
    """
    write_atomically(path, table_bytes(table))


def column_names(source: Path | io.BytesIO) -> list[str]:
    """List the columns that a table holds.

    Raises:
        SessionError: there is no such file, or it is not such a table.
    """
    with _reading(source):
        names: list[str] = pq.read_schema(source).names
    if "robot" not in names:
        raise SessionError(f"{source} is not a table of results: it has no column robot")
    return names


@contextmanager
def _reading(source: Path | io.BytesIO) -> Iterator[None]:
    try:
        yield
    except FileNotFoundError:
        raise SessionError(f"{source}: there is no such table", "`lce-rig fleet run` writes it.") from None
    except (OSError, pa.ArrowException) as error:
        raise SessionError(
            f"{source} cannot be read as a table: {error}", "`lce-rig fleet table --rebuild` writes it again."
        ) from error


def read_table(source: Path | io.BytesIO, columns: Sequence[str] | None = None) -> Any:
    """Read a table as a `pyarrow.Table`; columns that an earlier version did not write are null.

    Args:
        source: its file, or the file's content.
        columns: the names of those to read; None for all.

    Raises:
        SessionError: there is no such file, or it is not such a table.
    """
    held = set(column_names(source))
    names = list(SCHEMA.names if columns is None else columns)
    with _reading(source), pq.ParquetFile(source) as file:
        table = file.read(columns=[name for name in names if name in held])
        for name in names:
            if name not in held:
                table = table.append_column(SCHEMA.field(name), pa.nulls(len(table), SCHEMA.field(name).type))
        return table.select(names).cast(pa.schema([SCHEMA.field(name) for name in names]))
