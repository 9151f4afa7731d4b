"""Collection from sensors that send over UDP and pipes: captures, end, and recordings."""

import random
import signal
import subprocess
import sys
import time
from collections.abc import Callable

import pytest
from wire.collecting import Collecting
from wire.rig import ENVIRONMENT, WireRig
from wire.timing import placement_at

from lce_rig.rig import dump_rig
from tests.collect.live.conftest import LOOPS_PER_HOLD
from tests.collect.live.sent import (
    captured_names,
    check_sent,
    check_stamps,
    check_whole,
    errors,
    journal_of,
    read_sent,
)
from tests.shared import changed

pytestmark = pytest.mark.realtime
Start = Callable[..., WireRig]


@pytest.mark.long
@pytest.mark.parametrize(
    ("number", "code"),
    [(signal.SIGTERM, 0), (signal.SIGINT, 130), pytest.param(signal.SIGHUP, 0, marks=pytest.mark.slow)],
    ids=["SIGTERM", "SIGINT", "SIGHUP"],
)
def test_signals_end_a_collection_cleanly(wire, tmp_path, number, code):
    with Collecting(wire().profile, tmp_path / "session", "--hold", "0") as collecting:
        collecting.wait_for_captures(1)
        assert collecting.end(number) == code
    assert errors(collecting.said) == [] and "Traceback" not in collecting.said
    assert "ended: stopped" in collecting.said
    names = [capture.name for capture in check_whole(tmp_path / "session")]
    said = "1 capture" if len(names) == 1 else f"{len(names)} captures"
    assert f"{said} ({len(names)} new)" in collecting.said
    assert set(captured_names(collecting.said)) <= set(names)


@pytest.mark.long
def test_killed_collection_loses_no_capture(wire, tmp_path):
    rig, session, said = wire(), tmp_path / "session", list[str]()
    chance = random.Random(0)
    for turn in range(3):
        with Collecting(rig.profile, session, "--hold", "0") as collecting:
            collecting.wait_for("moving" if turn else "captured 000000")
            time.sleep(chance.uniform(0, 2))
            collecting.end(signal.SIGKILL)
        said += captured_names(collecting.said)
        assert set(said) <= {capture.name for capture in check_whole(session)}
        assert len(said) == len(set(said))


@pytest.mark.slow
def test_recording_beside_collect_is_usable(wire, reel, tmp_path):
    rig, record = wire(), tmp_path / "recording"
    live, later = tmp_path / "live", tmp_path / "later"
    began_ns = time.time_ns()
    with Collecting(rig.profile, live, "--hold", "0", "--record", str(record)) as collecting:
        collecting.wait_for_captures(2)
        assert collecting.end() == 0
    ended_ns = time.time_ns()
    assert "samples recorded" in collecting.said
    words = ["collect", "--rig", str(rig.profile), str(later), "--from", str(record)]
    code = "from lce_rig.cli.main import main; main()"
    done = subprocess.run(
        [sys.executable, "-c", code, *words], env=ENVIRONMENT, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    # Live, on this rig, every board that stands still is captured; of a recording a place counts once.
    for capture in check_whole(live):
        assert began_ns < (capture.scan("lidar").stamp_ns or 0) < ended_ns
    stored, sent = check_whole(later), read_sent(reel, rig.rig.lidars["lidar"])
    assert 1 <= len(stored) <= 4
    for capture in stored:
        stamp_ns = capture.scan("lidar").stamp_ns or 0
        shown = placement_at(stamp_ns, LOOPS_PER_HOLD, reel.n_placements)
        assert check_sent(capture, sent) == shown, "pictures and packets are of one moment"
        assert began_ns < stamp_ns < ended_ns


@pytest.mark.long
def test_collect_ended_camera_is_named(wire, tmp_path):
    rig = wire()
    command = ("sh", "-c", "echo no such camera >&2; exit 3")
    broken = changed(rig.rig, cameras__cam__driver__command=command)
    rig.profile.write_text(dump_rig(broken))
    with Collecting(rig.profile, tmp_path / "session", "--timeout", "10") as collecting:
        assert collecting.wait() == 6
    said = collecting.said.partition("ended: ")[0]
    assert "code 3" in said and "lidar is" not in said


@pytest.mark.long
def test_collect_stores_the_sent_samples(wire, reel, tmp_path):
    rig, session = wire(), tmp_path / "session"
    with Collecting(rig.profile, session, "--hold", "0", "--captures", "2") as collecting:
        assert collecting.wait() == 0
    with Collecting(rig.profile, session, "--hold", "0", "--captures", "3") as again:
        assert again.wait() == 0
    captures, sent = check_whole(session), read_sent(reel, rig.rig.lidars["lidar"])
    assert [capture.name for capture in captures] == ["000000", "000001", "000002"]
    assert captured_names(collecting.said) + captured_names(again.said) == [each.name for each in captures]
    for capture in captures:
        check_stamps(capture, check_sent(capture, sent), reel.n_placements)
    assert [entry["ending"] for entry in journal_of(session)] == ["frames", "frames"]


@pytest.mark.long
def test_collect_without_captures_times_out(wire, tmp_path):
    with Collecting(wire().profile, tmp_path / "session", "--hold", "30", "--timeout", "1") as collecting:
        assert collecting.wait() == 6
    assert len(errors(collecting.said)) == 1
    assert [entry["ending"] for entry in journal_of(tmp_path / "session")] == ["timeout"]
