"""`lce-rig doctor`: one screen for people, one document for machines, and an exit code."""

import contextlib
import fcntl
import json
import os
import pty
import re
import signal
import struct
import subprocess
import sys
import termios
import time
from pathlib import Path

import pytest
from wire.vlp16_packets import Vlp16Clock

from lce_rig.core.findings import Finding
from lce_rig.rig import dump_rig
from tests.doctor.attached import Attached, attach, picture_of, scan_of
from tests.doctor.observed import make_rig


@pytest.fixture
def absent(tmp_path: Path) -> Path:
    """The profile of a rig of which nothing is attached."""
    path = tmp_path / "absent.yaml"
    with attach(Attached(make_rig(), has_board=False), tmp_path) as (rig, _):
        path.write_text(dump_rig(rig))
    return path


def test_absent_devices_are_red_with_what_to_check_and_exit_with_5(lce_rig, absent, tmp_path, monkeypatch):
    monkeypatch.setenv("COLUMNS", "80")
    done = lce_rig("doctor", "--rig", absent, "--duration", "1", "-o", tmp_path / "session")
    assert done.code == 5
    for group in ("lidar", "cam", "sync"):
        assert any(line.startswith(f"FAIL {group} ") for line in done.out.splitlines())
    assert "sync.device" in done.out
    assert str(tmp_path) in done.out
    assert "3 FAIL" in done.out.splitlines()[-1]
    assert all(group in done.err for group in ("lidar", "cam", "sync"))


@pytest.mark.long
def test_on_a_small_terminal_lines_that_are_ok_share_one(absent):
    words = [sys.executable, "-m", "lce_rig", "doctor", "--rig", str(absent), "--duration", "1"]
    host, terminal = pty.openpty()
    n_rows, n_columns = 12, 80
    fcntl.ioctl(terminal, termios.TIOCSWINSZ, struct.pack("HHHH", n_rows, n_columns, 0, 0))
    environment = {key: value for key, value in os.environ.items() if key not in ("COLUMNS", "LINES")}
    environment |= {"TERM": "xterm"}
    with subprocess.Popen(words, stdout=terminal, stderr=subprocess.PIPE, env=environment) as process:
        os.close(terminal)
        screen = read_all(host)
        assert process.wait(60) == 5
    os.close(host)
    lines = re.sub(r"\x1b\[[0-9;]*m", "", screen).splitlines()
    assert max(map(len, lines)) <= n_columns
    folded = next(line for line in lines if line.startswith("ok   computer"))
    assert all(name in folded for name in ("python", "packages", "libraries"))
    assert sum(line.startswith("FAIL") for line in lines) == 3


def test_json_holds_every_line_with_its_figures(lce_rig, absent):
    done = lce_rig("doctor", "--rig", absent, "--duration", "1", "--json")
    document = json.loads(done.out)
    assert (done.code, document["severity"], document["rig"]) == (5, "error", "attached")
    assert document["format_version"] == 2
    lines = {(line["subject"], line["name"]): line for line in document["checks"]}
    assert lines["computer", "disk"]["findings"][0]["figures"]["free_mb"] > 0
    (failed,) = lines["lidar", "device"]["findings"]
    assert (failed["code"], failed["severity"], failed["subject"]) == ("sensor.failed", "error", "lidar")
    assert failed["text"] and failed["action"]


def test_warnings_alone_exit_with_0(lce_rig, tmp_path):
    rig = make_rig(lidars={"lidar": {"timestamps": {"clock": "utc", "reference": "first_firing"}}})
    board = rig.board.to_board()
    unlocked = Vlp16Clock("absent", has_nmea=False, error_us=721_000_000)
    attached = Attached(rig, picture_of(board), scan_of(board, 2.2), unlocked, has_board=False)
    with attach(attached, tmp_path) as (reached, _):
        path = tmp_path / "rig.yaml"
        path.write_text(dump_rig(reached.model_copy(update={"sync": None})))
        for duration_s in ("2", "6", "18"):  # longer where a computer that is busy with others sends too late
            done = lce_rig("doctor", "--rig", path, "--duration", duration_s)
            if done.code == 0:
                break
    marks = {tuple(line.split()[:2]): line for line in done.out.splitlines()}
    assert ("ok", "lidar") in marks and ("ok", "cam") in marks
    assert "absent" in marks["warn", "PPS"]
    assert "FAIL" not in done.out and done.code == 0
    assert "warn" in done.out.splitlines()[-1]


