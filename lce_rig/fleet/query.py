"""Choose rows of the table by a condition in SQL."""

from collections.abc import Sequence
from pathlib import Path
from tempfile import NamedTemporaryFile
from typing import Any

import duckdb
import pyarrow as pa

from lce_rig.core.errors import SessionError, UsageError
from lce_rig.fleet.registry import Registry
from lce_rig.fleet.table import SCHEMA, TABLE, column_names, read_table

_MEMORY = "1GB"


def query(registry: Registry, where: str = "", columns: Sequence[str] | None = None) -> Any:
    """Select rows of a registry's table as a `pyarrow.Table`, in its order.

    Args:
        registry: whose.
        where: condition in SQL, such as "verdict = 'fail' and date > '2026-01-01'" or
            "list_contains(findings, 'verdict.control_failed')"; "" for all rows.
        columns: of the result; None for all.

    Raises:
        SessionError: there is no table, or it cannot be read.
        UsageError: the condition or a column is wrong; the columns are named.
    """
    unknown = sorted(set(columns or ()) - set(SCHEMA.names))
    if unknown:
        raise UsageError(f"the table has no column {unknown[0]!r}", _columns())
    if registry.place.local is not None:
        return _select(registry.place.local / TABLE, where, columns)
    content = (registry.place / TABLE).read()
    if content is None:
        raise SessionError(f"{registry.place.url} has no {TABLE}", "`lce-rig fleet run` writes it.")
    with NamedTemporaryFile(suffix=".parquet") as file:
        file.write(content)
        file.flush()
        return _select(Path(file.name), where, columns)


def _select(path: Path, where: str, columns: Sequence[str] | None) -> Any:
    names = list(columns or SCHEMA.names)
    if not where.strip():
        return read_table(path, names)
    known = set(column_names(path))
    held = [name for name in names if name in known]
    settings: dict[str, str | bool | int | float | list[str]] = {"memory_limit": _MEMORY, "threads": 2}
    with duckdb.connect(config=settings) as connection:
        # A condition reads the table and no other file.
        allowed = str(path).replace("'", "''")
        connection.execute(f"SET allowed_paths = ['{allowed}']")
        connection.execute("SET enable_external_access = false")
        try:
            # `filter` takes one condition and nothing else; rows keep the order of the file.
            chosen = connection.read_parquet(str(path)).filter(where)
            rows = chosen.project(", ".join(held)).to_arrow_table()
        except duckdb.Error as error:
            first = str(error).splitlines()[0]
            raise UsageError(f"--where {where!r}: {first}", _columns()) from error
    for name in set(names) - known:
        rows = rows.append_column(name, pa.nulls(len(rows), SCHEMA.field(name).type))
    return rows.select(names)


def _columns() -> str:
    return f"Columns: {', '.join(SCHEMA.names)}.\nText stands in single quotes: verdict = 'fail'."
