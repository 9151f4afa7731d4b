"""Second phase of Algorithm 1: many refinements on random subsets, judged on the captures they left out."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lce_rig.core.geometry import Array, pose, project_to_so3
from lce_rig.residuals.moments import Problem

MIN_SUBSET = 3
_CHUNK = 1000


@dataclass(frozen=True, eq=False)
class Draws:
    """What the subsets of each size M say.

    Attributes:
        sizes: (S,) M.
        T_mean: (S, 4, 4) mean of the candidates of each size.
        held_out_m: (S,) mean over captures of their error in candidates that did not use them.
        capture_held_out_m: (F,) the same per capture, at the best size.
        best: index of the size with the least held-out error.
        n_solved: problems solved, over all rounds.
        certified_share: share of the candidates with a certificate.
        spread_rotation_rad, spread_translation_m: (S,) rms of the candidates about their mean.
    """

    sizes: NDArray[np.int_]
    T_mean: Array
    held_out_m: Array
    capture_held_out_m: Array
    best: int
    n_solved: int
    certified_share: float
    spread_rotation_rad: Array
    spread_translation_m: Array


def draw_subsets(
    problem: Problem,
    T_start: Array,
    n_draws: int,
    n_rounds: int,
    seed: int,
    progress: Callable[[int, int], None] | None = None,
) -> Draws | None:
    """Solve `n_draws` random subsets of each size 3..F-1.

    A candidate that is judged on the captures it was fitted to gains from fitting their noise; here each is
    judged on the others. Every capture counts alike, whatever subsets it happened to be left out of.

    Args:
        problem: F captures.
        T_start: (4, 4) planar initialisation.
        n_draws: I.
        n_rounds: of re-association.
        seed: of the draws.
        progress: called with (subsets done, subsets in all).

    Returns:
        The draws; None without any, or where fewer than four captures leave none out.
    """
    n = problem.n_captures
    sizes = np.arange(MIN_SUBSET, n)
    if len(sizes) == 0 or n_draws == 0:
        return None
    rng = np.random.default_rng(seed)
    order = np.argsort(rng.random((len(sizes) * n_draws, n)), axis=1)
    # A capture takes part where its rank in the shuffled order is below the subset's size.
    selection = (order < np.repeat(sizes, n_draws)[:, None]).astype(np.float64)
    T, errors, certified = [], [], []
    for start in range(0, len(selection), _CHUNK):
        part = selection[start : start + _CHUNK]
        solutions = problem.solve(part, T_start, n_rounds)
        plane, edge = problem.errors(solutions.x)
        T.append(solutions.T)
        errors.append(plane + edge)
        certified.append(solutions.certificates.is_optimal)
        if progress is not None:
            progress(start + len(part), len(selection))
    return _judge(
        sizes,
        np.concatenate(T).reshape(len(sizes), n_draws, 4, 4),
        np.concatenate(errors).reshape(len(sizes), n_draws, n),
        selection.reshape(len(sizes), n_draws, n) == 0,
        n_rounds * len(selection),
        float(np.mean(np.concatenate(certified))),
    )


def _judge(
    sizes: NDArray[np.int_],
    T: Array,
    errors: Array,
    is_held_out: Array,
    n_solved: int,
    certified_share: float,
) -> Draws:
    """Average held-out errors per size and capture, and candidates per size."""
    count = is_held_out.sum(axis=1)
    total = np.sum(errors * is_held_out, axis=1)
    # With few draws a capture may never have been left out at a size: its mean over the sizes stands in.
    overall = total.sum(axis=0) / np.maximum(count.sum(axis=0), 1)
    per_capture = np.where(count > 0, total / np.maximum(count, 1), overall)
    held_out_m = per_capture.mean(axis=1)
    best = int(np.argmin(held_out_m))
    R_mean = project_to_so3(T[:, :, :3, :3].mean(axis=1))
    t_mean = T[:, :, :3, 3].mean(axis=1)
    half_sine = np.linalg.norm(T[..., :3, :3] - R_mean[:, None], axis=(-2, -1)) / np.sqrt(8)
    angles = 2 * np.arcsin(np.clip(half_sine, 0, 1))
    distances = np.linalg.norm(T[..., :3, 3] - t_mean[:, None], axis=-1)
    return Draws(
        sizes=sizes,
        T_mean=pose(R_mean, t_mean),
        held_out_m=held_out_m,
        capture_held_out_m=per_capture[best],
        best=best,
        n_solved=n_solved,
        certified_share=certified_share,
        spread_rotation_rad=np.sqrt(np.mean(angles**2, axis=1)),
        spread_translation_m=np.sqrt(np.mean(distances**2, axis=1)),
    )
