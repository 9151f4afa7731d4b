"""Residuals of the joint likelihood: derivatives, sums and evidence compared with a plain computation."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.linalg import block_diag

from lce_rig.calibrate.consensus import find_consensus
from lce_rig.calibrate.likelihood.images import image_rows, stack_images
from lce_rig.calibrate.likelihood.layout import BOARD as PRINT
from lce_rig.calibrate.likelihood.layout import END, RING, SHIFTS, State, image_columns
from lce_rig.calibrate.likelihood.levels import LOG_SIGMA, Levels, Priors
from lce_rig.calibrate.likelihood.model import Evidence, assemble, linearise
from lce_rig.calibrate.likelihood.rays import (
    edge_rows,
    lens_fields,
    stack_scans,
    sum_ranges,
    turn_rays,
    weigh_ranges,
)
from lce_rig.core.geometry import difference, invert, perturb
from tests.calibrate.boards import BOARD, T_FORWARD, Scenario, simulate

STEP = 1e-6
IMAGE = image_columns(0)


def without_errors(scans, T_lidar_board):
    return State.without_errors(T_FORWARD[None], T_lidar_board, len(scans.rings), [0])


def off(state, name, index, value):
    """Set one constant error."""
    z = state.z.copy()
    z[state.layout.z[name]][index] = value
    return replace(state, z=z)


def ends(scans, state):
    return edge_rows(scans, BOARD, state)


@pytest.fixture(scope="module")
def observations():
    found = find_consensus(simulate(4, 0, Scenario(step_deg=1.0)), BOARD)
    return found.observations


@pytest.fixture(scope="module")
def scans(observations):
    return stack_scans([o.lidar for o in observations], BOARD)


@pytest.fixture(scope="module")
def images(observations):
    return stack_images(np.arange(4), [o.image for o in observations])


@pytest.fixture(scope="module")
def T_lidar_board(images):
    return invert(T_FORWARD) @ images.T_cam_board


def ranges_to(scans, T_lidar_board):
    T = T_lidar_board[scans.capture]
    return np.sum(T[:, :3, 2] * T[:, :3, 3], axis=1) / np.sum(T[:, :3, 2] * scans.rays, axis=1)


def by_pose(scans, T_lidar_board):
    """Derivatives (N, 6) of each ray's range by its board's pose, by differences."""
    pairs = [[perturb(T_lidar_board, s * STEP * axis) for s in (1, -1)] for axis in np.eye(6)]
    return np.column_stack([(ranges_to(scans, a) - ranges_to(scans, b)) / (2 * STEP) for a, b in pairs])


@pytest.mark.parametrize("axis", range(6))
def test_derivatives_by_pose_match_steps(scans, T_lidar_board, axis):
    tangent = STEP * np.eye(6)[axis]
    ahead, behind = perturb(T_lidar_board, tangent), perturb(T_lidar_board, -tangent)
    states = [without_errors(scans, T) for T in (T_lidar_board, ahead, behind)]
    sums = sum_ranges(scans, states[0]).sums[:, :, RING["range"].start, axis]
    expected = np.bincount(scans.group, by_pose(scans, T_lidar_board)[:, axis], sums.size)
    assert np.allclose(sums.ravel(), expected, atol=1e-5)
    here, *moved = (ends(scans, state) for state in states)
    inside = [(e.rows[:, -1] + e.step_m / 2) for e in moved]
    assert np.allclose(here.rows[:, axis], (inside[0] - inside[1]) / (2 * STEP), atol=1e-6)


@pytest.mark.parametrize("lens", [0, 1])
def test_terms_lens_shift_matches_derivative(observations, scans, T_lidar_board, lens):
    """Displace points by 1 mm: the board must appear to be where the derivatives put it."""
    theta = 1e-3
    moved = []
    for observation in observations:
        own = stack_scans([observation.lidar], BOARD)
        points = own.rays * own.range_m[:, None] + theta * own.fields[:, :, lens]
        points_of_ends = observation.lidar.edge_points
        points_of_ends = points_of_ends + theta * lens_fields(points_of_ends)[:, :, lens]
        moved.append(
            replace(observation.lidar, points=points, ring=own.rings[own.ring], edge_points=points_of_ends)
        )
    there = stack_scans(moved, BOARD)
    gap = there.range_m - ranges_to(there, T_lidar_board) - (scans.range_m - ranges_to(scans, T_lidar_board))
    # Displacement along the normal over the ray's slope: what a range along the old ray would have to read.
    n = T_lidar_board[scans.capture, :3, 2]
    by_lens = -np.einsum("ni,ni->n", n, scans.fields[:, :, lens]) / np.sum(n * scans.rays, axis=1)
    assert np.allclose(-gap, theta * by_lens, atol=2e-5)
    state = without_errors(scans, T_lidar_board)
    before, after = (ends(s, state).rows[:, -1] for s in (scans, there))
    expected = theta * ends(scans, state).rows[:, END["lens"]][:, lens]
    # Points were moved, not rays: their rays meet the plane elsewhere, by less than a hundredth of the shift.
    assert np.allclose(after - before, expected, atol=4e-5)


@pytest.mark.parametrize("error", [1, 2])
def test_terms_laser_angles_match_derivative(scans, T_lidar_board, error):
    """One laser's direction is off by 0.05 mrad: its rays rotate."""
    plain_state, ring = without_errors(scans, T_lidar_board), 3
    state = off(plain_state, ("range", "azimuth", "elevation")[error], ring, 5e-5)
    is_mine = scans.ring == ring
    turned = scans.rays + np.where(is_mine, 5e-5, 0.0)[:, None] * turn_rays(scans.rays)[:, :, error - 1]
    expected = ranges_to(replace(scans, rays=turned), T_lidar_board) - ranges_to(scans, T_lidar_board)
    sums = sum_ranges(scans, plain_state).sums
    first = RING["range"].start
    by_error = [np.sum(expected[is_mine & (scans.capture == k)]) / 5e-5 for k in range(scans.n_captures)]
    assert np.allclose(sums[:, ring, first, first + error], by_error, rtol=1e-3, atol=0.02)
    plain, told = (ends(scans, each) for each in (plain_state, state))
    slopes = plain.rows[:, END["range"].start + error] * np.where(scans.end_ring == ring, 5e-5, 0.0)
    assert np.allclose(told.rows[:, -1] - plain.rows[:, -1], slopes, atol=1e-7)
    assert np.abs(slopes).max() > 5e-5


