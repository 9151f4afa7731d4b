"""The table of a fleet's results as a file."""

import io

import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from lce_rig.core.errors import SessionError
from lce_rig.fleet.registry import as_table, read_table


def test_other_files_are_refused(tmp_path, row):
    pq.write_table(as_table([row()]).drop_columns(["detail", "mpe_m"]), tmp_path / "older")
    (tmp_path / "torn").write_bytes(b"PAR1 torn")
    foreign = io.BytesIO()
    pq.write_table(pa.table({"a": [1]}), foreign)
    (tmp_path / "foreign").write_bytes(foreign.getvalue())
    for name in ("torn", "foreign", "absent", "older"):
        with pytest.raises(SessionError):
            read_table(tmp_path / name)
