"""Rejected captures that agree among themselves on other extrinsics are no outliers: a sensor moved.

A capture that went wrong, by a moving board or another object, errs by itself. Captures after a sensor moved
fit one rigid transform as well as the captures used fit theirs. Each determines its six unknowns alone, so
that two placements leave six degrees of freedom to test it.
"""

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from lce_rig.calibrate.features import extract_features
from lce_rig.calibrate.observations import group_placements
from lce_rig.calibrate.quadratics import Quadratics
from lce_rig.core.board import Board
from lce_rig.core.geometry import Array, difference, exp_so3, invert, perturb, pose
from lce_rig.core.results import Observation
from lce_rig.judge.local_quadratic import SCALE, capture_costs, expand, feature_sigmas
from lce_rig.judge.split_consistency import MEDIAN_CHI2, Contrast, RejectedGroup, make_contrast
from lce_rig.rig import LidarSettings

# Captures agree if their scatter about common extrinsics, per degree of freedom, is at most this multiple of
# that of the captures used; other things rejected scatter a hundred times as far.
_AGREE = 8.0
# Rejected captures in any order, fewer of which agree by chance.
_MIN_GROUP = 3
# More captures of a group do not make the test sharper.
_MAX_TESTED = 12
_N_ROUNDS, _SETTLED = 6, 1e-5
_TURNS = tuple(pose(exp_so3(np.array([0, 0, angle])), np.zeros(3)) for angle in np.radians([0, 90, 180, 270]))


def find_moved(
    used: Sequence[Observation],
    rejected: Sequence[Observation],
    board: Board,
    T_cam_lidar: Array,
    lidar: LidarSettings,
) -> tuple[Contrast, ...]:
    """Look for rejected captures that agree on other extrinsics: the last, the first, or any.

    Args:
        used: the captures of the result.
        rejected: captures in which both sensors see the board within reach of the result.
        board: the board.
        T_cam_lidar: (4, 4) the result.
        lidar: its range error settings.

    Returns:
        The group with the largest gain, compared with the rest; nothing if none agrees.
    """
    if not rejected:
        return ()
    tested = _Test(used, rejected, board, T_cam_lidar, lidar)
    agreeing = [*filter(None, (tested.group(*choice) for choice in _choices(used, rejected)))]
    return (max(agreeing, key=lambda each: each[0])[1],) if agreeing else ()


