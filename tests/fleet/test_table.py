"""The table of a fleet's results as a file."""

import io

import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from lce_rig.core.errors import SessionError
from lce_rig.fleet.registry import as_table, read_table


def test_a_column_that_an_earlier_version_did_not_write_is_null(tmp_path, row):
    path = tmp_path / "t.parquet"
    pq.write_table(as_table([row()]).drop_columns(["detail", "mpe_m"]), path)
    (document,) = read_table(path).to_pylist()
    assert document["detail"] is None and document["mpe_m"] is None and document["robot"] == "r1"
    assert read_table(path, ["robot", "detail"]).column_names == ["robot", "detail"]


def test_other_files_are_refused(tmp_path):
    (tmp_path / "torn").write_bytes(b"PAR1 torn")
    foreign = io.BytesIO()
    pq.write_table(pa.table({"a": [1]}), foreign)
    (tmp_path / "foreign").write_bytes(foreign.getvalue())
    for name in ("torn", "foreign", "absent"):
        with pytest.raises(SessionError):
            read_table(tmp_path / name)
