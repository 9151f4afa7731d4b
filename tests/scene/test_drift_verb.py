"""lce-rig drift on a simulated session, as a user types it."""

import json
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import replace

import cv2
import numpy as np
import pytest

from lce_rig.cli.main import run
from lce_rig.core.calibration import MOTIONS, ResultFile, read_result
from lce_rig.core.data import Events
from lce_rig.core.errors import SessionError, SourceError
from lce_rig.core.geometry import perturb
from lce_rig.io.ros.bag_recorder import BagRecorder
from lce_rig.pipeline.scene_samples import Thinned
from lce_rig.pipeline.watch_drift import SceneCaptures, drift
from lce_rig.rig import Rig, dump_rig
from lce_rig.session import Session
from lce_rig.timing.scan_pairing import EventCut, Frame
from tests.doctor.attached import Attached, attach
from tests.io.events.aedat4_files import RawFrame, write_davis
from tests.io.pcap_files import write_datagrams
from tests.io.test_pcap import to_datagram
from tests.io.vlp16_room import PERIOD_NS, T0_NS, packets_of
from tests.saved_results import write_result


@pytest.fixture
def turned(seen, tmp_path):
    """A result with extrinsics rotated by 2 deg about the camera's y axis."""
    T = perturb(seen.truth.T_cam_lidar, np.array([0, 0, 0, 0, np.radians(2.0), 0]))
    write_result(tmp_path / "result.json", seen.rig.name, [replace(seen.truth, T_cam_lidar=T)])
    return tmp_path / "result.json"


def test_unchanged_exits_with_0_and_draws(room, tmp_path, capsys):
    assert run(["drift", str(room), "-o", str(tmp_path), "--json"]) == 0
    (pair,) = json.loads(capsys.readouterr().out)["pairs"]
    assert pair["state"] == pair["scene"]["state"] == "unchanged" and pair["T_changed"] is None
    assert cv2.imread(str(tmp_path / "drift_cam_lidar.png")).shape[1] == 1600


def test_drift_changed_exits_with_7_in_six_lines(room, turned, capsys):
    assert run(["drift", str(room), "--result", str(turned)]) == 7
    captured = capsys.readouterr()
    lines = captured.out.splitlines()
    assert len(lines) <= 6 and "changed" in lines[0]
    assert lines[1].startswith("  Scene: changed") and lines[-1].startswith("  -> Fasten")


@pytest.mark.long
def test_a_folder_is_compared_as_a_session_is(room, seen, turned, tmp_path):
    folder = tmp_path / "folder"
    session = Session.open(room)
    for place in ("img", "pcd"):
        (folder / place).mkdir(parents=True)
    for capture in session.captures:
        shutil.copy(capture.path / "cam.frames.png", folder / "img" / f"{capture.name}.png")
        shutil.copy(capture.path / "lidar.pcd", folder / "pcd" / f"{capture.name}.pcd")
    (tmp_path / "rig.yaml").write_text(dump_rig(seen.rig))
    words = ["drift", str(folder), "--rig", str(tmp_path / "rig.yaml")]
    assert run([*words, "--result", str(turned)]) == 7
    assert run([*words, "--result", str(room / "calibration" / "result.json")]) == 0
    assert run(words) == 4


def test_even_images_exit_with_6(room, tmp_path, seen):
    path = tmp_path / "even"
    with Session.create(path, seen.rig) as session:
        for capture in seen.captures:
            (image,) = capture.images
            even = replace(image, pixels=np.full_like(image.pixels, capture.index))
            session.add_capture([even], capture.scans, {})
    assert run(["drift", str(path), "--result", str(room / "calibration" / "result.json")]) == 6


def test_a_result_of_another_rig_is_refused(room, seen, tmp_path):
    write_result(tmp_path / "result.json", "another", [seen.truth])
    assert run(["drift", str(room), "--result", str(tmp_path / "result.json")]) == 4


def result_file(path, seen, *pairs):
    write_result(path, seen.rig.name, list(pairs))
    return path


def record(path, rig, captures, cameras=("cam",)):
    """Record captures as a bag, as drivers would."""
    with BagRecorder(path, rig) as bag:
        for capture in captures:
            (image,) = capture.images
            samples = [*capture.scans, *(replace(image, sensor=camera) for camera in cameras)]
            for sample in sorted(samples, key=lambda each: each.stamp_ns):
                bag.write(sample)
    return path


