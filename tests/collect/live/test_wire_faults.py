"""Sensors, clocks and disks that fail during `lce-rig collect`, which continues if possible."""

import os
import resource
import time
from collections.abc import Callable

import pytest
from wire.collecting import Collecting
from wire.rig import WireRig

from lce_rig.collect.live.collection import collect_live
from lce_rig.collect.live.state import LiveOptions
from lce_rig.devices import open_live
from lce_rig.session import Session
from tests.collect.live.sent import check_sent, check_stamps, check_whole, errors, journal_of, read_sent

pytestmark = pytest.mark.realtime
Start = Callable[..., WireRig]
# A host whose clock somebody sets by SET_S once a file is there: every reading of the time, the kernel's
# stamps of arrivals left out, which no process can set.
SET_CLOCK = """
import os, time
from lce_rig.devices import vlp16
vlp16._SO_TIMESTAMPNS = -1
real_ns = time.time_ns
time.time_ns = lambda: real_ns() + ({set_ns} if os.path.exists({file!r}) else 0)
"""


@pytest.mark.long
def test_collect_unplugged_camera_reconnects(wire, tmp_path):
    rig = wire()
    with Collecting(rig.profile, tmp_path / "session", "--hold", "0") as collecting:
        collecting.wait_for_captures(1)
        rig.unplug()
        collecting.wait_for("cam is lost: camera 'cam': its command ended with exit code 1")
        n_before = collecting.n_captures
        time.sleep(1.5)
        rig.plug_in()
        collecting.wait_for("cam is back")
        collecting.wait_for_captures(n_before + 1)
        assert collecting.end() == 0
    check_whole(tmp_path / "session")


@pytest.mark.long
def test_collect_silent_lidar_reconnects(wire, reel, tmp_path):
    rig = wire()
    with Collecting(rig.profile, tmp_path / "session", "--hold", "0") as collecting:
        collecting.wait_for_captures(1)
        n_whole = collecting.n_captures
        rig.tell("loss 0.3")
        collecting.wait_for("% of the packets lost")
        rig.tell("loss 0")
        time.sleep(1.0)
        n_lossy = collecting.n_captures
        rig.tell("pause 5")
        collecting.wait_for("lidar is lost: lidar: data packets")
        n_before = collecting.n_captures
        collecting.wait_for("lidar is back")
        collecting.wait_for_captures(n_before + 1)
        assert collecting.end() == 0
    # What was lost before it was opened again is not forgotten.
    assert journal_of(tmp_path / "session")[0]["lost"]["lidar"] >= rig.stop()["withheld"] > 0
    sent = read_sent(reel, rig.rig.lidars["lidar"])
    captures = check_whole(tmp_path / "session")
    # Those saved during the loss may lack packets.
    for capture in (*captures[:n_whole], *captures[n_lossy:]):
        check_stamps(capture, check_sent(capture, sent), reel.n_placements)


@pytest.mark.slow
def test_collect_lidar_gone_exits_with_5(wire, tmp_path):
    rig = wire()
    with Collecting(rig.profile, tmp_path / "session", "--hold", "0") as collecting:
        collecting.wait_for_captures(1)
        rig.tell("pause 1000")
        assert collecting.wait(180) == 5
    assert len(errors(collecting.said)) == 1 and "lidar: " in errors(collecting.said)[0]
    assert journal_of(tmp_path / "session")[-1]["ending"] == "lost"
    check_whole(tmp_path / "session")


@pytest.mark.slow
def test_collect_counter_jump_uses_arrival(wire, reel, tmp_path):
    rig = wire()
    with Collecting(rig.profile, tmp_path / "session", "--hold", "0") as collecting:
        collecting.wait_for_captures(1)
        rig.tell("clock absent 721000000")
        collecting.wait_for("PPS is absent")
        n_before = collecting.n_captures
        collecting.wait_for_captures(n_before + 2)
        assert collecting.end() == 0
    sent = read_sent(reel, rig.rig.lidars["lidar"])
    for capture in check_whole(tmp_path / "session")[-2:]:
        check_sent(capture, sent)
        stamp_ns, host_ns = capture.scan("lidar").stamp_ns, capture.scan("lidar").host_ns
        assert stamp_ns is not None and host_ns is not None
        assert abs(host_ns - stamp_ns) < 10**9


@pytest.mark.slow
@pytest.mark.parametrize("set_s", [-3600, 3600], ids=["back", "forward"])
def test_collect_continues_after_clock_change(wire, reel, tmp_path, set_s):
    rig, file = wire(), tmp_path / "set"
    prelude = SET_CLOCK.format(set_ns=set_s * 10**9, file=str(file))
    with Collecting(rig.profile, tmp_path / "session", "--hold", "0", prelude=prelude) as collecting:
        collecting.wait_for_captures(1)
        file.touch()
        n_before = collecting.n_captures
        collecting.wait_for_captures(n_before + 2)
        assert collecting.end() == 0
    sent = read_sent(reel, rig.rig.lidars["lidar"])
    for capture in check_whole(tmp_path / "session"):
        check_sent(capture, sent)


@pytest.mark.long
def test_collect_full_disk_keeps_captures(wire, tmp_path):
    rig, session = wire(), tmp_path / "session"
    with Collecting(rig.profile, session, "--hold", "0") as collecting:
        collecting.wait_for_captures(1)
        # From now on no file of that process grows beyond 100 kB.
        resource.prlimit(collecting.pid, resource.RLIMIT_FSIZE, (100_000, 100_000))
        assert collecting.wait() == 4
    assert len(errors(collecting.said)) == 1 and str(session) in errors(collecting.said)[0]
    assert "another disk" in collecting.said and "Traceback" not in collecting.said
    n_safe = len(check_whole(session))
    assert n_safe >= 1
    with Collecting(rig.profile, session, "--hold", "0", "--captures", str(n_safe + 1)) as again:
        assert again.wait() == 0
    assert len(check_whole(session)) == n_safe + 1


@pytest.mark.long
def test_collect_recording_disk_full_exits_5(wire, tmp_path):
    rig, session, streams = wire(), tmp_path / "session", tmp_path / "streams"
    with Collecting(rig.profile, session, "--hold", "0", "--record", str(streams)) as collecting:
        collecting.wait_for_captures(1)
        # Captures fit below this limit, the recording soon does not.
        resource.prlimit(collecting.pid, resource.RLIMIT_FSIZE, (3_000_000, 3_000_000))
        collecting.wait_for_captures(3)
        assert collecting.end() == 5
    assert len(errors(collecting.said)) == 1 and str(streams) in errors(collecting.said)[0]
    assert len(check_whole(session)) >= 3


@pytest.mark.long
def test_guidance_continues_during_slow_write(wire, tmp_path, monkeypatch):
    rig = wire()
    flush, begun_s, states_s = os.fsync, [], []

    def flush_slowly(descriptor):
        begun_s.append(time.monotonic())
        time.sleep(0.5)
        flush(descriptor)

    with Session.create(tmp_path / "session", rig.rig) as session:
        monkeypatch.setattr(os, "fsync", flush_slowly)
        options = LiveOptions(n_wanted=1, timeout_s=240.0, hold_s=0.0)
        report = collect_live(
            session, open_live(rig.rig), options, lambda _state: states_s.append(time.monotonic())
        )
        monkeypatch.undo()
    assert report.ending == "frames" and report.latencies_s[0] > 2.0
    during_s = [at_s for at_s in states_s if begun_s[0] < at_s < begun_s[0] + 2.0]
    assert len(during_s) >= 4
    # Meanwhile more boards were held still than requested.
    assert len(check_whole(tmp_path / "session")) == 1
