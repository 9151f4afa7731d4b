"""Checks of a result on its own captures, before the verdict.

They have a cost of their own (`local_quadratic.py`), on purpose: the likelihood gives contradicting captures
less weight, and so hides them from a check by its own cost. By that cost, two groups of captures that
disagree by 1.1 and 1.2 deg (acfr_vlp16, os1_64) are not found; acfr_vlp16, 1.0 deg and 51 mm from its
reference, would be reported to 0.22 deg and 10 mm instead of 0.59 deg and 24 mm.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from lce_rig.calibrate.observations import group_placements
from lce_rig.calibrate.plane_and_ends import extract_features
from lce_rig.calibrate.quadratics import Quadratics
from lce_rig.calibrate.result import CalibrationEstimate
from lce_rig.core.board import Board
from lce_rig.core.calibration import Contribution
from lce_rig.core.camera import Intrinsics
from lce_rig.core.findings import Finding
from lce_rig.core.geometry import Array, PoseDifference, difference, exp_so3, invert, perturb, pose
from lce_rig.core.results import Observation
from lce_rig.judge.contributions import (
    find_contradictions,
    list_contributions,
    summed_covariance,
)
from lce_rig.judge.intrinsics_check import IntrinsicsCheck, compare_with_given, model_findings
from lce_rig.judge.local_quadratic import (
    OF_PROFILE,
    SCALE,
    capture_costs,
    expand,
    feature_sigmas,
    pattern_of,
    scale_of,
)
from lce_rig.judge.split_consistency import (
    LEAST_CHANCE,
    MEDIAN_CHI2,
    Contrast,
    contrast_halves,
    find_groups,
    find_turned,
)
from lce_rig.rig import LidarSettings, Rig

MIN_PLACEMENTS = 4
"""Fewer placements do not allow leave-one-out, and do not tell the lasers' angles."""
# Captures agree if their scatter about common extrinsics, per degree of freedom, is at most this multiple of
# that of the captures used; other things rejected scatter a hundred times as far.
_AGREE = 8.0
# Rejected captures in any order, fewer of which agree by chance.
_MIN_GROUP = 3
# More captures of a group do not make the test sharper.
_MAX_TESTED = 12
_N_ROUNDS, _SETTLED = 6, 1e-5
_TURNS = tuple(pose(exp_so3(np.array([0, 0, angle])), np.zeros(3)) for angle in np.radians([0, 90, 180, 270]))


@dataclass(frozen=True, eq=False)
class Validation:
    """Results of checks of an estimate on its own captures.

    Attributes:
        cov: (6, 6) to report, of extrinsics used with the session's intrinsics: the estimate's, with errors
            of the profile and what checks contradict.
        cov_agreed: (6, 6) the same without what checks contradict.
        cov_shared: (6, 6) the part of `cov` from errors of the profile's board and LiDAR.
        contributions: its causes, the largest first.
        contrasts: subsets of the captures that should agree.
        scale: as `scale_of`; None for too few placements.
        pattern: as `pattern_of`, where it contradicts the profile; else None.
        intrinsics: the profile's compared with those fitted to the boards; None for too few boards.
        lens_model: the finding that the profile's does not fit the corners.
    """

    cov: Array
    cov_agreed: Array
    cov_shared: Array
    contributions: tuple[Contribution, ...]
    contrasts: tuple[Contrast, ...]
    scale: tuple[float, float] | None
    pattern: tuple[Array, Array] | None
    intrinsics: IntrinsicsCheck | None
    lens_model: Sequence[Finding]


