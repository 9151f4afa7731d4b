"""Which lens model? That with the fewest parameters which foretells left-out captures as well as the best."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from lce_rig.calibrate.intrinsics import N_FOLDS, estimate_intrinsics
from lce_rig.calibrate.intrinsics_estimate import IntrinsicsEstimate, View
from lce_rig.calibrate.intrinsics_model import MODELS
from lce_rig.core.board import Board
from lce_rig.core.camera import Intrinsics
from lce_rig.core.errors import NotEnoughDataError

# Models whose mean squared distances differ by less than this fraction are alike for any use.
_ALIKE = 0.02


@dataclass(frozen=True)
class ModelScore:
    """How well a model does.

    Attributes:
        name: of the model.
        n_parameters: it has.
        rms_px: rms distance of corners it was fitted to.
        held_out_px: the same of captures left out.
        excess_px2: by how much its mean squared distance on these is worse than the best model's.
        excess_sigma_px2: standard deviation of that, from how captures differ.
    """

    name: str
    n_parameters: int
    rms_px: float
    held_out_px: float
    excess_px2: float
    excess_sigma_px2: float

    @property
    def is_as_good_as_the_best(self) -> bool:
        """Whether the captures left out do not tell it from the best, or it hardly matters."""
        return self.excess_px2 <= max(self.excess_sigma_px2, _ALIKE * self.held_out_px**2)


@dataclass(frozen=True)
class Choice:
    """The model chosen, why, and how all of them did."""

    name: str
    reason: str
    scores: tuple[ModelScore, ...]


def choose_model(
    views: Sequence[View], board: Board, start: Intrinsics, *, n_folds: int = N_FOLDS
) -> tuple[IntrinsicsEstimate, Choice]:
    """Fit every model and choose one by its error on captures that were left out.

    Of the models that are no worse than the best by more than one standard deviation of the difference, the
    one with the fewest parameters is chosen; of those one of the same family as `start`, and then the best.

    Args:
        views: of at least `MIN_CAPTURES` captures.
        board: the board.
        start: the best guess, of any model.
        n_folds: parts that are left out in turn.

    Raises:
        NotEnoughDataError: no model can be fitted.
    """
    fitted: dict[str, IntrinsicsEstimate] = {}
    troubles = []
    for name, model in MODELS.items():
        try:
            fitted[name] = estimate_intrinsics(views, board, start, model, n_folds=n_folds)
        except NotEnoughDataError as error:
            troubles.append(error)
    if not fitted:
        raise troubles[0]
    scores = _scores(fitted)
    equals = [score for score in scores if score.is_as_good_as_the_best]
    chosen = min(equals, key=lambda s: (s.n_parameters, MODELS[s.name].family != start.model, s.held_out_px))
    return fitted[chosen.name], Choice(chosen.name, _reason(chosen, scores), scores)


def _scores(fitted: Mapping[str, IntrinsicsEstimate]) -> tuple[ModelScore, ...]:
    """Compare the models on the captures that none of them refused; the best first."""
    squares = {name: _squares_by_capture(estimate) for name, estimate in fitted.items()}
    shared = sorted(set.intersection(*(set(by_capture) for by_capture in squares.values())))
    table = {name: np.array([squares[name][capture] for capture in shared]) for name in fitted}
    best = min(table, key=lambda name: (float(table[name].mean()), name))
    scores = []
    for name, estimate in fitted.items():
        excess = table[name] - table[best]
        sigma = float(excess.std(ddof=1) / np.sqrt(len(excess))) if len(excess) > 1 else 0.0
        held_out_px = float(np.sqrt(table[name].mean()))
        mean = float(excess.mean())
        scores.append(ModelScore(name, estimate.model.size, estimate.rms_px, held_out_px, mean, sigma))
    return tuple(sorted(scores, key=lambda score: score.held_out_px))


def _squares_by_capture(estimate: IntrinsicsEstimate) -> dict[str, float]:
    """Mean squared distance of each capture's corners when it was left out, px^2."""
    captures = np.array([view.capture for view in estimate.views])
    return {str(name): float(np.mean(estimate.held_out_px[captures == name] ** 2)) for name in set(captures)}


def _reason(chosen: ModelScore, scores: Sequence[ModelScore]) -> str:
    def listed(some: Sequence[ModelScore]) -> str:
        return ", ".join(f"{score.name} {score.held_out_px:.3f} px" for score in some)

    text = f"{chosen.name}: {chosen.held_out_px:.3f} px on captures left out"
    alike = [score for score in scores if score.is_as_good_as_the_best and score.name != chosen.name]
    worse = [score for score in scores if not score.is_as_good_as_the_best]
    text += f"; no surely better: {listed(alike)}" if alike else ", the least"
    return text + (f"; worse: {listed(worse)}" if worse else "")
