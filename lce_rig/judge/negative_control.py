"""A negative control: extrinsics known to be wrong must fit held-out captures worse.

If they do not, the captures cannot distinguish the result from one that is several of its standard deviations
and at least the target away: the result is not the optimum, or its covariance is too small.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from lce_rig.calibrate.features import extract_features
from lce_rig.calibrate.observability import main_motion
from lce_rig.calibrate.quadratics import Quadratics, jackknife_scatter
from lce_rig.calibrate.result import lever_arm
from lce_rig.core.board import Board
from lce_rig.core.findings import Finding
from lce_rig.core.geometry import Array, perturb, tangent_sizes
from lce_rig.core.results import Observation
from lce_rig.judge.findings import CONTROL, failing
from lce_rig.judge.local_quadratic import capture_costs, feature_sigmas
from lce_rig.rig import CalibrationSettings

SURE_GAIN = 2.0
"""A gain of a move by so many standard errors is significant."""
_FAILS = 4.0


@dataclass(frozen=True, eq=False)
class NegativeControl:
    """Effect of moving the result on the residuals of held-out captures.

    Attributes:
        moves: (B, 6) tangents by which the result was moved.
        worse: (B,) mean increase of a held-out capture's cost over that of the result.
        worse_sigma: (B,) standard error of it.
    """

    moves: Array
    worse: Array
    worse_sigma: Array

    @property
    def worst(self) -> int:
        """Index of the move that fits held-out captures best."""
        return int(np.argmin(self.worse / self.worse_sigma))

    @property
    def gain_sigmas(self) -> float:
        """By how many standard errors it fits better than the result."""
        return -float(self.worse[self.worst] / self.worse_sigma[self.worst])


def run_control(
    observations: Sequence[Observation],
    board: Board,
    T_cam_lidar: Array,
    cov: Array,
    expansion: Quadratics,
    target: CalibrationSettings,
    n_sigmas: float,
) -> NegativeControl:
    """Move extrinsics both ways along the axes of its covariance, and judge it on held-out captures.

    Each capture is judged under the extrinsics from the captures of the other placements.

    Args:
        observations: F captures.
        board: the board.
        T_cam_lidar: (4, 4) the result.
        cov: (6, 6) its reported covariance.
        expansion: of these captures, settled.
        target: minimum move of the result, in rotation or in translation.
        n_sigmas: number of standard deviations by which it is moved otherwise.
    """
    features = [extract_features(seen, board) for seen in observations]
    moves = _moves(cov, lever_arm(observations), target, n_sigmas)
    left_out = expansion.without_each()[expansion.placement]
    own = perturb(T_cam_lidar, left_out)
    sigmas = feature_sigmas(features, board, T_cam_lidar)
    costs = np.array(
        [
            capture_costs(f, board, perturb(T, np.vstack([np.zeros(6), moves])), sigmas)
            for f, T in zip(features, own, strict=True)
        ]
    )
    usual = float(np.median(costs[:, 0]))
    return _compare(moves, (costs[:, 1:] - costs[:, :1]) / max(usual, 1e-12))


def run_control_with_constants(
    expansion: Quadratics, cov: Array, lever_m: float, target: CalibrationSettings, n_sigmas: float
) -> NegativeControl:
    """Judge a result whose method estimates the sensors' constants by a cost that does so, too.

    Range offsets and the camera's scale move the best extrinsics by more than their standard deviations:
    under a cost without them, another result would always fit better. So they take, for the result and for
    each move, the values that fit the captures of the other placements best.

    This cost has another optimum than the method's. It finds a move worse than the result unless its optimum
    lies beyond half of the move. So moves are twice as long, and contain its own scatter.

    Args:
        expansion: about the result, (translation, rotation) first, then constants with priors.
        cov: (6, 6) the result's reported covariance.
        lever_m: rms distance of the boards from the camera.
        target: as in `run_control`.
        n_sigmas: as in `run_control`.
    """
    left_out = (expansion.without_each() - expansion.optimum())[:, :6]
    scatter = jackknife_scatter(left_out - left_out.mean(axis=0))
    moves = _moves(cov + scatter, lever_m, target, 2 * n_sigmas)
    increases = np.empty((len(expansion.gradients), len(moves)))
    for group, (shares, own) in enumerate(zip(1 - expansion.groups, left_out, strict=True)):
        H = np.tensordot(shares, expansion.hessians, axes=1) + expansion.prior
        g = shares @ expansion.gradients + expansion.prior_gradient
        tangents = own + np.vstack([np.zeros(6), moves])
        constants = -np.linalg.solve(H[6:, 6:], (g[6:] + tangents @ H[:6, 6:]).T).T
        x = np.hstack([tangents, constants])
        for k in np.flatnonzero(expansion.placement == group):
            costs = 2 * x @ expansion.gradients[k] + np.sum(x @ expansion.hessians[k] * x, axis=1)
            increases[k] = costs[1:] - costs[0]
    return _compare(moves, increases)


def _moves(cov: Array, lever_m: float, target: CalibrationSettings, n_sigmas: float) -> Array:
    """List moves (12, 6) along the axes of a covariance, of so many standard deviations or of the target."""
    scale = np.r_[np.ones(3), np.full(3, lever_m)]
    values, vectors = np.linalg.eigh(cov * np.outer(scale, scale))
    steps = n_sigmas * (np.sqrt(np.maximum(values, 0)) * vectors).T / scale
    sizes = np.maximum(
        np.degrees(np.linalg.norm(steps[:, 3:], axis=1)) / target.target_sigma_deg,
        np.linalg.norm(steps[:, :3], axis=1) / target.target_sigma_m,
    )
    steps /= np.minimum(sizes, 1.0)[:, None]
    return np.concatenate([steps, -steps])


def _compare(moves: Array, increases: Array) -> NegativeControl:
    n_captures = len(increases)
    return NegativeControl(moves, increases.mean(axis=0), increases.std(axis=0, ddof=1) / np.sqrt(n_captures))


def control_findings(control: NegativeControl | None) -> list[Finding]:
    """Find a result that held-out captures do not distinguish from a wrong one."""
    if control is None or control.gain_sigmas < 0:
        return []
    move, sigmas = control.moves[control.worst], control.gain_sigmas
    rotation_deg, translation_m = tangent_sizes(move)
    return [
        CONTROL(
            severity="note" if sigmas < SURE_GAIN else failing(sigmas > _FAILS),
            rotation_deg=rotation_deg,
            translation_m=translation_m,
            direction=main_motion(move),
        )
    ]