BUSY = {("computer", "disk"), *((name, "stream") for name in ("lidar", "cam")), ("cam", "pulses")}
BUSY |= {("sync", "pulses"), ("sync", "clock"), ("rig", "clocks"), ("rig", "sync")}
"""Lines that depend on how busy the computer is, and on what the board has been told before."""


def judged(lce_rig, path: Path, n_lines: int) -> tuple[int, dict[tuple[str, str], tuple[str, list[str]]]]:
    """Examine a rig; gives the exit code, and severity and codes by line."""
    for duration_s in ("2", "6", "18"):  # longer where a computer that is busy with others sends too late
        done = lce_rig("doctor", "--rig", path, "--duration", duration_s, "--json")
        checks = json.loads(done.out)["checks"]
        if len(checks) >= n_lines:
            break
    lines = {(each["subject"], each["name"]): each for each in checks}
    return done.code, {
        key: (line["severity"], [found["code"] for found in line["findings"]])
        for key, line in lines.items()
        if key not in BUSY
    }


@pytest.mark.long
@pytest.mark.parametrize("is_attached", [False, True])
def test_words_decide_nothing(lce_rig, tmp_path, is_attached, request):
    rig = make_rig()
    board = rig.board.to_board()
    unlocked = Vlp16Clock("absent", has_nmea=False, error_us=721_000_000)
    there = Attached(rig, picture_of(board) // 6, scan_of(board, 2.2), unlocked)
    path, n_lines = tmp_path / "rig.yaml", 20 if is_attached else 9
    with attach(there if is_attached else Attached(rig, has_board=False), tmp_path) as (reached, _):
        path.write_text(dump_rig(reached))
        said = judged(lce_rig, path, n_lines)
        request.getfixturevalue("mute")
        code = "clock.missing"
        assert Finding(code).sentence == f"{code}: {code}"
        assert judged(lce_rig, path, n_lines) == said
    assert said[0] == 5 and said[1]["lidar", "PPS" if is_attached else "device"][0] == "error"


def test_a_rig_without_driver_lines_says_what_to_add(lce_rig, tmp_path):
    document = make_rig(sync=None).model_dump()
    document["cameras"]["cam"]["driver"] = {}
    document["lidars"]["lidar"]["driver"]["address"] = "127.0.0.1"
    path = tmp_path / "rig.yaml"
    path.write_text(dump_rig(type(make_rig()).model_validate(document)))
    done = lce_rig("doctor", "--rig", path, "--duration", "1")
    assert done.code == 5
    assert "/dev/video0}" in done.out


def test_help_says_what_the_exit_code_means(lce_rig):
    done = lce_rig("doctor", "--help")
    assert done.code == 0 and "with 5" in done.out


def test_an_unknown_rig_is_an_error_of_the_profile(lce_rig):
    assert lce_rig("doctor", "--rig", "no-such-rig").code == 3


def test_an_interrupted_examination_leaves_nothing_running(tmp_path):
    rig = make_rig(sync=None)
    with attach(Attached(rig, picture_of(rig.board.to_board()), has_board=False), tmp_path) as (reached, _):
        document = reached.model_dump()
        document["sync"] = None
        code, *arguments = document["cameras"]["cam"]["driver"]["command"][2:]
        program = f"import os; open({str(tmp_path / 'pid')!r}, 'w').write(str(os.getpid())); {code!s}"
        document["cameras"]["cam"]["driver"]["command"] = [sys.executable, "-c", program, *arguments]
        (tmp_path / "rig.yaml").write_text(dump_rig(type(rig).model_validate(document)))
        words = ["doctor", "--rig", str(tmp_path / "rig.yaml"), "--duration", "60"]
        with subprocess.Popen([sys.executable, "-m", "lce_rig", *words], stderr=subprocess.PIPE) as process:
            wait_for(lambda: (tmp_path / "pid").exists() and (tmp_path / "pid").read_text())
            process.send_signal(signal.SIGINT)
            assert process.wait(30) == 130
        pid = (tmp_path / "pid").read_text()
        wait_for(lambda: is_gone(pid))


def read_all(terminal: int) -> str:
    """Read what a program writes to its terminal until it ends."""
    parts = []
    with contextlib.suppress(OSError):  # The other end is closed.
        while part := os.read(terminal, 4096):
            parts.append(part)
    return b"".join(parts).decode()


def is_gone(pid: str) -> bool:
    state = Path(f"/proc/{pid}/stat")
    return not state.exists() or state.read_text().rpartition(") ")[2][0] in "ZX"


def wait_for(is_so) -> None:
    end_s = time.monotonic() + 30
    while not is_so():
        assert time.monotonic() < end_s
        time.sleep(0.02)
