"""Compare calibrations of one rig with their reported uncertainties."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from itertools import combinations
from typing import Any

import numpy as np

from lce_rig.core.calibration import Calibration
from lce_rig.core.findings import Finding
from lce_rig.core.geometry import (
    Array,
    chance_of,
    difference,
    mean_pose,
    tangent_sizes,
)
from lce_rig.judge.findings import REPEAT_AGREE, REPEAT_DISAGREE
from lce_rig.judge.reach import JointDifference, covariance_alone, equivalent_extrinsics

# Calibrations disagree if correct ones spread this far with less than this probability.
_CHANCE = 0.01
# If correct ones spread farther with more than this probability, reported uncertainties are conservative.
_GENEROUS = 0.95
# Assumed distance of boards in results that do not state it, m.
_LEVER_M = 2.0


@dataclass(frozen=True)
class PairDifference:
    """The difference of two calibrations.

    Attributes:
        first, second: names of their sessions or results.
        rotation_deg, translation_m: angle and distance between the extrinsics.
        distance: Mahalanobis distance d, d^2 = x^T (cov_1 + cov_2)^-1 x with x the tangent between them;
            for results of the same captures with 2 (cov_1 + cov_2).
        p: probability that correct calibrations differ this much or more.
        axes: those of the most significant part of the difference.
    """

    first: str
    second: str
    rotation_deg: float
    translation_m: float
    distance: float
    p: float
    axes: tuple[str, ...]


@dataclass(frozen=True, eq=False)
class Repeatability:
    """Several calibrations of the same sensors, compared.

    Attributes:
        names: names of the sessions, or of the results of one session.
        camera, lidar: the calibrated sensors.
        T_cam_lidar: (4, 4) mean with equal weights, of extrinsics for the first one's intrinsics.
        deviations: (K, 6) tangents from the mean to each, translation m, rotation rad.
        spread_rotation_deg, spread_translation_m: standard deviation of one calibration, from these.
        reported_rotation_deg, reported_translation_m: the same as reported by the calibrations, rms.
        chi2: least sum of squared distances from one common extrinsic, in units of the reported covariances.
        dof: its mean if these are right.
        p: probability that correct calibrations spread this far or farther.
        differences: differences of each pair.
        odd_one: the session without which the others agree; None if all agree or none can be identified.
        are_independent: whether each has its own captures. If not, common errors stay hidden, and chi2, dof
            and p are those of the pair that differs most, with p times the number of pairs.
    """

    names: tuple[str, ...]
    camera: str
    lidar: str
    T_cam_lidar: Array
    deviations: Array
    spread_rotation_deg: float
    spread_translation_m: float
    reported_rotation_deg: float
    reported_translation_m: float
    chi2: float
    dof: int
    p: float
    differences: tuple[PairDifference, ...]
    odd_one: str | None
    are_independent: bool = True

    @property
    def agrees(self) -> bool:
        """Whether the reported uncertainties explain the spread."""
        return self.p >= _CHANCE

    @property
    def ratio(self) -> float:
        """Ratio of the spread to the prediction of the reported uncertainties."""
        return float(np.sqrt(self.chi2 / self.dof))

    @property
    def max_rotation_deg(self) -> float:
        """Largest angle between two of them."""
        return max(pair.rotation_deg for pair in self.differences)

    @property
    def max_translation_m(self) -> float:
        """Largest distance between two of them."""
        return max(pair.translation_m for pair in self.differences)

    @property
    def finding(self) -> Finding:
        """Whether they agree, "repeat.agree" or "repeat.disagree", with its figures."""
        figures: dict[str, Any] = {
            "camera": self.camera,
            "lidar": self.lidar,
            "n_sessions": len(self.names),
            "are_independent": self.are_independent,
            "rotation_deg": self.max_rotation_deg,
            "translation_m": self.max_translation_m,
            "p": self.p,
        }
        if self.agrees:
            return REPEAT_AGREE(is_generous=self.p > _GENEROUS, **figures)
        action = "overlays" if not self.are_independent else "" if self.odd_one is None else "odd_one"
        worst = min(self.differences, key=lambda pair: pair.p)
        figures |= {"first": worst.first, "second": worst.second, "axes": worst.axes}
        return REPEAT_DISAGREE(action=action, ratio=self.ratio, odd_one=self.odd_one, **figures)


def compare_calibrations(
    calibrations: Mapping[str, Calibration], *, are_independent: bool = True
) -> Repeatability:
    """Compare calibrations of the same camera and LiDAR by projected points, each with its own lens.

    Results of the same captures share errors to an unknown extent. For any correlation, the covariance of
    a - b is at most 2 (cov_a + cov_b), because that of a + b is not negative: this bound is used for them.

    Args:
        calibrations: by the name of their session or result, at least two.
        are_independent: whether each was made from captures of its own.
    """
    names = tuple(calibrations)
    lenses = [calibrations[name].intrinsics for name in names]
    lens, models = lenses[0], {each and (each.model, len(each.distortion)) for each in lenses}
    if lens is not None and len(models) == 1:
        # A session's extrinsics compensate the rotation of its own lens.
        calibrations = {
            name: replace(c, T_cam_lidar=equivalent_extrinsics(c, lens)) for name, c in calibrations.items()
        }
        cov = np.array([calibrations[name].cov for name in names])
    else:
        cov = np.array([covariance_alone(calibrations[name]) for name in names])
    T = np.array([calibrations[name].T_cam_lidar for name in names])
    if are_independent:
        # Errors of a lens and board that all sessions share do not make their results differ.
        cov = cov - np.array([calibrations[name].cov_shared for name in names])
    # A mean weighted by full covariances may lie outside all values, which is right for chi2 but confusing in
    # a table.
    mean, _ = mean_pose(T, np.broadcast_to(np.eye(6), cov.shape))
    deviations = difference(T, mean)
    pairs = list(combinations(range(len(names)), 2))
    factor = 1.0 if are_independent else 2.0
    differences = []
    for i, j in pairs:
        distances_m = [d for k in (i, j) for d in calibrations[names[k]].board_distances_m]
        lever_m = float(np.mean(distances_m)) if distances_m else _LEVER_M
        apart = JointDifference(difference(T[i], T[j]), factor * (cov[i] + cov[j]), lever_m)
        distance, sizes = float(np.sqrt(apart.chi2)), tangent_sizes(apart.tangent)
        differences.append(
            PairDifference(names[i], names[j], *sizes, distance, apart.chance, apart.main_axes)
        )
    if are_independent:
        chi2, dof = _spread(T, cov), 6 * (len(names) - 1)
        p = chance_of(chi2, dof)
    else:
        chi2, dof = max(pair.distance for pair in differences) ** 2, 6
        p = min(1.0, len(pairs) * chance_of(chi2, dof))
    blamed = []
    if are_independent and p < _CHANCE and len(names) > 2:
        # Sessions that must be removed for the others to agree.
        for k, name in enumerate(names):
            rest = np.arange(len(names)) != k
            if chance_of(_spread(T[rest], cov[rest]), 6 * (len(names) - 2)) >= _CHANCE:
                blamed.append(name)
    first = calibrations[names[0]]
    spread = np.sum(deviations**2, axis=0) / (len(names) - 1)
    return Repeatability(
        names=names,
        camera=first.camera,
        lidar=first.lidar,
        T_cam_lidar=mean,
        deviations=deviations,
        spread_rotation_deg=float(np.degrees(np.sqrt(spread[3:].sum()))),
        spread_translation_m=float(np.sqrt(spread[:3].sum())),
        reported_rotation_deg=float(np.degrees(np.sqrt(np.mean(np.trace(cov[:, 3:, 3:], axis1=1, axis2=2))))),
        reported_translation_m=float(np.sqrt(np.mean(np.trace(cov[:, :3, :3], axis1=1, axis2=2)))),
        chi2=chi2,
        dof=dof,
        p=p,
        differences=tuple(differences),
        odd_one=blamed[0] if len(blamed) == 1 else None,
        are_independent=are_independent,
    )


def _spread(T: Array, cov: Array) -> float:
    """Compute chi2, the minimum sum of squared Mahalanobis distances from one pose."""
    weights = np.asarray(np.linalg.inv(cov))
    deviations = difference(T, mean_pose(T, weights)[0])
    return float(np.einsum("ki,kij,kj->", deviations, weights, deviations))
