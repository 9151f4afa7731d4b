"""Intrinsics of a camera from images of the board, with covariance and held-out errors."""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from lce_rig.core.board import Board
from lce_rig.core.camera import Intrinsics
from lce_rig.core.errors import NotEnoughDataError
from lce_rig.core.findings import Refusal
from lce_rig.core.geometry import Array
from lce_rig.core.planar_pose import solve_planar_pose
from lce_rig.lens.findings import OTHER_LENS
from lce_rig.lens.fit import (
    N_MODES,
    LensState,
    Setup,
    corners_of,
    fit,
    reduced,
    refit_poses,
    residuals_px,
    solve_scaled,
)
from lce_rig.lens.lens_estimate import BoardView, IntrinsicsEstimate
from lce_rig.lens.models import LensModel, LensPrior, convert, model_of

MIN_CAPTURES = 4
N_FOLDS = 10
# Rounds of fitting and reweighting, until no weight changes by more than a tenth.
_ROUNDS, _STEADY = 6, 0.1
# A board's noise is estimated from its own residuals and this many of its channel as a prior.
_PRIOR_DOF = 30.0
# Errors that a board's corners share and residuals hide: model of the lens, blur. Sessions of one rig whose
# corners fit to 0.01 px differ as if all had at least this error.
_SHARED_PX = 0.02
# Focal length, principal point or distortion of a profile that agree with the boards with less than this
# probability are trusted less: 2 % for the three together.
_CHANCE = 0.02 / 3
# Rounds of comparing the scatter of captures with the stated deviations.
_SCATTER_ROUNDS = 3
# Corners with residuals this many times the typical value of their channel are outliers.
_BAD = 4.0
# Directions of the intrinsics with a smaller share of the largest variance are the prior's.
_DETERMINED = 1e-3
# A single capture that determines a direction cannot be compared with others.
_LEAST_REST = 1e-3
# A focal length with a larger relative standard deviation is undetermined.
_MAX_FOCAL_SIGMA = 0.1


def estimate_intrinsics(
    views: Sequence[BoardView],
    board: Board,
    start: Intrinsics,
    model: LensModel,
    *,
    prior: LensPrior | None = None,
    n_folds: int = N_FOLDS,
) -> IntrinsicsEstimate:
    """Fit intrinsics and board shape to the corners of all views, each with its own pose and noise level.

    Boards are weighted by their own residuals, so that blurred images and noisier channels count less, and
    views that do not fit the others are refused by name. Errors of corners in one image are correlated:
    before the prior is applied, all weights are divided by the ratio of the captures' scatter to that of
    independent corners.

    Args:
        views: views of at least `MIN_CAPTURES` captures.
        board: the board.
        start: an initial guess at the images' resolution; it may be wrong by a third.
        model: model of the lens to fit.
        prior: the profile's intrinsics; None to use the boards alone.
        n_folds: number of cross-validation folds; 0 for none.

    Raises:
        NotEnoughDataError: too few captures, or captures that do not determine the focal length.
    """
    n_needed = MIN_CAPTURES if prior is None else 1
    _require_captures(views, n_needed)
    setup = Setup.of(np.array([view.board.corners_px for view in views]), board, model, prior)
    starts = np.array([view.board.T_cam_board for view in views])
    channels = np.array([view.channel for view in views])
    state = LensState(convert(start, model), np.zeros(len(setup.shapes)), starts)
    kept = np.ones(len(views), dtype=bool)
    for rounds_left in reversed(range(_ROUNDS)):
        fitted, weights = _fit_weighted(setup.select(kept), state.select(kept), channels[kept])
        # Views rejected because of a bad start return if they fit after all.
        starts[kept] = fitted.T_cam_board
        lens = model.intrinsics(fitted.lens, start.width_px, start.height_px)
        for k in np.flatnonzero(~kept):
            solved = solve_planar_pose(setup.corners_px[k], setup.corners_board, lens)
            starts[k] = starts[k] if solved is None else solved.T_cam_board
        state = refit_poses(setup, fitted.with_poses(starts))
        # Keep boards that fit about as well as is typical of their channel.
        variances = _variances(setup, state)
        fits = variances <= _BAD**2 * (_usual(variances, channels) + _SHARED_PX**2)
        if rounds_left == 0 or np.array_equal(fits, kept):
            break
        kept = fits
        _require_captures([view for view, is_kept in zip(views, kept, strict=True) if is_kept], n_needed)
    used = tuple(view for view, is_kept in zip(views, kept, strict=True) if is_kept)
    distances_px = _distances(setup, state)
    median_px = float(np.median(distances_px[kept]))
    refused = {
        views[k].name: OTHER_LENS.refusal(rms_px=float(distances_px[k]), median_px=median_px)
        for k in np.flatnonzero(~kept).tolist()
    }
    return _estimate(setup.select(kept), fitted, weights, used, refused, start, n_folds, prior is not None)


