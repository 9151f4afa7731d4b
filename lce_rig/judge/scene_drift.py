"""Compare extrinsics with the edges of a scene: all six axes together, by chi-squared.

The edges give one estimate with a covariance. It differs from the extrinsics by a tangent, whose covariance
is the sum of both. Either answer needs a usable estimate that would show changes within the region searched.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from lce_rig.core.calibration import Calibration, Opinion, SceneOpinion, State
from lce_rig.core.camera import Intrinsics
from lce_rig.core.findings import Finding
from lce_rig.core.geometry import SURPRISING_CHI2, Array, difference, perturb, tangent_sizes
from lce_rig.judge.reach import JointDifference
from lce_rig.scene.estimate import MIN_GAIN, REACH, SceneEstimate, estimate_scene, gain_over
from lce_rig.scene.findings import (
    AMBIGUOUS,
    BEYOND_REACH,
    CHANGED,
    CLOCKS_APART,
    DOUBTFUL,
    ELSEWHERE,
    FEW_EDGES,
    UNCHANGED,
    UNKNOWN,
    WEAK,
)
from lce_rig.scene.outline_score import OutlineView

_OPINIONS: dict[State, Opinion] = {"changed": "contradicts", "unchanged": "agrees", "unknown": "unknown"}
_LEVER_M = float(REACH[0] / REACH[3])  # makes angles comparable with distances


@dataclass(frozen=True, eq=False)
class SceneChange(JointDifference):
    """The difference of a scene's estimate from extrinsics."""

    lever_m: float = _LEVER_M

    @property
    def figures(self) -> dict[str, Any]:
        """The significant part along eigen-directions, its standard deviations and axes, of a finding."""
        rotation_deg, translation_m = tangent_sizes(self.significant)
        return {
            "rotation_deg": rotation_deg,
            "sigma_deg": float(np.degrees(self._sigma(slice(3, 6)))),
            "translation_m": translation_m,
            "sigma_m": self._sigma(slice(3)),
            "axes": self.main_axes,
        }

    def _sigma(self, part: slice) -> float:
        """Return the standard deviation of the rotation or translation (`part`) along its direction."""
        direction = self.significant[part] / max(float(np.linalg.norm(self.significant[part])), 1e-12)
        return float(np.sqrt(direction @ self.cov[part, part] @ direction))


@dataclass(frozen=True, eq=False)
class SceneDrift:
    """Deployed extrinsics compared with the edges of a scene.

    Attributes:
        T_cam_lidar: (4, 4) deployed.
        cov: (6, 6) of these.
        estimate: estimate of the scene.
        n_captures: compared.
        gain: significance of a changed estimate's score over that of the deployed extrinsics (`gain_over`).
        others: further findings; clocks apart prevent an all-clear.
    """

    T_cam_lidar: Array
    cov: Array
    estimate: SceneEstimate
    n_captures: int
    gain: float = np.inf
    others: tuple[Finding, ...] = ()

    @property
    def change(self) -> SceneChange:
        """Tangent from the deployed extrinsics to the estimate."""
        tangent = difference(self.estimate.T_cam_lidar, self.T_cam_lidar)
        return SceneChange(tangent, self.estimate.cov + self.cov)

    @property
    def smallest(self) -> tuple[float, float]:
        """Smallest rotation (deg) and translation (m) in any direction that would be detected."""
        return self.estimate.smallest_changes(self.cov)

    @property
    def judgement(self) -> Finding:
        """The answer, or the reason why it is unknown."""
        estimate, (smallest_deg, smallest_m) = self.estimate, self.smallest
        sizes = {"smallest_deg": smallest_deg, "smallest_m": smallest_m}
        if estimate.state == "few_edges":
            return FEW_EDGES(n_edges=estimate.n_edges, n_captures=self.n_captures)
        if not self.is_located:
            return (WEAK if estimate.state == "weak" else BEYOND_REACH)()
        if self.change.is_changed:
            if self.gain < MIN_GAIN:
                return AMBIGUOUS(**self.change.sizes)
            if estimate.state == "ambiguous":
                return ELSEWHERE(**self.change.sizes)
            return CHANGED(**self.change.figures)
        if np.any(np.array([smallest_m, np.radians(smallest_deg)]) > REACH[[0, 3]]):
            return UNKNOWN(**sizes)
        return (DOUBTFUL if self.change.chi2 > SURPRISING_CHI2 else UNCHANGED)(**sizes)

    @property
    def is_located(self) -> bool:
        """Whether there is a best fit; among several, one near the deployed extrinsics supports these."""
        return self.estimate.state in ("usable", "ambiguous")

    @property
    def state(self) -> State:
        """The verdict."""
        states: dict[str, State] = {
            CHANGED.code: "changed",
            ELSEWHERE.code: "changed",
            UNCHANGED.code: "unchanged",
        }
        return states.get(self.findings[0].code, "unknown")

    @property
    def findings(self) -> tuple[Finding, ...]:
        """The verdict, or the reason for having none, first."""
        judgement = self.judgement
        are_apart = CLOCKS_APART.code in (each.code for each in self.others)
        is_void = not self.n_captures or (are_apart and judgement.code == UNCHANGED.code)
        return self.others if self.others and is_void else (judgement, *self.others)

    @property
    def T_changed(self) -> Array:
        """Deployed extrinsics (4, 4), moved by the significant part of the change."""
        return perturb(self.T_cam_lidar, self.change.significant)

    @property
    def opinion(self) -> SceneOpinion:
        """The comparison as a result keeps it."""
        n_captures, n_edges, change = self.n_captures, self.estimate.n_edges, self.change
        if not self.is_located:
            return SceneOpinion(n_captures, n_edges)
        return SceneOpinion(n_captures, n_edges, _OPINIONS[self.state], change.tangent, change.cov)

    def document(self) -> dict[str, Any]:
        """Return all figures as plain types for JSON."""
        smallest_deg, smallest_m = self.smallest
        return {
            "state": self.state,
            "n_captures": self.n_captures,
            "n_edges": self.estimate.n_edges,
            "smallest_deg": smallest_deg,
            "smallest_m": smallest_m,
            "change": self.change.tangent.tolist(),
            "covariance": self.change.cov.tolist(),
            "chi2": self.change.chi2,
            "gain": self.gain if np.isfinite(self.gain) else None,
        }


def watch_scene(views: Sequence[OutlineView], lens: Intrinsics, calibration: Calibration) -> SceneDrift:
    """Compare extrinsics with the scene of some captures.

    Args:
        views: the captures.
        lens: intrinsics of the camera.
        calibration: the extrinsics and their covariance.
    """
    c = calibration
    estimate = estimate_scene(views, lens, c.T_cam_lidar)
    drift = SceneDrift(c.T_cam_lidar, c.cov, estimate, len(views))
    if not (drift.is_located and drift.change.is_changed):
        return drift
    return replace(drift, gain=gain_over(estimate, views, lens, c.T_cam_lidar, c.cov))
