"""Folders of images of a rig with two cameras: the camera must be named, and is never guessed."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from lce_rig.core.pcd import encode_pcd

TWO = Path(__file__).parents[1] / "rigs" / "two_cameras.yaml"


@pytest.fixture
def folders(tmp_path):
    """Two folders of one picture and one cloud each, of the same cloud."""
    cloud = np.zeros(16, [(name, "f4") for name in ("x", "y", "z", "intensity")] + [("ring", "u2")])
    cloud["x"], cloud["ring"] = 3, np.arange(16)
    paths = [tmp_path / "a", tmp_path / "b"]
    for k, path in enumerate(paths):
        for name in ("img", "pcd"):
            (path / name).mkdir(parents=True)
        cv2.imwrite(str(path / "img" / "0.png"), np.full((720, 1280), 100 + k, np.uint8))
        (path / "pcd" / "0.pcd").write_bytes(encode_pcd(cloud))
    return paths


def cameras_held(session):
    """Camera and brightness of the pictures of every capture."""
    held = []
    for capture in sorted((session / "captures").iterdir()):
        for entry in json.loads((capture / "meta.json").read_text())["files"]:
            if entry["kind"] == "image":
                held.append((entry["camera"], int(cv2.imread(str(capture / entry["file"])).max())))
    return held


def test_folders_are_assigned_to_named_cameras(lce_rig, folders, tmp_path):
    words = [
        w
        for p, camera in zip(folders, ("left", "right"), strict=True)
        for w in ("--from", p, "--camera", camera)
    ]
    outcome = lce_rig("collect", "--rig", TWO, tmp_path / "session", *words)
    assert outcome.code == 0, outcome.err
    assert cameras_held(tmp_path / "session") == [("left", 100), ("right", 101)]


def test_single_camera_name_applies_to_all_folders(lce_rig, folders, tmp_path):
    words = [w for p in folders for w in ("--from", p)]
    assert lce_rig("collect", "--rig", TWO, tmp_path / "session", *words, "--camera", "right").code == 0
    assert cameras_held(tmp_path / "session") == [("right", 100), ("right", 101)]


@pytest.mark.parametrize(
    ("words", "code", "told"),
    [
        ([], 5, "camera is not known"),
        (["--camera", "left", "--camera", "right"], 2, "--camera is given 2 times for 1 recording"),
        (["--camera", "left,right"], 2, "the rig has no camera 'left,right'"),
        (["--lidar", "top"], 2, "the rig has no lidar 'top'"),
    ],
)
def test_collect_unclear_folder_is_refused(lce_rig, folders, tmp_path, words, code, told):
    outcome = lce_rig("collect", "--rig", TWO, tmp_path / "session", "--from", folders[0], *words)
    assert outcome.code == code
    assert told in outcome.err
    assert not (tmp_path / "session").exists()


def test_a_session_continues_with_its_own_profile(lce_rig, folders, tmp_path):
    session = tmp_path / "session"
    first = ["--from", folders[0], "--camera", "left"]
    assert lce_rig("collect", *first, session).code == 2, "a new session needs a rig"
    assert lce_rig("collect", "--rig", TWO, *first, session).code == 0
    assert lce_rig("collect", session, "--from", folders[1], "--camera", "right").code == 0
    assert cameras_held(session) == [("left", 100), ("right", 101)]


@pytest.mark.parametrize(
    ("images", "clouds"),
    [
        ("img/0.png", "velodyne/0.PCD"),
        ("Images/0.PNG", "lidar/0.pcd"),
        ("image_raw/0.png", "scans/0.pcd"),
        ("img/1635412345.120.png", "pcd/1635412345.123.pcd"),
        ("0.png", "0.pcd"),
    ],
)
def test_rigs_new_and_collect_read_same_folders(lce_rig, folders, tmp_path, images, clouds):
    folder, source = tmp_path / "data", folders[0]
    for name, file in ((images, "img/0.png"), (clouds, "pcd/0.pcd")):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes((source / file).read_bytes())
    rig, board = tmp_path / "mine.yaml", "8x6,0.07,0.767x0.626"
    words = ["rigs", "new", "mine", "-o", rig, "--lidar", "VLP-16", "--from", folder, "--board", board]
    missing = lce_rig(*words)
    assert missing.code == 2 and "radtan,1280x720,1024,1024,640,360,0,0,0,0" in missing.err
    made = lce_rig(*words, "--intrinsics", "radtan,1280x720,1024,1024,640,360,0,0,0,0")
    assert made.code == 0, made.err
    collected = lce_rig("collect", "--rig", rig, tmp_path / "session", "--from", folder)
    assert collected.code == 0, collected.err
    assert cameras_held(tmp_path / "session") == [("cam", 100)]