@pytest.fixture
def two_cameras(seen):
    """The rig with a second camera, a twin of the first."""
    document = seen.rig.model_dump()
    channels = {"frames": {"kind": "frames", "topic": "/cam2/image"}}
    own = {"frame": "cam2_link", "optical_frame": "cam2_optical", "channels": channels}
    document["cameras"]["cam2"] = {**document["cameras"]["cam"], **own}
    return Rig.model_validate(document)


@pytest.mark.long
@pytest.mark.parametrize("name", ["room.bag", "room_mcap"])
def test_a_bag_is_compared_as_a_session_is(room, seen, turned, tmp_path, name, capsys):
    bag = record(tmp_path / name, seen.rig, seen.captures)
    (tmp_path / "rig.yaml").write_text(dump_rig(seen.rig))
    words = ["drift", str(bag), "--rig", str(tmp_path / "rig.yaml"), "--json", "--result"]
    assert run([*words, str(turned)]) == 7
    capsys.readouterr()
    assert run([*words, str(room / "calibration" / "result.json")]) == 0
    (pair,) = json.loads(capsys.readouterr().out)["pairs"]
    assert pair["scene"]["n_captures"] == len(seen.captures)
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted([name, "result.json", "rig.yaml"])


@pytest.mark.long
def test_drift_exit_code_follows_worst_camera(seen, two_cameras, tmp_path, capsys):
    bag = record(tmp_path / "two.bag", two_cameras, seen.captures, ("cam", "cam2"))
    (tmp_path / "rig.yaml").write_text(dump_rig(two_cameras))
    turned = perturb(seen.truth.T_cam_lidar, np.array([0, 0, 0, 0, np.radians(2.0), 0]))
    second = replace(seen.truth, camera="cam2", T_cam_lidar=turned)
    result = result_file(tmp_path / "result.json", seen, seen.truth, second)
    words = ["drift", str(bag), "--rig", str(tmp_path / "rig.yaml"), "--result", str(result), "--json"]
    assert run(words) == 7
    states = {pair["camera"]: pair["state"] for pair in json.loads(capsys.readouterr().out)["pairs"]}
    assert states == {"cam": "unchanged", "cam2": "changed"}


def test_drift_unrecorded_camera_affects_only_itself(seen, two_cameras, tmp_path):
    bag = record(tmp_path / "one.bag", seen.rig, seen.captures)
    result = ResultFile(rig=seen.rig.name, pairs=(seen.truth, replace(seen.truth, camera="cam2")))
    first, second = drift(bag, result, rig=two_cameras).pairs
    assert (first.state, second.state) == ("unchanged", "unknown")
    assert [(each.code, each.subject) for each in second.findings] == [("scene.no_samples", "cam2")]


def test_a_recording_without_the_result_s_camera_is_an_error(seen, two_cameras, tmp_path):
    bag = record(tmp_path / "one.bag", seen.rig, seen.captures[:1])
    result = ResultFile(rig=seen.rig.name, pairs=(replace(seen.truth, camera="cam2"),))
    with pytest.raises(SourceError, match="cam2"):
        drift(bag, result, rig=two_cameras)
    with pytest.raises(SessionError, match="cam3"):
        drift(bag, replace(result, pairs=(replace(seen.truth, camera="cam3"),)), rig=two_cameras)


def test_long_recordings_are_thinned_evenly_while_they_are_read():
    for n in (59, 60, 61, 1000):
        kept = Thinned(60)
        for number in range(n):
            kept.take(number)
        assert 30 <= len(kept) <= 60
        assert set(np.diff(kept)) == {kept[1]} and n - kept[-1] <= kept[1]


@pytest.mark.realtime
@pytest.mark.long
def test_attached_sensors_are_watched(seen, tmp_path, capsys):
    capture = seen.captures[0]
    here = Attached(seen.rig, pixels=capture.images[0].grey, scan=capture.scans[0], has_board=False)
    with attach(here, tmp_path) as rig:
        (tmp_path / "rig.yaml").write_text(dump_rig(rig.model_copy(update={"sync": None})))
        result = result_file(tmp_path / "deployed.json", seen, seen.truth)
        words = ["drift", "--rig", str(tmp_path / "rig.yaml"), "--result", str(result), "--json"]
        code = run([*words, "--seconds", "10"])
    (pair,) = json.loads(capsys.readouterr().out)["pairs"]
    # Repeated views of the room add no information.
    assert code in (0, 6) and pair["state"] != "changed"
    assert pair["scene"]["n_captures"] > 5


