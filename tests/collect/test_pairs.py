"""Folders of pairs become captures, each once; a faulty pair does not affect others."""

import os
import signal
import subprocess
import sys
import time
from dataclasses import replace

import cv2
import numpy as np
import pytest

from lce_rig.collect.offline import collect
from lce_rig.core.errors import SourceError
from lce_rig.core.pcd import encode_pcd
from lce_rig.detect.finder import BoardFinder, check_origin
from lce_rig.io import open_recording
from lce_rig.rig import load_rig
from lce_rig.session import Session

N_PAIRS = 5


@pytest.fixture
def folder(tmp_path):
    """Pictures and clouds of noise in rings."""
    return write_pairs(tmp_path / "recording")


def write_pairs(path, height_m=0.0):
    """Write pairs whose points lie in a frame below the LiDAR."""
    (path / "img").mkdir(parents=True)
    (path / "pcd").mkdir()
    rng = np.random.default_rng(0)
    for k in range(N_PAIRS):
        pixels = rng.integers(0, 256, (260, 346), dtype=np.uint8)
        cv2.imwrite(str(path / "img" / f"{k:05d}.png"), pixels)
        cloud = np.zeros(
            4000, dtype=[("x", "f4"), ("y", "f4"), ("z", "f4"), ("intensity", "f4"), ("ring", "u2")]
        )
        cloud["x"], cloud["y"] = rng.normal(4, 1, 4000), rng.normal(0, 1, 4000)
        cloud["ring"] = np.arange(4000) % 16
        cloud["z"] = np.hypot(cloud["x"], cloud["y"]) * np.tan(np.radians(cloud["ring"] * 2.0 - 15))
        cloud["z"] += height_m
        (path / "pcd" / f"{k:05d}.pcd").write_bytes(encode_pcd(cloud))
    return path


def run(session, folder, rig, **options):
    return collect(session, [open_recording(folder, rig)], **options)


def test_collect_pairs_second_run_adds_none(tmp_path, folder, rig):
    with Session.create(tmp_path / "s", rig) as session:
        report = run(session, folder, rig)
    assert report.captured == [f"{k:06d}" for k in range(N_PAIRS)]
    assert any(note.startswith("recording: 5 pairs") and "names" in note for note in report.notes)
    assert any("without times" in note for note in report.notes)
    with Session.resume(tmp_path / "s", rig) as session:
        again = run(session, folder, rig)
    assert (again.captured, again.n_known) == ([], N_PAIRS)
    assert [e["event"] for e in session.read_journal()][-1] == "collected"


def test_collect_pairs_keeps_plain_png_files(tmp_path, folder, rig):
    pictures = sorted((folder / "img").iterdir())
    grey = cv2.imread(str(pictures[0]), cv2.IMREAD_GRAYSCALE)
    transparent = cv2.merge([grey, grey, grey, grey])
    for path, pixels in zip(pictures[1:], (transparent, grey.astype(np.uint16) * 16), strict=False):
        cv2.imwrite(str(path), pixels)
    read = [pair.read()[0][0].pixels for pair in open_recording(folder, rig).pairs]
    with Session.create(tmp_path / "s", rig) as session:
        run(session, folder, rig)
    for k, (path, capture) in enumerate(zip(pictures, session.captures, strict=True)):
        (stored,) = capture.path.glob("*.png")
        assert (stored.read_bytes() == path.read_bytes()) == (k not in (1, 2))
        assert np.array_equal(capture.image(*capture.image_keys[0]).pixels, read[k])


def test_a_rejected_pair_is_not_collected_again(tmp_path, folder, rig):
    with Session.create(tmp_path / "s", rig) as session:
        run(session, folder, rig)
        session.reject("000003")
        again = run(session, folder, rig)
        assert (again.captured, again.n_known) == ([], N_PAIRS)
        # Nor under another name.
        (folder / "img" / "00003.png").rename(folder / "img" / "00009.png")
        (folder / "pcd" / "00003.pcd").rename(folder / "pcd" / "00009.pcd")
        renamed = run(session, folder, rig)
    assert (renamed.captured, renamed.n_known) == ([], N_PAIRS)


