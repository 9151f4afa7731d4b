"""The examples in docs/examples work on a simulated rig."""

import json
import runpy
import shutil
from pathlib import Path

import numpy as np
import pytest

import lce_rig as lce
from lce_rig.cli.main import run

EXAMPLES = Path(__file__).parents[2] / "docs" / "examples"


@pytest.fixture(scope="module")
def simulated(tmp_path_factory):
    """Two independent sessions of one simulated rig, seven captures each."""
    folder = tmp_path_factory.mktemp("simulated")
    assert run(["simulate", "--rig", "rles", str(folder / "monday"), "--captures", "14", "--seed", "3"]) == 0
    lce.detect_boards(lce.Session.open(folder / "monday"))
    shutil.copytree(folder / "monday", folder / "friday")
    for capture in lce.Session.open(folder / "monday").captures:
        shutil.rmtree(folder / ("monday" if int(capture.name) % 2 else "friday") / "captures" / capture.name)
    return folder


@pytest.fixture
def workplace(simulated, tmp_path, monkeypatch):
    """A folder of its own with copies of both sessions, which is the current one."""
    for name in ("monday", "friday"):
        shutil.copytree(simulated / name, tmp_path / name)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def main_of(script):
    return runpy.run_path(str(EXAMPLES / script))["main"]


def error_to_truth(calibration, session):
    truth = np.array(json.loads((session / "truth.json").read_text())["T_cam_lidar"])
    return float(np.linalg.norm(calibration.T_cam_lidar[:3, 3] - truth[:3, 3]))


def test_every_example_is_run_here():
    assert {path.name for path in EXAMPLES.iterdir() if path.is_file()} == {
        "calibrate_folder.py",
        "compare_sessions.py",
        "own_lidar.py",
        "session.ipynb",
    }


@pytest.mark.long
def test_example_folder_gives_a_result(workplace):
    for capture in lce.Session.open("monday").captures:
        for kind, name in (("img", "davis.frames.png"), ("pcd", "lidar.pcd")):
            (workplace / "folder" / kind).mkdir(parents=True, exist_ok=True)
            target = workplace / "folder" / kind / f"{capture.name}{Path(name).suffix}"
            shutil.copy(capture.path / name, target)
    main_of("calibrate_folder.py")("rles", "folder", "session")
    saved = lce.read_result("session/calibration/result.json")
    assert error_to_truth(saved.pairs[0], workplace / "monday") < 0.05
    assert (workplace / "session" / "calibration" / "overlays" / "index.html").exists()


@pytest.mark.long
def test_two_sessions_are_compared_by_their_figures(workplace, capsys):
    for name in ("monday", "friday"):
        lce.calibrate_session(name).write(report=False)
    main_of("compare_sessions.py")("monday", "friday")
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].endswith("lidar: agree") and "davis" in lines[0]
    assert sum(" mm, edges " in line for line in lines) == 7


@pytest.mark.long
def test_example_own_reader_gives_extrinsics(workplace, capsys):
    session = lce.Session.open("monday")
    (workplace / "folder").mkdir()
    for capture in session.captures:
        scan = capture.scan("lidar")
        elevation_deg = np.repeat(-15.0 + 2 * np.arange(16), np.bincount(scan.ring, minlength=16))
        order = np.argsort(scan.ring, kind="stable")
        columns = scan.points[order], scan.intensity[order], elevation_deg
        np.save(workplace / "folder" / f"{capture.name}.npy", np.column_stack(columns).astype(np.float64))
        shutil.copy(capture.path / "davis.frames.png", workplace / "folder" / f"{capture.name}.png")
    for _ in range(2):
        main_of("own_lidar.py")("rles", "folder", "own")
    own = lce.Session.open("own")
    assert len(own.captures) == 7
    assert error_to_truth(lce.calibrate_session(own).pairs[0], workplace / "monday") < 0.05


@pytest.mark.long
def test_the_notebook_runs_from_top_to_bottom(workplace):
    notebook = json.loads((EXAMPLES / "session.ipynb").read_text())
    cells = [cell for cell in notebook["cells"] if cell["cell_type"] == "code"]
    assert not any(cell["outputs"] for cell in cells)
    (workplace / "monday").rename("session")
    names = {"__name__": "__main__"}
    for cell in cells:
        exec(compile("".join(cell["source"]), cell["id"], "exec"), names)
    assert (workplace / "session" / "calibration" / "result.json").exists()
    page = names["checks"][0].page
    assert page.exists() and page.parent.parent.name == "calibration"
