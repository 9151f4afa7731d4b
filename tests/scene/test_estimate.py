"""All six axes from the scene's edges: against a simulated room's truth, with and without a prior."""

from dataclasses import replace

import numpy as np
import pytest

from lce_rig.core.geometry import difference, perturb
from lce_rig.scene.estimate import estimate

WIDE = np.diag([0.05] * 3 + [np.radians(1.0)] * 3) ** 2
ANYWHERE = 9 * WIDE


def lens(seen):
    return seen.rig.cameras["cam"].to_intrinsics()


@pytest.fixture(scope="module")
def alone(seen):
    return estimate(seen.views, lens(seen), seen.truth.T_cam_lidar, ANYWHERE)


def in_sigmas(estimated, truth):
    """Squared Mahalanobis distance of the error."""
    T, cov = estimated
    error = difference(T, truth)
    return float(error @ np.linalg.solve(cov, error))


def test_the_truth_lies_within_the_covariance(seen, alone):
    assert in_sigmas(alone, seen.truth.T_cam_lidar) < 16.8  # chi2, 6 axes, 99 %
    assert np.degrees(np.sqrt(alone[1][4, 4])) < 0.5


def test_captures_of_the_same_scene_count_once(seen, alone):
    again = estimate(seen.views * 3, lens(seen), seen.truth.T_cam_lidar, ANYWHERE)
    assert np.sqrt(np.diag(again[1])) == pytest.approx(np.sqrt(np.diag(alone[1])), rel=0.3)


def test_a_prior_is_improved_where_the_scene_shows_something(seen):
    off = np.array([0.02, 0.01, 0.0, 0.004, 0.010, -0.004])
    T_prior = perturb(seen.truth.T_cam_lidar, off)
    joint = estimate(seen.views, lens(seen), T_prior, WIDE)
    assert in_sigmas(joint, seen.truth.T_cam_lidar) < 16.8
    assert abs(difference(joint[0], seen.truth.T_cam_lidar)[4]) < np.radians(0.2)
    assert joint[1][4, 4] < 0.1 * WIDE[4, 4]
    assert np.all(np.linalg.eigvalsh(WIDE - joint[1]) > -0.1 * np.diag(WIDE).min())


def test_a_certain_prior_stays(seen):
    cov = 1e-4 * WIDE
    T_prior = perturb(seen.truth.T_cam_lidar, np.array([0.0, 0.0, 0.0, 0.0, 0.003, 0.0]))
    joint = estimate(seen.views, lens(seen), T_prior, cov)
    assert np.all(np.abs(difference(joint[0], T_prior)) < 2 * np.sqrt(np.diag(cov)))


def test_directions_that_nothing_shows_keep_the_prior(seen):
    """Images in which nothing fits: no certainty arises from chance."""
    views = [replace(v, field=replace(v.field, values=0 * v.field.values)) for v in seen.views]
    T = seen.truth.T_cam_lidar
    assert estimate(views, lens(seen), T, WIDE)[1] == pytest.approx(WIDE, rel=1e-6)
    nothing = estimate([], lens(seen), T, WIDE)
    assert nothing[0] == pytest.approx(T) and nothing[1] == pytest.approx(WIDE)
