"""`lce-rig collect` without --from: its options, its errors, and a simulated rig from end to end."""

import json
import os
import pty
import select
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from lce_rig.rig import load_rig
from lce_rig.session import Session
from lce_rig.simulate import truth_extrinsics

TWO_LIDARS = str(Path(__file__).parents[1] / "rigs" / "two_lidars.yaml")


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        (["--topic", "cam=/x"], "--topic"),
        (["--from", "somewhere", "--hold", "3"], "--hold"),
        (["--from", "somewhere", "--simulated"], "--simulated"),
        (["--from", "somewhere", "--preview"], "--preview"),
        (["--seed", "3"], "--seed"),
    ],
)
def test_options_of_other_source_kind_are_refused(lce_rig, tmp_path, arguments, named):
    result = lce_rig("collect", "--rig", "rles", tmp_path / "session", *arguments)
    assert result.code == 2 and named in result.err
    assert not (tmp_path / "session").exists()


@pytest.mark.realtime
def test_rig_without_devices_error_has_hint(lce_rig, tmp_path):
    result = lce_rig("collect", "--rig", "rlfs", tmp_path / "session", "--plain", "--timeout", "5")
    assert result.code == 5
    assert "lidar" in result.err and "doctor" in result.err
    assert "captures" not in result.err and not (tmp_path / "session").exists(), "nothing had begun"


def test_simulated_and_real_captures_are_not_mixed(lce_rig, tmp_path):
    path = tmp_path / "session"
    path.mkdir()
    (path / "truth.json").write_text(json.dumps({"seed": 3}))
    result = lce_rig("collect", "--rig", "rles", path, "--plain", "--timeout", "5")
    assert result.code == 4 and "simulated" in result.err
    result = lce_rig(
        "collect", "--rig", "rles", path, "--simulated", "--seed", "4", "--plain", "--timeout", "5"
    )
    assert result.code == 4 and "--seed 3" in result.err
    (path / "truth.json").unlink()
    (path / "captures/000000").mkdir(parents=True)
    result = lce_rig("collect", "--rig", "rles", path, "--simulated", "--plain", "--timeout", "5")
    assert result.code == 4 and "real" in result.err


def test_collect_unusable_preview_is_refused(lce_rig, tmp_path):
    """Nothing is written."""
    with socket.create_server(("127.0.0.1", 0)) as taken:
        used = f"127.0.0.1:{taken.getsockname()[1]}"
        for address in (used, "99999"):
            path, record = tmp_path / "session", tmp_path / "record"
            result = lce_rig(
                "collect", "--rig", "rles", path, "--simulated", "--preview", address, "--record", record
            )
            assert result.code == 2
            assert "starting" not in result.err and not path.exists() and not record.exists()


def test_collect_preview_before_session_is_flag(lce_rig, tmp_path):
    """The word after the option is the session, unless it is an address."""
    session = tmp_path / "real"
    (session / "captures/000000").mkdir(parents=True)
    result = lce_rig("collect", "--rig", "rles", "--simulated", "--preview", session)
    assert result.code == 4 and str(session) in result.err


def start(path, *arguments, rig="rles", **options):
    command = [sys.executable, "-m", "lce_rig", "collect", "--rig", rig, str(path), "--simulated", *arguments]
    return subprocess.Popen(command, stderr=subprocess.PIPE, text=True, **options)


@pytest.mark.realtime
@pytest.mark.long
@pytest.mark.parametrize(
    ("rig", "pair"),
    [("rles", ("davis", "lidar")), ("mid360", ("cam", "lidar")), (TWO_LIDARS, ("front", "side"))],
    ids=["rles", "mid360", "two lidars"],
)
def test_collect_simulated_writes_truth(tmp_path, rig, pair):
    path = tmp_path / "session"
    process = start(path, "--plain", "--captures", "2", "--timeout", "240", "--hold", "0.3", rig=rig)
    _, said = process.communicate(timeout=400)
    assert process.returncode == 0, said
    session = Session.open(path)
    assert len(session.captures) == 2
    for capture in session.captures:
        capture.check()
        assert len(capture.lidars) + len(capture.image_keys) >= 2
    truth = json.loads((path / "truth.json").read_text())
    expected = truth_extrinsics(load_rig(rig), 0)[pair]
    assert np.allclose(truth["T_cam_lidar"], expected)
    assert "2 captures (2 new)" in said and "holding:" in said


@pytest.mark.realtime
@pytest.mark.long
def test_collect_killed_early_no_traceback(tmp_path):
    for number in (signal.SIGINT, signal.SIGTERM):
        process = start(tmp_path / number.name, "--plain", start_new_session=True)
        assert "starting" in process.stderr.readline()
        time.sleep(0.5)
        os.killpg(process.pid, number)  # like a terminal, also to the simulation
        _, said = process.communicate(timeout=180)  # until the simulation has closed its end, too
        assert process.returncode in (130, -number) and "Traceback" not in said


@pytest.mark.realtime
@pytest.mark.long
@pytest.mark.parametrize("term", ["xterm", pytest.param("dumb", marks=pytest.mark.slow)])
def test_collect_closed_terminal_stops(tmp_path, term):
    ours, theirs = pty.openpty()
    path = tmp_path / "session"
    environment = {**os.environ, "TERM": term}
    command = [sys.executable, "-m", "lce_rig", "collect", "--rig", "rles", str(path), "--simulated"]
    process = subprocess.Popen(
        command, stdin=theirs, stdout=theirs, stderr=theirs, env=environment, start_new_session=True
    )
    os.close(theirs)
    said, deadline_s = b"", time.monotonic() + 300
    try:
        while b"davis.frames" not in said and b"moving" not in said:
            assert time.monotonic() < deadline_s and process.poll() is None, said
            if select.select([ours], [], [], 0.5)[0]:
                said += os.read(ours, 65536)
        os.close(ours)
        process.send_signal(signal.SIGHUP)  # like the kernel for the controlling terminal
        process.wait(timeout=180)
    finally:
        process.kill()
    assert (b"\x1b[" in said) == (term == "xterm")
    entries = [json.loads(line) for line in (path / "journal.jsonl").read_text().splitlines()]
    assert entries[-1]["event"] == "collected live" and entries[-1]["ending"] == "stopped"


@pytest.mark.realtime
@pytest.mark.long
def test_collect_unattended_run_exits_with_6(lce_rig, tmp_path, monkeypatch):
    monkeypatch.setattr("lce_rig.cli.collect_live.SIMULATED_IDLE_S", 15.0)
    session = tmp_path / "session"
    # Nobody holds a board still for half a minute.
    wanted = "--hold", "30", "--captures", "2"
    result = lce_rig("collect", "--rig", "rles", session, "--simulated", "--plain", *wanted)
    assert result.code == 6, result.err
    assert "0 of 2 captures" in result.err
    assert Session.open(session).read_journal()[-1]["ending"] == "exhausted"
