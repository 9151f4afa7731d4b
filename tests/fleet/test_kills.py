"""Workers and clients that are killed: every session is in the table exactly once."""

import contextlib
import json
import os
import shutil
import signal
import subprocess
import sys

import psutil
import pytest

from lce_rig.fleet.registry import Registry
from lce_rig.fleet.storage import Storage
from tests.shared import wait_until


@pytest.mark.long
@pytest.mark.parametrize("how", [signal.SIGKILL, signal.SIGINT])
def test_results_survive_lost_worker_and_client(simulated, tmp_path, how):
    root, registry = tmp_path / "root", Registry(Storage.at(tmp_path / "registry"))
    for k in range(5):
        shutil.copytree(simulated, root / f"r{k}/s")
        shutil.rmtree(root / f"r{k}/s/captures/00000{k}")
    command = [sys.executable, "-m", "lce_rig", "fleet", "run", str(root), "--workers", "2", "--json"]
    command += ["--registry", registry.place.url]
    first = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    wait_until(lambda: len(registry.folders()) >= 1, 300)
    for worker in workers_of(first.pid)[:1]:
        with contextlib.suppress(ProcessLookupError):
            os.kill(worker, signal.SIGKILL)
    wait_until(lambda: len(registry.folders()) >= 2, 300)
    first.send_signal(how)
    first.communicate(timeout=180)
    assert first.returncode in ((-signal.SIGKILL, 0) if how == signal.SIGKILL else (130, 0))
    again = subprocess.run(command, capture_output=True, check=True)
    summary = json.loads(again.stdout)
    assert summary["statuses"] == {"ok": 5} and summary["n_held"] >= 2
    sources = registry.read_table(["source"])["source"].to_pylist()
    assert sorted(sources) == sorted(f"{root}/r{k}/s" for k in range(5))
    assert not [path for path in (tmp_path / "registry").iterdir() if path.name.startswith(".new-")]


def workers_of(pid):
    """List the worker processes of Dask that a client started."""
    with contextlib.suppress(psutil.Error):
        children = psutil.Process(pid).children()
        return sorted(child.pid for child in children if "spawn_main" in " ".join(child.cmdline()))
    return []