def validate(
    estimate: CalibrationEstimate,
    rig: Rig,
    lidar: LidarSettings,
    lens: Intrinsics | None,
    rejected: Sequence[Observation] = (),
) -> Validation:
    """Check a result on its own captures.

    Args:
        estimate: the result of any method.
        rig: board, targets and limits.
        lidar: its range error settings.
        lens: of the camera, as the profile says; None where a LiDAR is in its place, which has no scale and
            no pattern.
        rejected: captures in which both sensors see the board, that the estimate does not use.
    """
    board, known = rig.board.to_board(), estimate.sensitivities
    fitted = None if estimate.lens is None else estimate.lens.estimate
    intrinsics = None if fitted is None or lens is None else compare_with_given(fitted, lens, board)
    scale = pattern = None
    contrasts: tuple[Contrast, ...] = ()
    observations = [estimate.fitted[name] for name in estimate.used]
    expansion = expand(
        observations,
        board,
        estimate.T_cam_lidar,
        laser_bias_sigma_m=lidar.laser_bias_sigma_m,
        range_offset_sigma_m=lidar.range_offset_sigma_m,
    )
    if len(expansion.groups) >= MIN_PLACEMENTS:
        if lens is not None:
            scale, pattern = scale_of(expansion), pattern_of(expansion)
            # Neither chance nor the profile's deviation explains an offset that contradicts it.
            cov = pattern[1] + rig.board.pattern_offset_sigma_m**2 * np.eye(2)
            chi2 = pattern[0] @ np.linalg.solve(cov, pattern[0])
            pattern = pattern if np.exp(-chi2 / 2) < LEAST_CHANCE else None
        # A wrong place of the pattern would look like captures that differ.
        settled = expansion.hold((SCALE,) if pattern is not None else OF_PROFILE).settled()
        centres = np.array([observation.image.T_cam_board[:3, 3] for observation in observations])
        of_rejected = find_moved(observations, rejected, board, estimate.T_cam_lidar, lidar)
        names = estimate.used
        contrasts = (
            *of_rejected,
            *contrast_halves(settled, centres, names),
            *find_groups(settled, names),
        )
        if estimate.turns is not None:
            contrasts += find_turned(estimate.turns, centres, settled.groups, names)
    contradictions = list(find_contradictions(estimate, scale, pattern, contrasts, rig))
    cov_agreed = estimate.cov + summed_covariance(known)
    return Validation(
        cov=cov_agreed + summed_covariance(contradictions),
        cov_agreed=cov_agreed,
        # Each session has fitted its own lens.
        cov_shared=summed_covariance([each for each in known if each.source != "intrinsics"]),
        contributions=list_contributions(estimate.diagnostics, known, contradictions),
        contrasts=contrasts,
        scale=scale,
        pattern=pattern,
        intrinsics=intrinsics,
        lens_model=[] if fitted is None or lens is None else model_findings(fitted, board),
    )


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
        self._sigmas = feature_sigmas(features, T_cam_lidar)
        self._rings = np.unique(np.concatenate([o.lidar.ring for o in (*used, *rejected)]))
        self._used = self._expand(used, T_cam_lidar)
        x = self._used.optimum()
        scatter = _own_gains(*self._settled(used, T_cam_lidar, x)) * len(used) / (len(used) - 1)
        self._unit = max(float(np.median(scatter)) / MEDIAN_CHI2, 1e-12)

    def group(
        self, group: Sequence[Observation], place: str, neighbour: str
    ) -> tuple[float, Contrast] | None:
        """Fit a group, and give its gain over the rest's extrinsics; None where its captures disagree."""
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
        chance = PoseDifference(apart, cov).chance
        # Where the last captures moved, the result holds no longer.
        words = ("before", "after") if place == "last" else ("group", "rest")
        gain = float(np.sum(self._costs(group, T_rest) - costs)) * len(names) / len(group)
        return gain, Contrast(*words, apart, chance, names, place, neighbour, is_rejected=True)

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
        return np.array([capture_costs(f, T[None], self._sigmas)[0] for f in features])

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
        ).hold(OF_PROFILE)


def _own_gains(g: Array, H: Array) -> Array:
    """Compute what each capture (F,) gains by extrinsics of its own over common ones."""
    return np.asarray(np.einsum("ki,ki->k", g, np.linalg.solve(H + np.eye(6), g[..., None])[..., 0]))


def _alone(observation: Observation, T_near: Array) -> Array:
    """Compute T_cam_lidar (4, 4) by one board alone, of its symmetries the nearest to given extrinsics."""
    T_board_lidar = invert(observation.lidar.T_lidar_board)
    poses = [observation.image.T_cam_board @ turn @ T_board_lidar for turn in _TURNS]
    return min(poses, key=lambda T: float(np.linalg.norm(difference(T, T_near)[3:])))
