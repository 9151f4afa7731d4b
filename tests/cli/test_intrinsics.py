"""lce-rig intrinsics, as a user types it, on the simulated session of the verbs."""

import json

import pytest

from lce_rig.rig import load_rig


@pytest.fixture(scope="module")
def few(simulated, tmp_path_factory):
    """The first six captures of the simulated session."""
    import shutil

    copy = tmp_path_factory.mktemp("few") / "session"
    shutil.copytree(simulated, copy)
    for k in range(6, 16):
        shutil.rmtree(copy / "captures" / f"{k:06d}")
    return copy


@pytest.mark.long
def test_intrinsics_force_saves_the_lens(lce_rig, few, tmp_path):
    refused = lce_rig("intrinsics", few, "--save-profile", tmp_path / "new.yaml")
    assert refused.code == 7
    assert not (tmp_path / "new.yaml").exists()
    outcome = lce_rig("intrinsics", few, "--save-profile", tmp_path / "new.yaml", "--force")
    assert outcome.code == 0, outcome.err
    assert "radtan5" in outcome.out and len(outcome.out.splitlines()) <= 8
    assert "fx_px: 349.57" in lce_rig("intrinsics", few, "--explain").out
    assert "camera_info_davis.yaml" in outcome.err
    (camera,) = json.loads(lce_rig("intrinsics", few, "--json").out)["cameras"]
    assert len(camera["views_used"]) == 6 and not camera["views_refused"]
    assert camera["profile"]["verdict"] != "fail"
    measured = camera["intrinsics"]["fx_px"]
    assert measured == pytest.approx(349.57, abs=6)
    assert load_rig(tmp_path / "new.yaml").cameras["davis"].intrinsics.fx_px == measured
    assert load_rig(few / "rig.yaml").cameras["davis"].intrinsics.fx_px == 349.57
    assert lce_rig("intrinsics", few, "--save-profile", tmp_path / "new.yaml").code == 2, "it exists"


def test_intrinsics_json_names_a_stale_lens(lce_rig, few):
    profile = few / "rig.yaml"
    right = profile.read_text()
    profile.write_text(
        right.replace("fx_px: 349.57", "fx_px: 363.5").replace("fy_px: 349.18", "fy_px: 363.1")
    )
    try:
        outcome = lce_rig("intrinsics", few, "--json")
    finally:
        profile.write_text(right)
    assert outcome.code == 0, outcome.err
    camera = json.loads(outcome.out)["cameras"][0]
    assert camera["judgement"]["code"] in ("intrinsics.better", "intrinsics.undetermined")
    profile_record = camera["profile"]
    assert profile_record["verdict"] in ("marginal", "fail")
    assert profile_record["displacement_px"] > 1.0


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (["--camera", "thermal"], "the rig has no camera 'thermal'"),
        (["--channels", "frames,colour"], "has no channel 'colour'"),
        (["--model", "brown"], "'brown' is not one of"),
    ],
)
def test_intrinsics_unknown_name_is_usage_error(lce_rig, few, words, says):
    outcome = lce_rig("intrinsics", few, *words)
    assert outcome.code == 2
    assert says in outcome.err


def test_too_few_captures_exit_with_6(lce_rig, session):
    import shutil

    for k in range(3, 16):
        shutil.rmtree(session / "captures" / f"{k:06d}")
    outcome = lce_rig("intrinsics", session)
    assert outcome.code == 6
    assert "3 of 3 captures" in outcome.err


@pytest.mark.long
def test_lidar_intrinsics_saved_or_refused(lce_rig, simulated, few, tmp_path):
    refused = lce_rig("lidar-intrinsics", few)
    assert refused.code == 6
    new = tmp_path / "new.yaml"
    outcome = lce_rig("lidar-intrinsics", simulated, "--json", "--save-profile", new)
    assert outcome.code == 0, outcome.err
    document = json.loads(outcome.out)
    lasers = load_rig(new).lidars["lidar"].intrinsics.lasers
    assert [laser.ring for laser in lasers] == [row["ring"] for row in document["lasers"]]
    for laser, row in zip(lasers, document["lasers"], strict=True):
        assert laser.range_m == pytest.approx(row["range_m"], abs=1e-5)
        assert laser.range_sigma_m == pytest.approx(row["range_sigma_m"], abs=1e-5)
    again = lce_rig("lidar-intrinsics", simulated, "--save-profile", new)
    assert again.code == 2