@pytest.mark.realtime
@pytest.mark.long
def test_ctrl_c_ends_the_watch_with_a_judgement(seen, tmp_path):
    capture = seen.captures[0]
    here = Attached(seen.rig, pixels=capture.images[0].grey, scan=capture.scans[0], has_board=False)
    with attach(here, tmp_path) as rig:
        (tmp_path / "rig.yaml").write_text(dump_rig(rig.model_copy(update={"sync": None})))
        result = result_file(tmp_path / "deployed.json", seen, seen.truth)
        words = ["drift", "--rig", str(tmp_path / "rig.yaml"), "--result", str(result), "--json"]
        command = [sys.executable, "-m", "lce_rig", *words]
        pipe = subprocess.PIPE
        with subprocess.Popen(command, stdout=pipe, stderr=pipe, text=True) as process:
            for line in process.stderr:
                if "Ctrl-C" in line:
                    break
            time.sleep(8.0)
            process.send_signal(signal.SIGINT)
            said, why = process.communicate(timeout=120)
    assert process.returncode in (0, 6), why
    (pair,) = json.loads(said)["pairs"]
    assert pair["state"] != "changed" and pair["scene"]["n_captures"] > 0


@pytest.mark.long
def test_packets_of_a_lidar_and_a_file_of_a_davis_are_compared(seen, turned, tmp_path):
    """As two recorders leave them: a pcap of the VLP-16, and frames of the camera's own file."""
    starts_ns = [T0_NS + k * PERIOD_NS for k in range(len(seen.captures))]
    scans = [
        replace(capture.scans[0], stamp_ns=t) for capture, t in zip(seen.captures, starts_ns, strict=True)
    ]
    frames = [
        RawFrame((t + PERIOD_NS // 2) // 1000 - 2000, 4000, capture.images[0].grey)
        for capture, t in zip(seen.captures, starts_ns, strict=True)
    ]
    pcap = tmp_path / "lidar.pcap"
    write_datagrams(pcap, map(to_datagram, packets_of(scans)))
    davis = write_davis(tmp_path / "cam.aedat4", [], frames, (640, 360))
    document = seen.rig.model_dump()
    document["cameras"]["cam"]["channels"]["events"] = {"kind": "events", "topic": "/cam/events"}
    rig = Rig.model_validate(document)
    deployed = ResultFile(rig=seen.rig.name, pairs=(seen.truth,))
    for result, state in ((deployed, "unchanged"), (read_result(turned), "changed")):
        (pair,) = drift([pcap, davis], result, rig=rig).pairs
        assert (pair.state, pair.drift.n_captures) == (state, len(scans))


def test_drift_events_of_standing_rig_cannot_tell(seen):
    result = ResultFile(rig=seen.rig.name, pairs=(seen.truth,))
    captures = SceneCaptures(seen.rig, result, "a standing rig")
    rng = np.random.default_rng(0)
    for capture in seen.captures:
        (scan,) = capture.scans
        t_ns = scan.stamp_ns + np.arange(0, PERIOD_NS, 100_000)
        n = len(t_ns)
        x, y = rng.integers(0, 640, n).astype(np.uint16), rng.integers(0, 360, n).astype(np.uint16)
        noise = Events("cam", t_ns, x, y, np.ones(n, dtype=np.bool_), 640, 360)
        cut = EventCut((noise,), int(t_ns[0]), int(t_ns[-1]) + 1, 0, 0)
        captures.take_frame(Frame(scan.stamp_ns, (), (scan,), (cut,)))
    (pair,) = captures.judge().pairs
    assert pair.state == "unknown" and pair.drift.n_captures == len(seen.captures)
    told = [each.subject for each in pair.findings if each.code == "scene.events_of_standing_rig"]
    assert told == ["cam"]


def test_drift_contradictory_arguments_are_refused(room, seen, tmp_path):
    (tmp_path / "rig.yaml").write_text(dump_rig(seen.rig))
    assert run(["drift", str(room), "--seconds", "3"]) == 2
    assert run(["drift", "--rig", str(tmp_path / "rig.yaml")]) == 2
    assert run(["drift", str(tmp_path / "nothing"), "--rig", "rlfs"]) == 4


@pytest.mark.long
def test_drift_board_in_view_is_evaluated(room, turned):
    for result, state in ((None, "unchanged"), (read_result(turned), "changed")):
        (pair,) = drift(room, result).pairs
        assert pair.state == state
        if pair.board is not None:
            yaw, turned_deg = MOTIONS.index("rotation_y"), {"unchanged": 0.0, "changed": -2.0}[state]
            error = pair.board.tangent[yaw] - np.radians(turned_deg)
            assert pair.board.state == state and abs(error) < 3 * np.sqrt(pair.board.cov[yaw, yaw])
    assert pair.board is not None and pair.board.n_boards == 4