def test_the_same_data_in_another_file_is_a_duplicate(tmp_path, folder, rig):
    pixels = cv2.imread(str(folder / "img" / "00003.png"), cv2.IMREAD_UNCHANGED)
    cv2.imwrite(str(folder / "img" / "00007.bmp"), pixels)
    (folder / "pcd" / "00007.pcd").write_bytes((folder / "pcd" / "00003.pcd").read_bytes())
    with Session.create(tmp_path / "s", rig) as session:
        report = run(session, folder, rig)
    assert (report.n_known, len(report.captured)) == (1, N_PAIRS)


def test_collect_damaged_pairs_are_refused(tmp_path, folder, rig):
    os.truncate(folder / "img" / "00001.png", 5000)
    os.truncate(folder / "pcd" / "00002.pcd", 5000)
    with Session.create(tmp_path / "s", rig) as session:
        report = run(session, folder, rig)
    assert len(report.captured) == N_PAIRS - 2 and not report.errors
    for torn, refusal in zip(("00001.png", "00002.pcd"), report.refused.values(), strict=True):
        assert torn in refusal.figures["what"]
    assert {refusal.stage for refusal in report.refused.values()} == {"read"}


def test_collect_unreadable_folder_is_error(tmp_path, folder, rig):
    for path in (folder / "pcd").iterdir():
        os.truncate(path, 0)
    with Session.create(tmp_path / "s", rig) as session, pytest.raises(SourceError, match=r"pcd/00000\.pcd"):
        run(session, folder, rig)


def test_collect_limit_is_kept_and_skipped_are_counted(tmp_path, folder, rig):
    with Session.create(tmp_path / "s", rig) as session:
        report = run(session, folder, rig, n_wanted=2)
        assert len(session.captures) == 2 and report.n_missing == 0
        assert any(note.startswith("3 pairs") and "2 captures" in note for note in report.notes)
        assert len(run(session, folder, rig, n_wanted=4).captured) == 2
        assert len(run(session, folder, rig).captured) == 1


COLLECTOR = """
import sys
from lce_rig.collect.offline import collect
from lce_rig.rig import load_rig
from lce_rig.session import Session
from lce_rig.io import open_recording
rig = load_rig("rlfs")
with Session.resume(sys.argv[1], rig) as session:
    recording = open_recording(sys.argv[2], rig)
    print("ready", flush=True)
    collect(session, [recording])
"""


def test_collect_killed_runs_lose_no_capture(tmp_path, folder):
    rig = load_rig("rlfs")
    with Session.create(tmp_path / "whole", rig) as whole:
        run(whole, folder, rig)
    path = tmp_path / "killed"
    n_before = []
    for k in range(3):
        command = [sys.executable, "-c", COLLECTOR, str(path), str(folder)]
        process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
        assert process.stdout is not None and process.stdout.readline() == "ready\n"
        time.sleep(0.01 + 0.015 * k)
        process.send_signal(signal.SIGKILL)
        process.communicate()
        n_before.append(len(Session.open(path).captures))
    with Session.resume(path, rig) as session:
        run(session, folder, rig)
    contents = [sorted(c.content_sha256 for c in s.captures) for s in (whole, session)]
    assert contents[0] == contents[1] and n_before == sorted(n_before)


@pytest.mark.long
@pytest.mark.dataset
def test_foreign_recording_becomes_a_session(tmp_path, recordings):
    rig = load_rig("rlfs")
    with Session.create(tmp_path / "s", rig) as session:
        report = run(session, recordings / "rlfs01", rig)
    assert len(report.captured) == 18 and not report.refused
    assert any("ring field" in note and "elevation" in note for note in report.notes)
    assert Session.open(tmp_path / "s").captures[17].scan("lidar").ring.max() == 15


@pytest.mark.parametrize("height_m", [0.2, 0.7])
def test_pairs_in_the_robots_frame_are_refused(tmp_path, rig, height_m):
    folder = write_pairs(tmp_path / "moved", height_m)
    with Session.create(tmp_path / "s", rig) as session:
        with pytest.raises(SourceError, match=rf"00000.*{height_m:.2f}\) m.*not at the origin") as caught:
            run(session, folder, rig)
        assert session.captures == []
    assert "the LiDAR's own frame" in caught.value.hint


def test_check_origin_refuses_the_robots_frame(tmp_path, rig):
    folder = write_pairs(tmp_path / "moved", 0.2)
    scan = open_recording(folder, rig).pairs[0].read()[1][0]
    assert BoardFinder(rig).scan(scan).code == "lidar.other_origin"
    assert check_origin(replace(scan, points=scan.points - np.float32([0, 0, 0.2]))) is None
