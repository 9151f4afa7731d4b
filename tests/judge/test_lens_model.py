"""Another lens model is named where corners do not fit the profile's, and none where they do."""

from dataclasses import replace

import numpy as np
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
def test_unfit_lens_model_names_a_better_one(lens, model, other):
    views = photograph(10, 4, replace(NEAR, lens=lens))
    start = lens if lens.model == MODELS[model].family else replace(lens, model="radtan", distortion=())
    found = model_findings(estimate_intrinsics(views, BOARD, start, MODELS[model], n_folds=0), BOARD)
    assert [finding.code for finding in found] == ([] if other is None else ["verdict.lens_model"])
    for finding in found:
        assert finding.figures["other"] == other
        assert finding.figure("other_px") < 0.1 < finding.figure("rms_px")


def test_corner_noise_on_bent_board_is_right():
    views = photograph(10, 4, Scene(bow_m=(0.004, 0.002)))
    # Two coordinates of 0.05 px each.
    assert corner_noise(views, BOARD).mean() == pytest.approx(0.07, rel=0.2)


def test_model_findings_rows_in_turn_are_named():
    """Boards move by a pixel in 100 rows while a rolling shutter reads the image."""
    rng = np.random.default_rng(0)
    views = []
    for view in photograph(12, 4, replace(NEAR, distance_m=(1.5, 3.0), sigma_px=0.02)):
        corners_px = view.board.corners_px.copy()
        direction = rng.standard_normal(2)
        speed = 0.01 * direction / np.linalg.norm(direction)
        corners_px += speed * (corners_px[:, 1:] - corners_px[:, 1:].mean())
        views.append(replace(view, board=replace(view.board, corners_px=corners_px)))
    fitted = estimate_intrinsics(views, BOARD, NEAR.lens, MODELS["radtan4"], n_folds=0)
    assert [finding.code for finding in model_findings(fitted, BOARD)] == ["verdict.readout"]
