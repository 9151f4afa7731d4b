"""Another lens model is named where corners do not fit the profile's, and none where they do."""

from dataclasses import replace

import pytest

from lce_rig.judge.intrinsics_check import corner_noise, model_findings
from lce_rig.lens.calibrate_lens import estimate_intrinsics
from lce_rig.lens.models import MODELS
from tests.lens.lens_views import BOARD, FISHEYE, WIDE, Scene, photograph

NEAR = Scene(distance_m=(0.6, 1.5), sigma_px=0.05)


@pytest.mark.parametrize(
    ("lens", "model", "other"),
    [
        (FISHEYE, "equidistant", None),
        (FISHEYE, "radtan4", "equidistant"),
        (WIDE, "radtan5", None),
    ],
)
def test_a_lens_model_that_does_not_fit_is_named_with_the_one_that_does(lens, model, other):
    views = photograph(10, 4, replace(NEAR, lens=lens))
    start = lens if lens.model == MODELS[model].family else replace(lens, model="radtan", distortion=())
    found = model_findings(estimate_intrinsics(views, BOARD, start, MODELS[model], n_folds=0), BOARD)
    assert [finding.code for finding in found] == ([] if other is None else ["verdict.lens_model"])
    for finding in found:
        assert finding.figures["other"] == other
        assert finding.figure("other_px") < 0.1 < finding.figure("rms_px")


def test_the_noise_of_corners_is_measured_without_a_lens_on_a_bent_board():
    views = photograph(10, 4, Scene(bow_m=(0.004, 0.002)))
    # Two coordinates of 0.05 px each.
    assert corner_noise(views, BOARD).mean() == pytest.approx(0.07, rel=0.2)
