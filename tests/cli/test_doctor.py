"""`lce-rig doctor`: one screen for people, one document for machines, and an exit code."""

import json
import signal
import subprocess
import sys

import pytest
from wire.vlp16_packets import Vlp16Clock

from lce_rig.rig import dump_rig
from tests.doctor.attached import PIXELS, SCAN, Attached, attach
from tests.doctor.observed import make_rig
from tests.shared import has_ended, wait_until

pytestmark = pytest.mark.realtime


@pytest.fixture
def absent(tmp_path):
    """The profile of a rig of which nothing is attached."""
    path = tmp_path / "absent.yaml"
    with attach(Attached(make_rig(), has_board=False), tmp_path) as rig:
        path.write_text(dump_rig(rig))
    return path


def test_doctor_absent_devices_exit_with_5(lce_rig, absent, tmp_path, monkeypatch):
    monkeypatch.setenv("COLUMNS", "80")
    done = lce_rig("doctor", "--rig", absent, "--duration", "1", "-o", tmp_path / "session")
    assert done.code == 5
    for group in ("lidar", "cam", "sync"):
        assert any(line.startswith(f"FAIL {group} ") for line in done.out.splitlines())
    assert "sync.device" in done.out
    assert "3 FAIL" in done.out.splitlines()[0]
    assert not any(line.startswith("ok ") for line in done.out.splitlines())
    assert all(group in done.err for group in ("lidar", "cam", "sync"))


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
    unlocked = Vlp16Clock("absent", has_nmea=False, error_us=721_000_000)
    attached = Attached(rig, PIXELS, SCAN, unlocked, has_board=False)
    with attach(attached, tmp_path) as reached:
        path = tmp_path / "rig.yaml"
        path.write_text(dump_rig(reached.model_copy(update={"sync": None})))
        for duration_s in ("2", "6", "18"):  # longer, as a busy computer may send too late
            done = lce_rig("doctor", "--rig", path, "--duration", duration_s, "--explain")
            if done.code == 0:
                break
    marks = {tuple(line.split()[:2]): line for line in done.out.splitlines()}
    assert ("ok", "lidar") in marks and ("ok", "cam") in marks
    assert "absent" in marks["warn", "PPS"]
    assert "FAIL" not in done.out and done.code == 0
    assert "warn" in done.out.splitlines()[0]


def test_interrupted_doctor_leaves_no_process(tmp_path):
    rig = make_rig(sync=None)
    with attach(Attached(rig, PIXELS, has_board=False), tmp_path) as reached:
        document = reached.model_dump()
        document["sync"] = None
        code, *arguments = document["cameras"]["cam"]["driver"]["command"][2:]
        program = f"import os; open({str(tmp_path / 'pid')!r}, 'w').write(str(os.getpid())); {code!s}"
        document["cameras"]["cam"]["driver"]["command"] = [sys.executable, "-c", program, *arguments]
        (tmp_path / "rig.yaml").write_text(dump_rig(type(rig).model_validate(document)))
        words = ["doctor", "--rig", str(tmp_path / "rig.yaml"), "--duration", "60"]
        with subprocess.Popen([sys.executable, "-m", "lce_rig", *words], stderr=subprocess.PIPE) as process:
            wait_until(lambda: (tmp_path / "pid").exists() and (tmp_path / "pid").read_text())
            process.send_signal(signal.SIGINT)
            assert process.wait(60) == 130
        pid = (tmp_path / "pid").read_text()
        wait_until(lambda: has_ended(pid))