def distances_under(intrinsics: Intrinsics, views: Sequence[BoardView], board: Board) -> Array:
    """Measure how well given intrinsics fit, estimating only poses and the board's shape.

    Returns:
        Rms distance (K,) of each view's corners from their prediction, px.
    """
    model = model_of(intrinsics)
    corners = np.array([view.board.corners_px for view in views])
    setup = replace(Setup.of(corners, board, model), is_lens_free=False)
    poses = np.array([view.board.T_cam_board for view in views])
    start = refit_poses(setup, LensState(model.vector(intrinsics), np.zeros(len(setup.shapes)), poses))
    return _distances(setup, fit(setup, start, np.ones(len(views))))


def _require_captures(views: Sequence[BoardView], n_needed: int) -> None:
    n = len({view.capture for view in views})
    if n < n_needed:
        raise NotEnoughDataError(
            f"the board is in {n} captures (minimum {n_needed} for intrinsics)",
            "Collect 15 or more, tilted in different directions, all over the image",
        )


def _fit_weighted(setup: Setup, state: LensState, channels: NDArray[np.str_]) -> tuple[LensState, Array]:
    """Alternate fitting and weighting; weights (K,) are 1 / px^2."""
    state = refit_poses(setup, state)
    weights = _weights(setup, state, channels)
    for done in range(_ROUNDS):
        state = fit(setup, state, weights)
        if done < 2:
            # Better intrinsics may show that a board's tilt was mirrored.
            state = refit_poses(setup, state)
        before, weights = weights, _weights(setup, state, channels)
        if np.all(np.abs(weights - before) < _STEADY * before):
            break
    return fit(setup, state, weights), weights


def _variances(setup: Setup, state: LensState) -> Array:
    residuals = residuals_px(setup, state).reshape(len(setup.corners_px), -1)
    # If the start cannot project a board, the board gets no weight in this round.
    variances = np.sum(residuals**2, axis=1) / setup.dof
    return np.where(np.isfinite(variances), variances, 1e12)


def _usual(variances: Array, channels: NDArray[np.str_]) -> Array:
    """Return the median variance (K,) of all boards on the channel of each board."""
    return np.array([np.median(variances[channels == name]) for name in channels])


def _weights(setup: Setup, state: LensState, channels: NDArray[np.str_]) -> Array:
    variances = _variances(setup, state)
    dof, usual = setup.dof, _usual(variances, channels)
    pooled = (dof * variances + _PRIOR_DOF * usual) / (dof + _PRIOR_DOF)
    return np.asarray(1 / (pooled + _SHARED_PX**2))


def _distances(setup: Setup, state: LensState) -> Array:
    """Rms distance (K,) of each board's corners from their prediction, px."""
    squares = np.sum(residuals_px(setup, state) ** 2, axis=(1, 2))
    return np.asarray(np.sqrt(squares / (setup.dof / 2 + 3)))


def _estimate(
    setup: Setup,
    state: LensState,
    weights: Array,
    views: tuple[BoardView, ...],
    refused: Mapping[str, Refusal],
    start: Intrinsics,
    n_folds: int,
    has_prior: bool,
) -> IntrinsicsEstimate:
    captures = np.unique([view.capture for view in views], return_inverse=True)[1]
    advice = "add captures with the board tilted by 20 deg or more, left and right as well as up and down"
    profile = setup
    try:
        setup, state, weights, cov, inflation = _weigh_scatter(setup, state, weights, captures, has_prior)
    except np.linalg.LinAlgError as error:
        raise NotEnoughDataError("the captures do not determine the intrinsics", advice) from error
    P = setup.model.size
    focal_sigma = float(np.sqrt(cov[0, 0]) / state.lens[0])
    if not 0 <= focal_sigma < _MAX_FOCAL_SIGMA:
        raise NotEnoughDataError(f"focal length standard deviation {100 * focal_sigma:.0f} %", advice)
    smooth = P + N_MODES
    return IntrinsicsEstimate(
        model=setup.model,
        intrinsics=setup.model.intrinsics(state.lens, start.width_px, start.height_px),
        cov=cov[:P, :P],
        cov_with_board=cov[:smooth, :smooth],
        inflation=inflation,
        corners_board=corners_of(setup, state.shape),
        shapes=setup.shapes[:N_MODES],
        shape=state.shape[:N_MODES],
        shape_sigma=np.sqrt(np.diag(cov)[P:smooth]),
        print_rms_m=float(np.sqrt(2 * np.mean(state.shape[N_MODES:] ** 2))),
        views=views,
        T_cam_board=state.T_cam_board,
        residuals_px=-residuals_px(setup, state)[np.isfinite(setup.corners_px[..., 0])],
        held_out_px=_held_out(setup, state, weights, captures, n_folds),
        surprise=profile.surprise(state.lens) if has_prior else None,
        is_contradicted=setup is not profile,
        refused=refused,
    )


