"""Sessions of several robots, from their folders to the table."""

import os
import shutil
import signal
import subprocess
import sys

import pytest

from lce_rig.core.calibration import read_result
from lce_rig.fleet.jobs import find_jobs
from lce_rig.fleet.registry import poses
from lce_rig.fleet.run import cluster, run_fleet, run_job
from lce_rig.fleet.storage import Storage
from lce_rig.fleet.work import Settings
from tests.shared import contents

pytestmark = pytest.mark.long


@pytest.fixture(scope="module")
def client():
    with cluster(2, 2000.0) as client:
        yield client


def run(root, registry, client, **changes):
    settings = Settings(str(registry), **changes)
    return run_fleet(find_jobs(Storage.at(root)), settings, client), settings.opened()


def test_fleet_run_every_session_has_a_row(fleet_root, tmp_path, client):
    """A session without a result has a cause."""
    before = contents(fleet_root)
    done, registry = run(fleet_root, tmp_path / "registry", client)
    assert (done.n_new, done.n_held) == (3, 0)
    assert done.statuses == {"ok": 1, "failed": 2}
    assert done.causes == {"shortage.few_detected": 1, "fleet.session": 1}
    (good,) = registry.read_table(where="status = 'ok'").to_pylist()
    saved = read_result(registry.place.local / good["folder"] / "result.json")
    assert (
        poses(registry.read_table(where="status = 'ok'")["T_cam_lidar"])[0] == saved.pairs[0].T_cam_lidar
    ).all()
    assert good["robot"] == "r1" and good["verdict"] == saved.pairs[0].verdict
    assert good["folder"].endswith(good["session_sha256"][:12])
    assert contents(fleet_root) == before, "nothing below the root is written"


def test_fleet_run_skips_finished_sessions(fleet_root, tmp_path, client):
    shutil.rmtree(fleet_root / "r2/torn")
    place = tmp_path / "registry"
    first, registry = run(fleet_root, place, client)
    again, _ = run(fleet_root, place, client)
    assert (first.n_new, again.n_new, again.n_held) == (2, 0, 2)
    assert again.table.equals(first.table)
    retried, _ = run(fleet_root, place, client, retry=True)
    assert (retried.n_new, retried.n_held) == (1, 1)
    # Another profile concerns one session, a new one is new; the rest stays.
    profile = fleet_root / "r1/monday/rig.yaml"
    profile.write_text(profile.read_text().replace("square_m: 0.07\n", "square_m: 0.0701\n"))
    changed, _ = run(fleet_root, place, client)
    assert (changed.n_new, changed.n_held) == (1, 1)
    assert len(changed.table) == len(registry.folders()) == 2
    other, _ = run(fleet_root, place, client, method="paper")
    assert (other.n_new, set(other.table["method"].to_pylist())) == (2, {"paper"})


def test_fleet_run_limits_end_only_their_session(fleet_root, tmp_path):
    (job,) = [job for job in find_jobs(Storage.at(fleet_root)) if job.source.endswith("r1/monday")]
    for limits, status in (
        ({"time_limit_s": 0.3}, "timed_out"),
        ({"memory_limit_mb": 60.0}, "out_of_memory"),
    ):
        (row,) = run_job(job, Settings(str(tmp_path / status), **limits))
        assert (row["status"], row["cause"], row["robot"]) == (status, f"fleet.{status}", "r1")
    (row,) = run_job(job, Settings(str(tmp_path / "registry")))
    assert row["status"] == "ok"


def test_fleet_run_interrupt_ends_cleanly(fleet_root, tmp_path):
    words = [
        *(sys.executable, "-m", "lce_rig", "fleet", "run"),
        str(fleet_root),
        f"--registry={tmp_path / 'r'}",
    ]
    with subprocess.Popen(words, stderr=subprocess.PIPE, text=True, start_new_session=True) as ran:
        while "dashboard" not in ran.stderr.readline():
            assert ran.poll() is None
        os.killpg(ran.pid, signal.SIGINT)  # a terminal's Ctrl-C reaches the workers, too
        told = ran.stderr.read()
    assert ran.returncode == 130 and "interrupted" in told
    assert "Traceback" not in told
