"""Repeated captures of one placement are counted once in what is claimed."""

from dataclasses import replace

import numpy as np
import pytest

from lce_rig.calibrate import EstimateSettings, fit_extrinsic
from tests.calibrate.boards import BOARD, simulate


@pytest.mark.parametrize("method", ["ml", "paper"])
def test_the_same_placements_captured_again_claim_no_smaller_sigma(method):
    once = simulate(14, seed=4)
    again = [replace(item, capture=f"1{item.capture[1:]}") for item in once]
    options = EstimateSettings(method, n_draws=1)
    single, double = (
        fit_extrinsic(once, BOARD, options),
        fit_extrinsic([*once, *again], BOARD, options),
    )
    assert double.diagnostics.n_placements == single.diagnostics.n_placements == 14
    ratio = np.sqrt(np.diag(double.cov) / np.diag(single.cov))
    assert np.all(ratio > 0.85)
