"""A cluster that somebody else runs, and recordings that a manifest names."""

import gc
import shutil

import pytest
from distributed import LocalCluster

from lce_rig.cli.main import run
from lce_rig.fleet.registry import Registry
from lce_rig.fleet.run import cluster
from lce_rig.fleet.storage import Storage
from lce_rig.rig import dump_rig
from lce_rig.session import Session


@pytest.fixture
def recorded(simulated, small_rig, tmp_path):
    """Lay out a folder of images and clouds as somebody recorded it, with a manifest beside it."""
    root = tmp_path / "root"
    for name in ("img", "pcd"):
        (root / "hall3" / "r9" / name).mkdir(parents=True)
    with Session.open(simulated) as session:
        for capture in session.captures:
            shutil.copy(capture.path / "cam.frames.png", root / "hall3/r9/img" / f"{capture.name}.png")
            shutil.copy(capture.path / "lidar.pcd", root / "hall3/r9/pcd" / f"{capture.name}.pcd")
    (root / "profile.yaml").write_text(dump_rig(small_rig))
    (root / "fleet.yaml").write_text('sessions:\n  - path: "hall3/{robot}"\n    rig: profile.yaml\n')
    return root


@pytest.mark.long
def test_two_fleets_at_once_have_their_own_dashboards():
    with cluster(1, 500) as first, cluster(1, 500) as second:
        assert first.dashboard_link != second.dashboard_link
    gc.collect()  # a socket that failed to bind would be a ResourceWarning here


@pytest.mark.long
def test_fleet_running_cluster_calibrates(recorded, capsys, tmp_path):
    words = ["fleet", "run", str(recorded), "--registry", str(tmp_path / "registry")]
    with LocalCluster(n_workers=1, threads_per_worker=1, dashboard_address=":0") as running:
        address = running.scheduler_address
        assert run([*words, "--scheduler", address]) == 0
    (row,) = Registry(Storage.at(tmp_path / "registry")).read_table().to_pylist()
    assert (row["status"], row["robot"], row["n_used"]) == ("ok", "r9", 8)
    assert run([*words, "--scheduler", address]) == 5
