"""`lce-rig rigs` as a user runs it."""

import json
from pathlib import Path

import pytest

from lce_rig.cli.main import run
from lce_rig.rig import find_profile, load_rig
from tests.shared import files_up_to


def test_rigs_without_argument_lists_profiles(capsys):
    assert run(["rigs"]) == 0
    out = capsys.readouterr().out
    assert all(name in out for name in ("rlfs", "rles", "sss", "DAVIS346"))
    assert run(["rigs", "list"]) == 0
    assert capsys.readouterr().out == out


def test_rigs_show_omits_defaults(capsys, tmp_path):
    path = tmp_path / "mine.yaml"
    path.write_text(f"{find_profile('rles').read_text(encoding='utf-8')}\nquality: {{min_rings: 7}}\n")
    assert run(["rigs", "show", str(path)]) == 0
    out = capsys.readouterr().out
    assert "  min_rings: 7\n" in out and "min_points" not in out and "model: VLP-16" in out
    assert run(["rigs", "show", str(path), "--all"]) == 0
    assert "min_points" in capsys.readouterr().out


@pytest.mark.parametrize("more", [[], ["--all"]])
def test_show_prints_a_profile_that_loads_again(capsys, tmp_path, more):
    path = tmp_path / "copy.yaml"
    assert run(["rigs", "show", "rlfs", *more]) == 0
    path.write_text(capsys.readouterr().out, encoding="utf-8")
    assert load_rig(path) == load_rig("rlfs")
    assert run(["rigs", "show", str(path), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["board"]["square_m"] == 0.07


def test_rigs_check_exit_code_follows_problems(capsys, tmp_path):
    path = tmp_path / "mine.yaml"
    assert run(["rigs", "new", "mine", "--from", "sss", "-o", str(path)]) == 0
    assert run(["rigs", "check", str(path)]) == 0
    assert str(path) in capsys.readouterr().out
    path.write_text(path.read_text(encoding="utf-8").replace("fx_px", "fx_pix"), encoding="utf-8")
    assert run(["rigs", "check", str(path)]) == 3
    said = capsys.readouterr().err
    assert "cameras.cam.intrinsics.fx_pix:" in said and "fx_px" in said
    turned = tmp_path / "turned.yaml"
    words = ["--from", "sss", "--set", "board.inner_corners=[6, 8]", "-o", str(turned)]
    assert run(["rigs", "new", "mine", *words]) == 0
    assert run(["rigs", "check", str(turned)]) == 0
    assert [finding.code for finding in load_rig(turned).warnings()] == ["profile.swapped_sides"]


def test_rigs_new_never_overwrites_profile(capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert run(["rigs", "new", "mine", "--from", "rlfs", "--set", "board.square_m=0.065"]) == 0
    assert load_rig("mine.yaml").board.square_m == 0.065
    before = Path("mine.yaml").read_bytes()
    assert run(["rigs", "new", "mine"]) == 3
    assert "exists already" in capsys.readouterr().err
    assert Path("mine.yaml").read_bytes() == before


def test_a_full_disk_leaves_no_part_of_a_profile(capsys, tmp_path):
    path = tmp_path / "mine.yaml"
    with files_up_to(100):
        assert run(["rigs", "new", "mine", "-o", str(path)]) == 3
    assert str(path) in capsys.readouterr().err
    assert not path.exists()
    assert run(["rigs", "new", "mine", "-o", str(path)]) == 0


def test_rigs_new_creates_profile_in_one_command(capsys, tmp_path):
    path = tmp_path / "os1.yaml"
    lens = "equidistant,1920x1208,959.554,960.194,940.789,670.737,-0.097824,0.141429,-0.148385,0.055918"
    words = ["rigs", "new", "os1", "--lidar", "OS1-64", "--intrinsics", lens, "-o", str(path)]
    assert run(words) == 2  # without the board
    assert not path.exists()
    assert run([*words, "--board", "5x7,0.095,0.61x0.85", "--set", "lidars.lidar.rate_hz=20"]) == 0
    assert run(["rigs", "check", str(path)]) == 0
    rig = load_rig(path)
    assert (rig.lidars["lidar"].model, rig.lidars["lidar"].rate_hz) == ("OS1-64", 20)


@pytest.mark.parametrize(
    ("words", "code"),
    [
        (["mine", "--set", "board.square_m=70"], 3),
        (["mine", "--set", "board.square_m"], 2),
        (["mine", "--from", "rlsf"], 3),
        (["mine", "--from", "missing.yaml"], 3),
        (["x.yaml"], 2),
        (["x", "--from", "there/is/none.bag", "--board", "8x6,0.07,0.767x0.626"], 5),
        (["x", "--from", __file__, "--board", "8x6,0.07,0.767x0.626"], 5),
        (["x", "--from", str(Path(__file__).parent), "--board", "8x6,0.07,0.767x0.626"], 5),
        (["x", "--lidar", "OS1-64", "--board", "8x6,0.07,0.767x0.626"], 2),
        (["x", "--from", "rlfs", "--lidar", "OS1-64"], 2),
        (["x", "--intrinsics", "radtan,64x48,50,50,32,24", "--board", "8x6,0.07,0.767x0.626,2,0"], 3),
        (["x", "--intrinsics", "pinhole,64x48,50,50,32,24", "--board", "8x6,0.07,0.767x0.626"], 2),
    ],
)
def test_a_profile_that_cannot_be_written_leaves_no_file(words, code, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert run(["rigs", "new", *words]) == code
    assert not list(tmp_path.iterdir())


def test_derived_profile_drops_emptied_block(tmp_path):
    path = tmp_path / "mine.yaml"
    emptied = ["--set", "nominal_extrinsics=[]", "--set", "cameras.cam.driver={}"]
    assert run(["rigs", "new", "mine", *emptied, "-o", str(path)]) == 0
    rig = load_rig(path)
    assert not rig.nominal_extrinsics and rig.cameras["cam"].driver.type is None
    assert rig.description == "" and "RLFS" not in path.read_text()