def _choices(
    used: Sequence[Observation], rejected: Sequence[Observation]
) -> Iterator[tuple[Sequence[Observation], str, str]]:
    """List groups to test with their place in time and neighbour: at least half of each is rejected."""
    names = {observation.capture for observation in rejected}
    every = sorted([*used, *rejected], key=lambda observation: observation.capture)
    for n in range(2, len(every) // 2 + 1):
        for place, group, neighbour in (("last", every[-n:], every[-n - 1]), ("first", every[:n], every[n])):
            if 2 * sum(observation.capture in names for observation in group) >= n:
                yield group, place, neighbour.capture
    if len(rejected) >= _MIN_GROUP:
        yield rejected, "", ""


class _Test:
    """Fits groups of captures alone, by the noise of the captures used."""

    def __init__(
        self,
        used: Sequence[Observation],
        rejected: Sequence[Observation],
        board: Board,
        T_cam_lidar: Array,
        lidar: LidarSettings,
    ) -> None:
        self._board, self._T, self._lidar = board, T_cam_lidar, lidar
        self._names = [observation.capture for observation in used]
        features = [extract_features(observation, board) for observation in used]
        self._sigmas = feature_sigmas(features, board, T_cam_lidar)
        self._rings = np.unique(np.concatenate([o.lidar.ring for o in (*used, *rejected)]))
        self._used = self._expand(used, T_cam_lidar)
        x = self._used.optimum()
        scatter = _own_gains(*self._settled(used, T_cam_lidar, x)) * len(used) / (len(used) - 1)
        self._unit = max(float(np.median(scatter)) / MEDIAN_CHI2, 1e-12)

    def group(
        self, group: Sequence[Observation], place: str, neighbour: str
    ) -> tuple[float, Contrast] | None:
        """Fit a group, and give its gain over the rest's extrinsics; None where its captures disagree."""
        from scipy.special import chdtrc

        names = tuple(observation.capture for observation in group)
        group = group[:: -(-len(group) // _MAX_TESTED)]
        n = int(group_placements(group).max()) + 1
        # Captures of the group that are not tested, being many, are no part of the rest either.
        is_rest = np.array([name not in names for name in self._names], dtype=np.float64)
        if n < 2 or is_rest.sum() < _MIN_GROUP:
            return None
        x = self._used.solve(is_rest[None])[0]
        T_rest = perturb(self._T, x[:6])
        starts = (T_rest, *(_alone(observation, T_rest) for observation in group))
        costs, T_group = min(
            (self._fit(group, start, x) for start in starts), key=lambda each: float(each[0].sum())
        )
        g, H = self._settled(group, T_group, x)
        scatter = float(_own_gains(g, H).sum()) / (6 * (len(group) - 1) * self._unit)
        if scatter > _AGREE:
            return None
        apart = difference(T_group, T_rest)
        H_rest = np.tensordot(is_rest, self._used.hessians, axes=1)[:6, :6]
        cov = self._unit * (np.linalg.inv(H.sum(axis=0)) + np.linalg.inv(H_rest))
        chance = float(chdtrc(6, apart @ np.linalg.solve(cov, apart)))
        # Where the last captures moved, the result holds no longer.
        words = ("before", "after") if place == "last" else ("group", "rest")
        rejected = RejectedGroup(names, place, neighbour)
        gain = float(np.sum(self._costs(group, T_rest) - costs)) * len(names) / len(group)
        return gain, replace(make_contrast(*words, apart, chance, len(names)), rejected=rejected)

    def _fit(self, group: Sequence[Observation], T: Array, x: Array) -> tuple[Array, Array]:
        """Fit extrinsics to a group with the constants of the rest: costs (F,), and the extrinsics."""
        for _ in range(_N_ROUNDS):
            g, H = self._settled(group, T, x)
            step = -np.linalg.solve(H.sum(axis=0) + 0.01 * np.eye(6), g.sum(axis=0))
            T = perturb(T, step)
            if np.abs(step).max() < _SETTLED:
                break
        return self._costs(group, T), T

    def _costs(self, group: Sequence[Observation], T: Array) -> Array:
        features = [extract_features(observation, self._board) for observation in group]
        return np.array([capture_costs(f, self._board, T[None], self._sigmas)[0] for f in features])

    def _settled(self, group: Sequence[Observation], T: Array, x: Array) -> tuple[Array, Array]:
        """Expand a group about T with the constants in x: half gradients (F, 6), half Hessians (F, 6, 6)."""
        expansion, constants = self._expand(group, T), np.r_[np.zeros(6), x[6:]]
        return (expansion.gradients + expansion.hessians @ constants)[:, :6], expansion.hessians[:, :6, :6]

    def _expand(self, observations: Sequence[Observation], T: Array) -> Quadratics:
        return expand(
            observations,
            self._board,
            T,
            laser_bias_sigma_m=self._lidar.laser_bias_sigma_m,
            range_offset_sigma_m=self._lidar.range_offset_sigma_m,
            sigmas=self._sigmas,
            rings=self._rings,
        ).hold(SCALE)


def _own_gains(g: Array, H: Array) -> Array:
    """Compute what each capture (F,) gains by extrinsics of its own over common ones."""
    return np.asarray(np.einsum("ki,ki->k", g, np.linalg.solve(H + np.eye(6), g[..., None])[..., 0]))


def _alone(observation: Observation, T_near: Array) -> Array:
    """Compute T_cam_lidar (4, 4) by one board alone, of its symmetries the nearest to given extrinsics."""
    T_board_lidar = invert(observation.lidar.T_lidar_board)
    poses = [observation.image.T_cam_board @ turn @ T_board_lidar for turn in _TURNS]
    return min(poses, key=lambda T: float(np.linalg.norm(difference(T, T_near)[3:])))