@pytest.mark.parametrize(("shift", "axis"), [("along azimuth", 0), ("upwards", 2)])
def test_terms_shift_matches_displaced_ends(scans, T_lidar_board, shift, axis):
    """Ring ends lie half a millimetre farther along azimuth or upwards than reported; the board stays."""
    state = without_errors(scans, T_lidar_board)
    direction = scans.end_fields[:, :, 0] if axis == 0 else np.tile([0.0, 0.0, 1.0], (len(scans.end_rays), 1))
    plain, told = ends(scans, state), ends(scans, off(state, "shifts", SHIFTS.index(shift), 5e-4))
    moved = plain.range_m[:, None] * scans.end_rays + 5e-4 * direction
    there = replace(scans, end_rays=moved / np.linalg.norm(moved, axis=1, keepdims=True))
    there = replace(there, next_rays=there.end_rays + scans.next_rays - scans.end_rays)
    expected = ends(there, state).rows[:, -1]
    assert np.allclose(told.rows[:, -1], expected, atol=2e-5)
    assert np.ptp(expected - plain.rows[:, -1]) > 5e-4


def test_image_derivatives_match_differences(images, T_lidar_board):
    rows = image_rows(images, T_FORWARD, T_lidar_board, np.zeros(3))
    for axis in range(6):
        tangent = STEP * np.eye(6)[axis]
        by_camera = [
            difference(perturb(T_FORWARD, s * tangent) @ T_lidar_board, images.T_cam_board) for s in (1, -1)
        ]
        by_board = [
            difference(T_FORWARD @ perturb(T_lidar_board, s * tangent), images.T_cam_board) for s in (1, -1)
        ]
        assert np.allclose(
            rows[:, :, IMAGE["camera"]][..., axis], (by_camera[0] - by_camera[1]) / (2 * STEP), atol=1e-7
        )
        assert np.allclose(
            rows[:, :, IMAGE["pose"]][..., axis], (by_board[0] - by_board[1]) / (2 * STEP), atol=1e-7
        )


def test_weigh_ranges_equals_full_covariance(scans, T_lidar_board):
    ranges = sum_ranges(scans, without_errors(scans, T_lidar_board))
    weighted, log_volume = weigh_ranges(ranges, 0.01, 0.004)
    ring = scans.ring[np.searchsorted(scans.capture, 1)]
    mine = (scans.capture == 1) & (scans.ring == ring)
    r = ranges_to(scans, T_lidar_board)[mine]
    v = np.column_stack([by_pose(scans, T_lidar_board)[mine], np.ones(len(r)), r - scans.range_m[mine]])
    cov = 0.01**2 * np.eye(len(r)) + 0.004**2
    plain = RING.of(["pose", "range", "residual"])
    assert np.allclose(weighted[1, ring][np.ix_(plain, plain)], v.T @ np.linalg.solve(cov, v), rtol=1e-5)
    total = 0.0
    for ring in range(len(scans.rings)):
        n = int(np.sum((scans.capture == 1) & (scans.ring == ring)))
        total += np.linalg.slogdet(0.01**2 * np.eye(n) + 0.004**2)[1] if n else 0.0
    assert np.isclose(log_volume[1].sum(), total)


