"""Sessions in processes of their own: each end has a known cause."""

import os
import signal
import subprocess
import sys
import time

import pytest

from lce_rig.fleet.work import run_apart
from tests.shared import has_ended, wait_until

# What a session does, by name; the server imports this module by its path.
_MODULE = """
import os, signal, time
def done(arguments, tell):
    tell({"robot": arguments["robot"]})
    return [{"pid": os.getpid()}]
def hang(arguments, tell):
    tell({"robot": "r1"})
    time.sleep(60)
def eat(arguments, tell):
    held = []
    while True:
        held.append(bytearray(os.urandom(1 << 20) * 20))
        time.sleep(0.01)
def gulp(arguments, tell):
    return bytearray(1 << 40)
def crash(arguments, tell):
    os.kill(os.getpid(), signal.SIGSEGV)
def stumble(arguments, tell):
    print("this must not come between the messages")
    raise ZeroDivisionError("of no use")
"""


@pytest.fixture(scope="module", autouse=True)
def _acts(tmp_path_factory):
    folder = tmp_path_factory.mktemp("sessions")
    (folder / "acts_of_sessions.py").write_text(_MODULE)
    before = os.environ.get("PYTHONPATH", "")
    os.environ["PYTHONPATH"] = f"{folder}{os.pathsep}{before}"
    yield
    os.environ["PYTHONPATH"] = before


def act(name, limit_s=600.0, limit_mb=1000.0):
    return run_apart(f"acts_of_sessions:{name}", {"robot": "r1"}, limit_s, limit_mb)


def test_a_session_returns_its_rows():
    done = act("done")
    assert done.rows and done.rows[0]["pid"] != os.getpid()
    assert (done.known, done.status, done.cause) == ({"robot": "r1"}, "ok", None)


@pytest.mark.realtime
@pytest.mark.long
def test_hanging_session_ends_at_time_limit():
    start_s = time.monotonic()
    ended = act("hang", limit_s=8.0)
    assert (ended.rows, ended.status, ended.known) == (None, "timed_out", {"robot": "r1"})
    assert time.monotonic() - start_s < 50


@pytest.mark.parametrize("way", ["gulp", pytest.param("eat", marks=pytest.mark.long)])
def test_session_ends_at_memory_limit(way):
    ended = act(way, limit_mb=700.0)
    assert (ended.rows, ended.status) == (None, "out_of_memory")


def test_crashed_session_names_signal():
    assert act("crash").cause.figures["signal"] == signal.SIGSEGV


def test_a_bug_is_named_by_its_last_line():
    cause = act("stumble").cause
    assert cause.code == "fleet.bug" and "ZeroDivisionError" in cause.text


def test_session_process_ends_with_its_parent(tmp_path):
    (tmp_path / "acts_of_sessions.py").write_text(
        "import os, pathlib, time\n"
        "def hang(arguments, tell):\n"
        "    pathlib.Path(arguments['file']).write_text(str(os.getpid()))\n"
        "    time.sleep(600)\n"
    )
    pid_file = tmp_path / "pid"
    script = (
        "from lce_rig.fleet.work import run_apart\n"
        f"run_apart('acts_of_sessions:hang', {{'file': {str(pid_file)!r}}}, 600, 4000)\n"
    )
    path = os.pathsep.join([str(tmp_path), os.environ.get("PYTHONPATH", "")])
    worker = subprocess.Popen([sys.executable, "-c", script], env=os.environ | {"PYTHONPATH": path})
    wait_until(lambda: pid_file.exists() and pid_file.read_text())
    worker.kill()
    worker.wait()
    wait_until(lambda: has_ended(pid_file.read_text()))
