"""Extrinsics from the edges of a scene, without a board: all six axes, with a covariance."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from lce_rig.core.calibration import MOTIONS
from lce_rig.core.camera import Intrinsics
from lce_rig.core.geometry import SURPRISING_CHI2, Array, difference, perturb
from lce_rig.lens.models import grid_rays, model_of
from lce_rig.scene.edge_pyramid import SIGMAS_RAD
from lce_rig.scene.outline_score import N_BLOCKS, OutlineScore, OutlineView

EstimateState = Literal["usable", "few_edges", "beyond_reach", "ambiguous", "weak"]
"""Usable, or the reason why not: too few edges; a maximum at the border of the region searched; another
maximum of nearly the same score; a score no higher than of images and scans that do not belong together."""

REACH = np.repeat([0.2, np.radians(2.0)], 3)
"""Region searched about the start by default, m and rad."""

_UNITS = REACH / 4  # Steps of like effect, for the search.
# Random starts at each width of the fields, coarse to fine, and maxima kept from it.
_N_STARTS, _N_KEPT = (300, 300, 300, 0), (8, 8, 8, 3)
_SEARCH_EDGES = 3000  # on all but the finest fields
_COARSE, _FINE = 1e-6, 2e-9  # Relative gain of a step that ends a climb, on wide fields and the finest
_SAME = 0.5  # Distance in units below which two maxima are one.
_BEYOND = 1.5  # Largest distance from the start, in reaches

# Chosen on KITTI's views, simulated rooms and streets, and boards of os1_64, acfr_vlp16, rlfs01 and rlfs02.
_INFLATION = 2.0  # of standard deviations: neighbouring blocks share surfaces
_BIAS = np.array([0.02, 0.02, 0.02, *np.radians([0.03, 0.03, 0.06])])
"""Standard deviation of errors that all edges of a scene share: beam width, lens, time. m, rad."""
_LEAST_CURVATURE = 1e-3  # of the largest; the reach bounds the variance of flatter directions

_MIN_EDGES = 60
MIN_SCORE = 0.10  # Unrelated images and scans reach 0.06.
MIN_GAIN = 2.0  # Significance over other extrinsics
_NEAR_SIGMAS = 2.0  # Displacement of extrinsics within their errors, along each axis
# Non-centrality of a chi-squared of six degrees of freedom that exceeds SURPRISING_CHI2 in 95 % of cases.
_NOTICED = 27.04
_CONTROL_SIGMAS = 3.0  # Displacement after which extrinsics must score less.
_UNDETERMINED = 0.5  # Standard deviation of an undetermined direction, in reaches.
_LENS_STEP_RAD = 1e-3  # Displacement in the image, by focal length, of a difference by the intrinsics
_FOCAL_STEPS = (-0.02, -0.01, 0.01, 0.02)  # Relative changes of the focal lengths that are compared.


@dataclass(frozen=True, eq=False)
class SceneEstimate:
    """Extrinsics supported by the edges of a scene.

    Attributes:
        T_cam_lidar: (4, 4).
        cov: (6, 6) of the tangent (translation m, rotation rad).
        state: whether it is usable, or why not.
        score: mean log-likelihood ratio of an outline in the views that match; 0 where none does.
        gain: significance of that over the next maximum; inf if there is none.
        n_views, n_edges: compared.
        reach: (6,) region searched, m and rad.
    """

    T_cam_lidar: Array
    cov: Array
    state: EstimateState
    score: float
    gain: float
    n_views: int
    n_edges: int
    reach: Array

    @property
    def undetermined(self) -> tuple[tuple[str, ...], ...]:
        """Undetermined directions of the scene, each by the names of its main axes."""
        variances, directions = np.linalg.eigh(self.cov / np.outer(self.reach, self.reach))
        wide = directions[:, variances > _UNDETERMINED**2].T
        return tuple(tuple(np.array(MOTIONS)[each**2 > np.mean(each**2)].tolist()) for each in wide)

    def chi2(self, T_cam_lidar: Array, cov: Array | None = None) -> float:
        """Compare with extrinsics (4, 4) of a covariance (6, 6): chi-squared of six degrees of freedom."""
        tangent = difference(T_cam_lidar, self.T_cam_lidar)
        return float(tangent @ np.linalg.solve(self.cov if cov is None else self.cov + cov, tangent))

    def smallest_changes(self, cov: Array) -> tuple[float, float]:
        """Return the smallest rotation (deg) and translation (m) in any direction that would be detected.

        Noticed is a chi-squared beyond 99 % of unchanged extrinsics, in 95 % of the cases.

        Args:
            cov: (6, 6) of the extrinsics compared.
        """
        information = np.linalg.inv(self.cov + cov)
        parts = (information[3:, 3:], information[:3, :3])
        turn, shift = (np.sqrt(_NOTICED / np.linalg.eigvalsh(part)[0]) for part in parts)
        return float(np.degrees(turn)), float(shift)


def estimate_scene(
    views: Sequence[OutlineView], intrinsics: Intrinsics, T_start: Array, *, reach: Array = REACH
) -> SceneEstimate:
    """Estimate extrinsics from the edges of all views together.

    The score is maximised from starts spread over the reach, on wide fields first. A view without edges, or
    whose edges match nowhere, adds a constant: it has no veto.

    Args:
        views: images and scans of one drive or room.
        intrinsics: intrinsics of the camera.
        T_start: (4, 4) rough extrinsics.
        reach: (6,) largest error of each axis of the start, m and rad.
    """
    views = [view for view in views if len(view.outlines)]
    n_edges = sum(len(view.outlines) for view in views)
    if n_edges < _MIN_EDGES:
        return SceneEstimate(T_start, np.diag(reach**2), "few_edges", 0.0, np.inf, len(views), n_edges, reach)
    thinned = _thinned(views, -(-n_edges // _SEARCH_EDGES))
    levels = [OutlineScore(thinned, intrinsics, T_start, level) for level in range(len(SIGMAS_RAD) - 1)]
    finest = OutlineScore.finest(views, intrinsics, T_start)
    maxima = _search([*levels, finest], reach)
    best = maxima[0]
    cov = _covariance(finest, best, reach)
    score, gain = finest.of_matching_views(best), _gain(finest, best, maxima[1:], cov)
    value = finest.value(best)
    state: EstimateState = "usable"
    if score < MIN_SCORE or any(finest.value(each) >= value for each in _controls(best, cov)):
        state = "weak"
    elif np.any(np.abs(best) > 0.99 * _BEYOND * reach):
        state = "beyond_reach"
    elif gain < MIN_GAIN:
        state = "ambiguous"
    T = perturb(T_start, best)
    return SceneEstimate(T, cov, state, score, gain, len(views), n_edges, reach)


def find_better_focal(
    views: Sequence[OutlineView], intrinsics: Intrinsics, T_cam_lidar: Array
) -> float | None:
    """Find a relative change of the focal lengths that improves the fit of edges significantly.

    Wrong focal lengths move the camera along its line of sight: 2 % by 0.2 m in a street.

    Args:
        views: as in `estimate_scene`.
        intrinsics: intrinsics of the camera.
        T_cam_lidar: (4, 4) the estimate.

    Returns:
        The best of four steps up to 2 %; None where none is better.
    """
    own = OutlineScore.finest(views, intrinsics, T_cam_lidar)
    best_value, better = own.value(np.zeros(6)), None
    for step in _FOCAL_STEPS:
        scale = 1 + step
        lens = replace(intrinsics, fx_px=scale * intrinsics.fx_px, fy_px=scale * intrinsics.fy_px)
        score = OutlineScore.finest(views, lens, T_cam_lidar)
        tangent, value = _climb(score, np.zeros(6), REACH)
        if value > best_value and significance(score, tangent, own, np.zeros(6)) > MIN_GAIN:
            best_value, better = value, step
    return better


def _climb(score: OutlineScore, start: Array, reach: Array, precision: float = _FINE) -> tuple[Array, float]:
    """Climb from a start to the next maximum (6,), until the relative gain of a step is below `precision`.

    Returns:
        The maximum and its value.
    """
    from scipy.optimize import minimize

    units = np.minimum(_UNITS, reach)

    def fall(x: Array) -> tuple[float, Array]:
        value, slope = score.score(x * units)
        return -value, -slope * units

    bounds = [(-limit, limit) for limit in _BEYOND * reach / units]
    options = {"ftol": precision}
    climbed = minimize(fall, start / units, jac=True, method="L-BFGS-B", bounds=bounds, options=options)
    return np.asarray(climbed.x * units), -float(climbed.fun)


def _thinned(views: Sequence[OutlineView], step: int) -> list[OutlineView]:
    """Keep every n-th edge of each view."""
    return [
        replace(view, outlines=view.outlines.select(np.arange(0, len(view.outlines), step))) for view in views
    ]


def _search(levels: Sequence[OutlineScore], reach: Array) -> list[Array]:
    """Find the maxima (6,) of the finest level, the highest first.

    Each level adds starts of its own: of few edges, the wide fields may have their maximum elsewhere.
    """
    units = np.minimum(_UNITS, reach)
    rng = np.random.default_rng(0)
    maxima = [np.zeros(6)]
    for level, n_starts, n_kept in zip(levels, _N_STARTS, _N_KEPT, strict=True):
        starts = rng.uniform(-1, 1, (n_starts, 6)) * reach
        order = np.argsort([-level.value(start) for start in starts])
        maxima += list(starts[order[:n_kept]])
        precision = _FINE if level is levels[-1] else _COARSE
        found = [_climb(level, start, reach, precision) for start in maxima]
        climbed = sorted(found, key=lambda each: -each[1])
        distinct: list[Array] = []
        for tangent, _ in climbed:
            if all(np.linalg.norm((tangent - other) / units) > _SAME for other in distinct):
                distinct.append(tangent)
        maxima = distinct[:n_kept]
    return maxima


def _gain(score: OutlineScore, best: Array, others: Sequence[Array], cov: Array) -> float:
    """Compute the minimum significance, by blocks, of the maximum over others outside its covariance."""
    chi2 = [(other - best) @ np.linalg.solve(cov, other - best) for other in others]
    others = [other for other, each in zip(others, chi2, strict=True) if each > SURPRISING_CHI2]
    return min((significance(score, best, score, other) for other in others), default=np.inf)


def significance(score: OutlineScore, tangent: Array, other: OutlineScore, other_tangent: Array) -> float:
    """Compute by how many standard deviations, from the scatter of blocks, one score exceeds another."""
    shares, _, pixels = score.edges(tangent)
    gains = np.bincount(score.blocks(pixels), shares - other.edges(other_tangent)[0], N_BLOCKS)
    return float(gains.sum() / max(np.linalg.norm(gains), 1e-12))


def gain_over(
    estimate: SceneEstimate,
    views: Sequence[OutlineView],
    intrinsics: Intrinsics,
    T_cam_lidar: Array,
    cov: Array,
) -> float:
    """Compute the significance of an estimate's score over that of other extrinsics within their errors.

    Where edges hardly determine a direction, such as poles the height, a far maximum may score highest by
    chance, and its own covariance is small: on recorded rlfs03, 193 +- 30 mm too low.

    Args:
        estimate: the estimate.
        views: its views.
        intrinsics: intrinsics of the camera.
        T_cam_lidar: (4, 4) the other extrinsics.
        cov: (6, 6) of these. They are fitted within two standard deviations of it and the scene's bias.
    """
    score = OutlineScore.finest(views, intrinsics, T_cam_lidar)
    near, _ = _climb(score, np.zeros(6), _NEAR_SIGMAS / _BEYOND * np.sqrt(np.diag(cov) + _BIAS**2))
    return significance(score, difference(estimate.T_cam_lidar, T_cam_lidar), score, near)


def _controls(best: Array, cov: Array) -> list[Array]:
    """Move the maximum along the eigenvectors of its covariance, to both sides."""
    variances, directions = np.linalg.eigh(cov / np.outer(_UNITS, _UNITS))
    steps = _CONTROL_SIGMAS * _UNITS[:, None] * directions * np.sqrt(variances)
    return [best + sign * step for step in steps.T for sign in (1, -1)]


def _covariance(score: OutlineScore, tangent: Array, reach: Array) -> Array:
    """Estimate the covariance (6, 6) of a maximum from the scatter of the blocks' slopes.

    C = H^-1 J H^-1 with the curvature H of the score and J the sum of the squared slopes of the blocks, plus
    the bias that blocks share; the reach limits what the scene does not determine.
    """
    scale = np.outer(_UNITS, _UNITS)
    inverse = _inverse_curvature(score, tangent) / scale
    _, slopes, pixels = score.edges(tangent)
    block = score.blocks(pixels)
    by_block = np.stack([np.bincount(block, column, N_BLOCKS) for column in (slopes * _UNITS).T], axis=1)
    by_block = by_block[np.unique(block)]
    small_sample = len(by_block) / max(len(by_block) - 6, 1)
    sandwich = inverse @ (by_block.T @ by_block) @ inverse * small_sample * scale
    cov = _INFLATION**2 * sandwich + np.diag(_BIAS**2)
    limited = np.linalg.inv(np.linalg.inv(cov) + np.diag(1 / reach**2))
    return np.asarray((limited + limited.T) / 2)


def _inverse_curvature(score: OutlineScore, tangent: Array) -> Array:
    """Invert the curvature (6, 6) of the score at a maximum; flat directions count as slightly curved."""
    curvature = np.empty((6, 6))
    for axis, step in enumerate(_UNITS / 10):
        either = [score.score(tangent + sign * step * np.eye(6)[axis])[1] for sign in (1, -1)]
        curvature[axis] = -(either[0] - either[1]) / (2 * step)
    scale = np.outer(_UNITS, _UNITS)
    values, directions = np.linalg.eigh((curvature + curvature.T) / 2 * scale)
    least = max(_LEAST_CURVATURE * values[-1], 1e-9)
    return np.asarray(directions / np.maximum(values, least) @ directions.T * scale)


def follow_lens(
    views: Sequence[OutlineView], intrinsics: Intrinsics, T_cam_lidar: Array, changes: Array
) -> Array:
    """Compute the tangents (6, n) by which an estimate follows small changes of the intrinsics.

    The maximum moves by -H^-1 G with the curvature H of the score and the change G of its slope: by a
    rotation, mostly, for a principal point; along the line of sight for focal lengths.

    Args:
        views: as in `estimate_scene`.
        intrinsics: intrinsics of the camera.
        T_cam_lidar: (4, 4) the estimate.
        changes: (P, n) of the parameters of its `model_of`.
    """
    model = model_of(intrinsics)
    vector, size_px = model.vector(intrinsics), (intrinsics.width_px, intrinsics.height_px)
    inverse = _inverse_curvature(OutlineScore.finest(views, intrinsics, T_cam_lidar), np.zeros(6))
    _, _, by_lens = model.project(vector, grid_rays(intrinsics)[1])
    largest_px = np.abs(by_lens @ changes).max(axis=(0, 1))
    motions = []
    for change, step in zip(changes.T, _LENS_STEP_RAD * intrinsics.fx_px / largest_px, strict=True):
        lenses = [model.intrinsics(vector + sign * step * change, *size_px) for sign in (1, -1)]
        either = [OutlineScore.finest(views, lens, T_cam_lidar).score(np.zeros(6))[1] for lens in lenses]
        motions.append(inverse @ (either[0] - either[1]) / (2 * step))
    return np.stack(motions, axis=1)
