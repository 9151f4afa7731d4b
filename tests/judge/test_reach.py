"""Point uncertainties from a covariance equal those from sampled extrinsics."""

from dataclasses import replace

import numpy as np
import pytest

from lce_rig.core.camera import Intrinsics
from lce_rig.core.geometry import invert, perturb, transform
from lce_rig.judge.reach import DISTANCES_M, point_uncertainties
from tests.calibrate.boards import CAMERA, T_FORWARD

FISHEYE = Intrinsics(400.0, 400.0, 639.5, 359.5, 1280, 720, "equidistant", (0.02, -0.01, 0.002, 0.0))
NARROW = replace(CAMERA, distortion=())


def covariance(rng):
    A = rng.standard_normal((6, 6)) * np.r_[[0.003] * 3, [0.0005] * 3][:, None]
    return A @ A.T


@pytest.mark.parametrize("lens", [NARROW, FISHEYE])
def test_point_uncertainty_matches_samples(lens):
    rng = np.random.default_rng(0)
    cov = covariance(rng)
    found = point_uncertainties(T_FORWARD, cov, lens)
    T_drawn = perturb(T_FORWARD, rng.multivariate_normal(np.zeros(6), cov, size=20_000))
    w, h = lens.width_px - 1, lens.height_px - 1
    pixels = np.array([[w / 2, h / 2], [0, 0], [w, 0], [0, h], [w, h]])
    for uncertainty, distance_m in zip(found, DISTANCES_M, strict=True):
        points_cam = distance_m * lens.unproject(pixels)
        drawn = transform(T_drawn, transform(invert(T_FORWARD), points_cam))
        drawn_px, is_valid = lens.project(drawn)
        off_m = np.sqrt(np.mean(np.sum((drawn - points_cam) ** 2, axis=-1), axis=0))
        # A corner's point may be drawn beyond the lens.
        off_px = np.sqrt(np.nanmean(np.sum((drawn_px - pixels) ** 2, axis=-1), axis=0))
        assert is_valid.mean() > 0.99
        assert uncertainty.centre_m == pytest.approx(off_m[0], rel=0.03)
        assert uncertainty.centre_px == pytest.approx(off_px[0], rel=0.03)
        assert uncertainty.corner_m == pytest.approx(off_m[1:].max(), rel=0.03)
        assert uncertainty.corner_px == pytest.approx(off_px[1:].max(), rel=0.03)


def test_point_uncertainty_ends_with_lens():
    folding = replace(CAMERA, distortion=(-0.6, 0.0, 0.0, 0.0, 0.0))
    assert np.isnan(folding.unproject(np.array([0.0, 0.0]))).any()
    found = point_uncertainties(T_FORWARD, covariance(np.random.default_rng(1)), folding)
    assert all(np.isfinite(each.corner_px) and np.isfinite(each.corner_m) for each in found)
