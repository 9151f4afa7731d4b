"""The density of ring ends: norm, derivatives, and information compared with samples."""

import numpy as np
import pytest

from lce_rig.calibrate.likelihood.end_density import density

LOST = 0.07
CASES = [(0.03, LOST), (0.2, LOST), (0.6, 0.3), (2.0, LOST), (10.0, 0.3), (100.0, LOST)]


def at(blur, lost_share, reach=400.0):
    # Dense in the middle, where the density rises and falls, and far out, where its tail ends.
    x = np.linspace(-1, 1, 400_001)
    x = np.sign(x) * np.abs(x) ** 3 * reach * max(blur, 1.0)
    return x, *density(x, np.full_like(x, blur), lost_share)


@pytest.mark.parametrize(("blur", "lost"), CASES)
def test_end_density_integrates_to_one_and_slope_matches(blur, lost):
    x, p, _ = at(blur, lost)
    assert np.all(p > 0)
    # What is missing is the tail of Cauchy's distribution beyond the grid, a share of 0.01.
    assert 1 - 1e-4 < np.trapezoid(p, x) < 1 + 1e-6
    step = 1e-6
    there = np.linspace(-3, 5, 801)
    ahead, behind = (density(there + s * step, np.full(801, blur), lost)[0] for s in (1, -1))
    assert np.allclose(density(there, np.full(801, blur), lost)[1], (ahead - behind) / (2 * step), atol=1e-6)
