"""The shipped profiles compared with the figures supplied with the recordings."""

import json

import numpy as np
import pytest

from lce_rig.rig import derive_text, find_profile, load_rig, parse_rig

NEW_FOCUS = {
    "fx_px": "305.5716",
    "fy_px": "305.6182",
    "cx_px": "175.2111",
    "cy_px": "125.4881",
    "distortion": "[-0.3879, 0.2354, 0.00087038, -0.00075971, -0.1027]",
}


def profile(name):
    if name != "rles02":
        return load_rig(name)
    settings = [(f"cameras.davis.intrinsics.{key}", value) for key, value in NEW_FOCUS.items()]
    return parse_rig(
        derive_text(find_profile("rles").read_text(encoding="utf-8"), name, settings, name, "rles")
    )


@pytest.mark.dataset
@pytest.mark.parametrize(
    ("recording", "name"),
    [
        ("rlfs01", "rlfs"),
        ("rles01_lf", "rles"),
        ("rles01_le", "rles"),
        ("rles02_lf", "rles02"),
        ("rles02_le", "rles02"),
        ("sss_noise15mm", "sss"),
    ],
)
def test_a_profile_has_the_recordings_numbers(recordings, recording, name):
    given = json.loads((recordings / recording / "params.json").read_text(encoding="utf-8"))
    rig = profile(name)
    (camera,) = rig.cameras.values()
    intrinsics = camera.to_intrinsics()
    K = np.array(given["K"])
    if name == "sss":
        K[:2, 2] -= 1  # counted from one there
    np.testing.assert_allclose(intrinsics.matrix, K)
    coefficients = np.zeros(5)
    coefficients[: len(intrinsics.distortion)] = intrinsics.distortion
    np.testing.assert_allclose(coefficients, given["D"])
    assert list(camera.resolution_px) == given["image_size"]
    board = given["board"]
    assert list(rig.board.inner_corners) == board["inner_corners"]
    sizes = rig.board.square_m, rig.board.width_m, rig.board.height_m
    assert sizes == (board["square_m"], board["width_m"], board["height_m"])
