"""lce-rig drift on a simulated session, as a user types it."""

import json
import shutil
from dataclasses import replace

import cv2
import numpy as np
import pytest

from lce_rig.cli.main import run
from lce_rig.core.geometry import perturb
from lce_rig.export.result import write_result
from lce_rig.pipeline.drift import drift
from lce_rig.rig import dump_rig
from lce_rig.session import Session


@pytest.fixture
def turned(seen, tmp_path):
    """A result whose extrinsics are turned by 2 deg about the camera's y axis."""
    T = perturb(seen.truth.T_cam_lidar, np.array([0, 0, 0, 0, np.radians(2.0), 0]))
    write_result(tmp_path / "result.json", seen.rig.name, [replace(seen.truth, T_cam_lidar=T)])
    return tmp_path / "result.json"


def test_unchanged_exits_with_0_and_draws(room, tmp_path, capsys) -> None:
    assert run(["drift", str(room), "-o", str(tmp_path), "--json"]) == 0
    (pair,) = json.loads(capsys.readouterr().out)["pairs"]
    assert pair["state"] == "unchanged" and len(pair["axes"]) == 6
    assert cv2.imread(str(tmp_path / "drift_cam_lidar.png")).shape[1] == 1600


def test_changed_exits_with_7_and_names_the_axis(room, turned, capsys) -> None:
    assert run(["drift", str(room), "--result", str(turned)]) == 7
    captured = capsys.readouterr()
    assert "rotation about the camera's y axis" in captured.err
    assert "changed" in captured.out


def test_a_folder_is_compared_as_a_session_is(room, seen, turned, tmp_path) -> None:
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


def test_even_images_exit_with_6(room, tmp_path, seen) -> None:
    path = tmp_path / "even"
    with Session.create(path, seen.rig) as session:
        for capture in seen.captures:
            (image,) = capture.images
            even = replace(image, pixels=np.full_like(image.pixels, capture.index))
            session.add_capture([even], capture.scans, {})
    assert run(["drift", str(path), "--result", str(room / "calibration" / "result.json")]) == 6


def test_a_result_of_another_rig_is_refused(room, seen, tmp_path) -> None:
    write_result(tmp_path / "result.json", "another", [seen.truth])
    assert run(["drift", str(room), "--result", str(tmp_path / "result.json")]) == 4


def test_a_damaged_capture_is_skipped(room, tmp_path) -> None:
    shutil.copytree(room, tmp_path / "room")
    (tmp_path / "room" / "captures" / "000001" / "lidar.pcd").write_bytes(b"")
    (pair,) = drift(tmp_path / "room").pairs
    assert pair.drift.n_captures == 3
