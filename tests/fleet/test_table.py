"""The table of a fleet's results as a file."""

import io

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from lce_rig.core.errors import SessionError
from lce_rig.fleet.registry import SCHEMA, as_table, covariances, poses, read_table, table_bytes


def test_rows_are_read_back_as_they_were_written(tmp_path, row):
    rows = [row("r1"), {"robot": "r2", "status": "timed_out", "cause": "fleet.timed_out", "findings": []}]
    (tmp_path / "t.parquet").write_bytes(table_bytes(as_table(rows)))
    table = read_table(tmp_path / "t.parquet")
    assert table.schema.equals(SCHEMA)
    assert table.to_pylist() == [dict.fromkeys(SCHEMA.names) | each for each in rows]


def test_a_covariance_and_a_pose_come_back_as_matrices(row):
    table = as_table([row(), row("r2")])
    cov = covariances(table["cov"])
    assert cov.shape == (2, 6, 6) and np.array_equal(cov[0], cov[0].T)
    assert np.array_equal(cov[1][np.triu_indices(6)], np.arange(21))
    assert np.array_equal(poses(table["T_cam_lidar"])[1], np.eye(4))


def test_a_column_that_an_earlier_version_did_not_write_is_null(tmp_path, row):
    path = tmp_path / "t.parquet"
    pq.write_table(as_table([row()]).drop_columns(["site", "cpu_s"]), path)
    (document,) = read_table(path).to_pylist()
    assert document["site"] is None and document["cpu_s"] is None and document["robot"] == "r1"
    assert read_table(path, ["robot", "site"]).column_names == ["robot", "site"]


def test_other_files_are_refused(tmp_path):
    (tmp_path / "torn").write_bytes(b"PAR1 torn")
    foreign = io.BytesIO()
    pq.write_table(pa.table({"a": [1]}), foreign)
    (tmp_path / "foreign").write_bytes(foreign.getvalue())
    for name in ("torn", "foreign", "absent"):
        with pytest.raises(SessionError):
            read_table(tmp_path / name)