def plain_rows(terms, scans, T_lidar_board, levels, r):
    """Rows [by z, by every board pose, residual] of all terms, and the covariance of their noise."""
    F, z = len(terms.trust), terms.state.layout.z
    rows, noise = [], []
    by_camera = terms.image_rows[0]
    names = {"camera": "camera 0"} | {name: name for name in PRINT}

    def own_pose(k):
        return slice(z.size + 6 * k, z.size + 6 * k + 6)

    for k in range(F):
        own = np.zeros((6, z.size + 6 * F + 1))
        for name, common in names.items():
            own[:, z[common]] = by_camera[k][:, IMAGE[name]]
        own[:, own_pose(k)], own[:, -1] = by_camera[k][:, IMAGE["pose"]], by_camera[k, :, -1]
        rows.append(own)
        noise.append(terms.images[0].total_cov(levels)[k])
    slopes = by_pose(scans, T_lidar_board)
    for i, k in enumerate(scans.capture):
        own = np.zeros((1, z.size + 6 * F + 1))
        n = T_lidar_board[k, :3, 2]
        own[0, own_pose(k)] = slopes[i]
        own[0, z["range"].start + scans.ring[i]] = 1
        turned = r[i] * turn_rays(scans.rays[i : i + 1])[0]
        angles = [z[name].start + scans.ring[i] for name in ("azimuth", "elevation")]
        own[0, angles] = -n @ turned / (n @ scans.rays[i])
        displaced = z.of(["lens", "bow", "stretch", "contrast"])
        own[0, displaced] = -n @ scans.fields[i] / (n @ scans.rays[i])
        own[0, z["stretch"]] = r[i]
        own[0, -1] = r[i] - scans.range_m[i]
        rows.append(own)
    same = scans.group[:, None] == scans.group[None]
    noise.append(levels.range_m**2 * np.eye(len(r)) + levels.ring_m**2 * same)
    return np.concatenate(rows), block_diag(*noise)


EDGE_FIELDS = ("group", "rows", "step_m", "range_m", "is_backed", "sigma_m")


def without_ends(edges):
    none = np.zeros(0, dtype=np.intp)
    return replace(edges, **{name: getattr(edges, name)[none] for name in EDGE_FIELDS})


def test_evidence_levels_match_full_gaussian(scans, images, T_lidar_board):
    terms = linearise(scans, (images,), BOARD, without_errors(scans, T_lidar_board))
    L, G = len(scans.rings), terms.state.layout.z.size
    terms = replace(terms, edges=without_ends(terms.edges))
    priors = Priors()
    r = ranges_to(scans, T_lidar_board)

    def plainly(levels):
        rows, cov = plain_rows(terms, scans, T_lidar_board, levels, r)
        own = (levels.laser_m, priors.azimuth_rad, priors.elevation_rad)
        common = (priors.offset_m, 0.0, 0.0)
        about_mean = np.eye(L) - 1 / L
        lasers = block_diag(
            *(a**2 * about_mean + b**2 + 1e-12 * np.eye(L) for a, b in zip(own, common, strict=True))
        )
        constants = np.concatenate([*priors.of_scans.values(), *priors.of_print.values()])
        known = block_diag(np.linalg.inv(lasers), np.diag(constants**-2))
        A, e = rows[:, :-1], rows[:, -1]
        H, g = A.T @ np.linalg.solve(cov, A), A.T @ np.linalg.solve(cov, e)
        H[6:G, 6:G] += known
        log_volumes = np.linalg.slogdet(cov)[1] + np.linalg.slogdet(H)[1] + np.linalg.slogdet(lasers)[1]
        return e @ np.linalg.solve(cov, e) - g @ np.linalg.solve(H, g) + log_volumes

    base = Levels()
    for changed in (
        replace(base, range_m=0.02),
        replace(base, ring_m=0.005),
        replace(base, tilt_rad=0.004, spin_rad=0.002, depth_m=0.01, across_m=0.004),
        replace(base, laser_m=0.003),
    ):
        fast = [assemble(terms, levels, priors).minus_2_log_evidence for levels in (base, changed)]
        assert np.isclose(fast[1] - fast[0], plainly(changed) - plainly(base), rtol=1e-5)


def test_evidence_slopes_match_differences(scans, images, T_lidar_board):
    trust = np.linspace(0.4, 1.0, scans.n_captures)
    terms = linearise(scans, (images,), BOARD, without_errors(scans, T_lidar_board), trust)
    priors, base, step = Priors(), Levels(), 1e-3
    value, slopes = Evidence.of(terms, base, priors, list(LOG_SIGMA))(base)
    assert value == assemble(terms, base, priors).minus_2_log_evidence
    for name, slope in zip(LOG_SIGMA, slopes, strict=True):
        below, above = (
            assemble(terms, replace(base, **{name: getattr(base, name) * np.exp(by)}), priors)
            for by in (-step, step)
        )
        rise = above.minus_2_log_evidence - below.minus_2_log_evidence
        assert slope == pytest.approx(rise / (2 * step), rel=2e-3, abs=0.05)