def _weigh_scatter(
    setup: Setup, state: LensState, weights: Array, captures: NDArray[np.intp], has_prior: bool
) -> tuple[Setup, LensState, Array, Array, float]:
    """Divide the weights by the captures' scatter, and widen a prior that the boards contradict.

    Returns:
        Setup, state and weights with the covariance (Q, Q) of lens and shape, and the ratio of standard
        deviations to those of independent corners.
    """
    inflation, P = 1.0, setup.model.size
    for _ in range(_SCATTER_ROUNDS):
        ratio = _scatter_ratio(setup, state, weights, captures)
        inflation, weights = inflation * ratio, weights / ratio
        state = fit(setup, state, weights) if ratio > 1.0 else state
        cov = _covariance(setup, state, weights)
        parts = setup.contradicted(state.lens, cov[:P, :P], _CHANCE) if has_prior else []
        if parts:
            setup = setup.doubting(parts)
            state = fit(setup, state, weights)
            cov = _covariance(setup, state, weights)
        elif ratio == 1.0:
            break
    return setup, state, weights, cov, float(np.sqrt(inflation))


def _covariance(setup: Setup, state: LensState, weights: Array) -> Array:
    """Compute the covariance (Q, Q) of lens and shape."""
    _, information = reduced(setup, state, weights)
    return solve_scaled(information.sum(axis=0) + setup.information, np.eye(len(setup.mean)))


def _scatter_ratio(setup: Setup, state: LensState, weights: Array, captures: NDArray[np.intp]) -> float:
    """Compare the captures' scatter of the intrinsics with the covariance of independent corner errors.

    In fact, model errors move all corners of an image together. With gradient g_k and Hessian H_k of
    capture k, H = sum H_k + prior = L L^T and S_k = L^-1 H_k L^-T, each e_k = (I - S_k)^-1/2 L^-1 g_k has the
    covariance S_k if errors are independent, for any weights of single captures. The scatter
    sum_k L^-T e_k e_k^T L^-1 of the intrinsics is compared with H^-1 (sum_k H_k) H^-1.

    Returns:
        The mean ratio of variances in the directions that the captures determine, 1 at least.

    References:
        R. Bell, D. McCaffrey: Bias reduction in standard errors for linear regression with multi-stage
        samples. Survey Methodology 28 (2002).
    """
    gradients, information = reduced(setup, state, weights)
    scale = 1.0 / np.sqrt(np.einsum("kii->i", information) + np.diag(setup.information))
    gradients, information = gradients * scale, information * np.outer(scale, scale)
    data = information.sum(axis=0)
    L = np.linalg.cholesky(data + setup.information * np.outer(scale, scale))
    back = np.linalg.inv(L)
    cov = back.T @ back
    # The shared unknowns absorb part of the residuals.
    n_residuals = float(setup.dof.sum())
    lost = float(np.vdot(cov, data))
    expected = cov @ data @ cov * (n_residuals / max(n_residuals - lost, 1.0))
    P = setup.model.size
    moves = []
    for capture in range(int(captures.max()) + 1):
        own = captures == capture
        values, vectors = np.linalg.eigh(back @ information[own].sum(axis=0) @ back.T)
        e = vectors.T @ back @ gradients[own].sum(axis=0) / np.sqrt(np.maximum(1.0 - values, _LEAST_REST))
        moves.append((back.T @ vectors @ e)[:P])
    sigma = np.sqrt(np.diag(expected)[:P])
    variances, axes = np.linalg.eigh(expected[:P, :P] / np.outer(sigma, sigma))
    along = np.sum((np.array(moves) / sigma @ axes) ** 2, axis=0) / np.maximum(variances, 1e-12)
    return max(float(np.mean(along[variances > _DETERMINED * variances.max()])), 1.0)


def _held_out(
    setup: Setup, state: LensState, weights: Array, captures: NDArray[np.intp], n_folds: int
) -> Array:
    """Rms distance (K,) of each board's corners under intrinsics and shape fitted to the other folds."""
    distances = np.full(len(captures), np.nan)
    n = min(n_folds, int(captures.max()) + 1)
    for fold in range(n):
        out = captures % n == fold
        fitted = fit(setup.select(~out), state.select(~out), weights[~out])
        seen = refit_poses(setup.select(out), fitted.with_poses(state.T_cam_board[out]), tries_mirror=False)
        distances[out] = _distances(setup.select(out), seen)
    return distances
