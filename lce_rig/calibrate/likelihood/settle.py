"""Steps of Fisher scoring towards the optimum at given levels of noise."""

from dataclasses import dataclass, replace

import numpy as np

from lce_rig.calibrate.likelihood.along_rays import StackedScans
from lce_rig.calibrate.likelihood.image_terms import StackedImages
from lce_rig.calibrate.likelihood.levels import Levels, Priors
from lce_rig.calibrate.likelihood.system import Reduced, State, Terms, assemble, linearise
from lce_rig.core.board import Board
from lce_rig.core.geometry import Array


@dataclass(frozen=True, eq=False)
class Point:
    """A state, and all terms there."""

    state: State
    terms: Terms

    def trusting(self, trust: Array) -> "Point":
        """Weigh captures by (F,)."""
        return replace(self, terms=replace(self.terms, trust=trust))


@dataclass(frozen=True, eq=False)
class JointProblem:
    """Constants of the optimisation."""

    scans: StackedScans
    images: tuple[StackedImages, ...]
    board: Board
    priors: Priors

    def at(self, state: State, trust: Array) -> Point:
        """Linearise all terms at a state, captures weighed by (F,)."""
        return Point(state, linearise(self.scans, self.images, self.board, state, trust))

    def settle(self, here: Point, levels: Levels, n_steps: int, short: float) -> Point:
        """Find the optimum at given levels, in at most so many steps, until the next one is short."""
        mixing = _Mixing()
        for _ in range(n_steps):
            reduced = assemble(here.terms, levels, self.priors)
            if reduced.decrement < short**2:
                break
            z, y = mixing.mix(reduced)
            here = self.at(here.state.moved(z, y), here.terms.trust)
        return here


# Plain steps before any are mixed, and how many are.
_PLAIN, _MIXED = 3, 5
# A mixed step is at most so many times as long as the plain one.
_LONGEST = 5.0


class _Mixing:
    """Corrects steps by how earlier ones turned out (Anderson mixing).

    The mean information of ring ends is not the curvature of their cost: plain steps are a fifth of what
    they should be in some directions, and leap back and forth in others. From steps s_k and moves m_k,

        m = s - (dM + dS) gamma,    gamma = argmin |s - dS gamma|, in standard deviations of the unknowns

    References:
        Walker, Ni, "Anderson acceleration for fixed-point iterations", SIAM J. Numerical Analysis, 2011.
    """

    def __init__(self) -> None:
        self._steps: list[Array] = []
        self._moves: list[Array] = []

    def mix(self, reduced: Reduced) -> tuple[Array, Array]:
        """Return the move z (G,), y (F, 7) for the step of normal equations."""
        z, y = reduced.step
        step = np.append(z, y)
        move = step
        self._steps.append(step)
        if len(self._steps) > _PLAIN:
            of_own = np.diagonal(reduced.of_own, axis1=1, axis2=2)
            weight = np.sqrt(np.append(np.diag(reduced.cost.information), of_own))
            dS = np.diff(self._steps[-_MIXED - 1 :], axis=0).T
            dM = np.transpose(self._moves[-dS.shape[1] :])
            gamma = np.linalg.lstsq(weight[:, None] * dS, weight * step, rcond=1e-6)[0]
            move = step - (dM + dS) @ gamma
            length, plain = (float(np.linalg.norm(weight * each)) for each in (move, step))
            move = move * min(1.0, _LONGEST * plain / max(length, np.finfo(float).tiny))
        self._moves.append(move)
        return move[: len(z)], move[len(z) :].reshape(y.shape)
