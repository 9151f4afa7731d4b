"""Deployed extrinsics are judged with the lenses that they were estimated with."""

from hashlib import sha256

import numpy as np

from lce_rig.pipeline.verification import profile_behind, with_lenses_of
from lce_rig.rig import dump_rig, load_rig
from tests.saved_results import made_calibration, result_file
from tests.shared import changed

RIG = load_rig("rlfs")


OTHER = changed(RIG, cameras__cam__intrinsics__cx_px=660.0)


def test_other_profile_names_differing_keys():
    """The intrinsics are those of the result."""
    rig, (note,) = with_lenses_of(changed(OTHER, board__square_m=0.071), RIG)
    assert note.code == "verify.other_profile"
    assert str(note.figures["keys"]).split(", ") == ["board.square_m", "cameras.cam.intrinsics.cx_px"]
    assert rig.cameras["cam"].intrinsics == RIG.cameras["cam"].intrinsics
    assert rig.board.square_m == 0.071


def test_the_same_profile_or_none_changes_nothing():
    described = RIG.model_copy(update={"description": "another"})
    assert with_lenses_of(described, RIG) == (described, ())
    assert with_lenses_of(RIG, None) == (RIG, ())


def test_profile_behind_result_is_unchanged(tmp_path):
    """A changed profile is searched among the earlier ones."""
    profile, file = tmp_path / "rig.yaml", tmp_path / "calibration/front/result.json"
    file.parent.mkdir(parents=True)
    profile.write_text(dump_rig(RIG))
    digest = sha256(profile.read_bytes()).hexdigest()
    calibration = made_calibration(np.eye(4), np.eye(6))
    result = result_file("rlfs", [calibration], {"rig.yaml": digest})
    assert profile_behind(file, result) == load_rig(profile)
    earlier = load_rig(profile)
    profile.rename(tmp_path / "rig-1.yaml")
    profile.write_text(dump_rig(OTHER))
    assert profile_behind(file, result) == earlier
    (tmp_path / "rig-1.yaml").unlink()
    assert profile_behind(file, result) is None
