"""Result of a calibration: extrinsics with uncertainty, certificate and residuals."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from lce_rig.calibrate.likelihood.fit import JointEstimate
from lce_rig.calibrate.observations import group_placements
from lce_rig.calibrate.plane_and_ends import ends_on_board, extract_features, plane_residuals
from lce_rig.calibrate.session_lens import SessionLens
from lce_rig.core.board import Board
from lce_rig.core.calibration import CaptureResidual, Certificate, ChannelResult, Diagnostics, Metrics
from lce_rig.core.findings import Finding, Refusal
from lce_rig.core.geometry import Array, PoseDifference, rotation_angle, sigma_sizes
from lce_rig.core.results import ImageBoard, Observation

BY_ALGORITHM_1 = "algorithm_1"
"""Source of the difference of Algorithm 1's solution from the likelihood's estimate."""


@dataclass(frozen=True, eq=False)
class Sensitivity:
    """Effect of a profile error on the extrinsics when used with the result's intrinsics.

    Also the moves that would resolve a contradiction found by a check: the covariance includes them.

    Attributes:
        source: the erroneous quantity, or the check.
        sigma: its standard deviation, in its own unit.
        moves: (n, 6) tangents (translation m, rotation rad) per unit, of n independent errors of that size.
    """

    source: str
    sigma: float
    moves: Array

    def covariance(self) -> Array:
        """Compute the covariance (6, 6) for the standard deviation of this source."""
        return np.asarray(self.sigma**2 * self.moves.T @ self.moves)


@dataclass(frozen=True, eq=False)
class Start:
    """Initial guess of an estimate: a solution of the captures that agree.

    Attributes:
        T_cam_lidar: (4, 4), p_cam = R p_lidar + t.
        certificate: certificate of Algorithm 1's final cost over all captures used.
        observations: the F captures used, as measured, sorted by name.
        refused: why each other capture is not used.
        held_out_m: (F,) error of each capture in the fits without it.
        diagnostics: further figures.
    """

    T_cam_lidar: Array
    certificate: Certificate
    observations: Sequence[Observation]
    refused: Mapping[str, Refusal]
    held_out_m: Array
    diagnostics: Diagnostics


@dataclass(frozen=True, eq=False)
class CalibrationEstimate:
    """Extrinsics with their uncertainty, certificate and residuals.

    Attributes:
        T_cam_lidar: (4, 4), p_cam = R p_lidar + t.
        cov: (6, 6), tangent (translation m, rotation rad), axes of the camera: from the noise of the captures
            and from the sensors' errors that are common to all of them. Errors of lens and board are not
            included, but in `sensitivities`.
        certificate: certificate of Algorithm 1's final cost over all captures used; other methods start from
            that solution.
        refused: why each other capture is not used.
        observations: capture -> the boards that were paired, as measured, for each capture used, sorted; one
            stands for all that hold the same scan.
        residuals: one per capture used, in the order of `observations`.
        diagnostics: further figures.
        method: method of the estimate, see `CalibrateOptions.method`.
        sensitivities: how far errors of lens and board move the result; empty without
            `EstimateSettings.tolerances`.
        lens: the session's lens, used to fit the boards' poses in the images; None without tolerances.
        lens_of_base: the same for the second of two cameras.
        cov_with_lens: (6, P) cross-covariance of the extrinsics as used and the intrinsics.
        joint: the likelihood's estimate from the same captures, and which of its cameras this is.
        estimated_with: cameras whose extrinsics were estimated together with this one.
        same_scan: the captures that hold the same scan, by the one that stands for them; others are alone.
        channels: channels of the camera, with the time offset of each; empty if they were not separated.
        channel_difference: difference of the extrinsics of two channels; None if they cannot be compared.
        association: errors by which images and scans of some captures do not belong together.
    """

    T_cam_lidar: Array
    cov: Array
    certificate: Certificate
    refused: Mapping[str, Refusal]
    observations: Mapping[str, Observation]
    residuals: tuple[CaptureResidual, ...]
    diagnostics: Diagnostics
    method: str = "paper"
    sensitivities: tuple[Sensitivity, ...] = ()
    lens: SessionLens | None = None
    lens_of_base: SessionLens | None = None
    cov_with_lens: Array = field(default_factory=lambda: np.zeros((6, 0)))
    joint: tuple[JointEstimate, int] | None = None
    estimated_with: tuple[str, ...] = ()
    same_scan: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    channels: tuple[ChannelResult, ...] = ()
    channel_difference: PoseDifference | None = None
    association: tuple[Finding, ...] = ()

    @property
    def used(self) -> tuple[str, ...]:
        """Names of the captures used, sorted."""
        return tuple(self.observations)

    @property
    def metrics(self) -> Metrics:
        """Errors over all captures used, of the boards as measured."""
        return summarise(self.residuals)

    @property
    def as_start(self) -> Start:
        """Return the solution as initial guess for another estimate from the same captures."""
        held_out_m = np.array([residual.held_out_m for residual in self.residuals])
        seen = list(self.observations.values())
        return Start(self.T_cam_lidar, self.certificate, seen, self.refused, held_out_m, self.diagnostics)

    def captures_of(self, names: Iterable[str]) -> set[str]:
        """Name every capture that contains the scan of one of the named captures."""
        return {capture for name in names for capture in self.same_scan.get(name, (name,))}


def report(
    start: Start, T_cam_lidar: Array, cov: Array, board: Board, diagnostics: Diagnostics
) -> CalibrationEstimate:
    """Measure the residuals of extrinsics and assemble the estimate.

    Args:
        start: the captures and the initial guess.
        T_cam_lidar: (4, 4).
        cov: (6, 6) of it, tangent (translation m, rotation rad).
        board: the board.
        diagnostics: the method's own figures.
    """
    scale = squares_scale(diagnostics)
    residuals = tuple(
        capture_residual(T_cam_lidar, observation, board, float(error), scale)
        for observation, error in zip(start.observations, start.held_out_m, strict=True)
    )
    observations = {observation.capture: observation for observation in start.observations}
    figures = replace(
        diagnostics,
        held_out_m=float(np.mean(start.held_out_m)),
        n_placements=float(group_placements(start.observations).max() + 1),
    )
    refused = dict(sorted(start.refused.items()))
    return CalibrationEstimate(T_cam_lidar, cov, start.certificate, refused, observations, residuals, figures)


SIGMAS_OF_PARTS = (
    "sigma_scatter_rotation_deg",
    "sigma_scatter_translation_m",
    "sigma_systematic_rotation_deg",
    "sigma_systematic_translation_m",
)
"""Diagnostics of both parts of a covariance, by the captures' scatter and by constant errors."""


def with_parts(figures: Diagnostics, scatter: Array, systematic: Array) -> Diagnostics:
    """Add the sizes of both parts of a covariance, each (6 + k, 6 + k)."""
    sizes = (*sigma_sizes(scatter), *sigma_sizes(systematic))
    return replace(figures, **dict(zip(SIGMAS_OF_PARTS, sizes, strict=True)))


def lever_arm(observations: Sequence[Observation]) -> float:
    """Compute the rms distance of the boards from the first sensor, m: displacement per rad of rotation."""
    centres = [observation.pose.T_cam_board[:3, 3] for observation in observations]
    return float(np.sqrt(np.mean([centre @ centre for centre in centres])))


def squares_scale(diagnostics: Diagnostics) -> float:
    """Compute the size of the board's squares from profile and LiDAR, relative to the profile's."""
    scale = diagnostics.camera_scale
    return 2.0 - scale if np.isfinite(scale) else 1.0


def with_squares(observation: Observation, squares: float) -> Observation:
    """Move the first sensor's board to the distance expected for squares of `squares` times the size."""
    T_cam_board = observation.pose.T_cam_board.copy()
    T_cam_board[:3, 3] *= squares
    return replace(observation, pose=replace(observation.pose, T_cam_board=T_cam_board))


def capture_residual(
    T_cam_lidar: Array,
    observation: Observation,
    board: Board,
    held_out_m: float = float("nan"),
    squares: float = 1.0,
) -> CaptureResidual:
    """Measure the residuals of one capture under given extrinsics.

    Points are used as measured; ring ends are moved along their rays onto the board's plane
    and compared with the profile's size, without half step or shift.

    Args:
        T_cam_lidar: (4, 4).
        observation: the boards of both sensors.
        board: the board's size.
        held_out_m: held-out error, passed through.
        squares: size of the squares relative to that used for the board's pose in the image.
    """
    observation = with_squares(observation, squares)
    pose = observation.pose
    features = extract_features(observation, board, half_step=False)
    plane = np.abs(plane_residuals(features, T_cam_lidar, observation.surface.points))
    edge = board.outline_distance(ends_on_board(features, T_cam_lidar))
    return CaptureResidual(
        capture=observation.capture,
        plane_mean_m=_mean(plane),
        plane_rms_m=_rms(plane),
        edge_mean_m=_mean(edge),
        edge_rms_m=_rms(edge),
        held_out_m=held_out_m,
        reprojection_px=pose.reprojection_px if isinstance(pose, ImageBoard) else float("nan"),
    )


def summarise(residuals: Sequence[CaptureResidual]) -> Metrics:
    """Average per-capture residuals: MPE, MEE (mean distances) and the rms corner residual."""
    # A scan may show the board without any usable ring end.
    edges = np.array([r.edge_mean_m for r in residuals])
    return Metrics(
        mpe_m=_mean(np.array([r.plane_mean_m for r in residuals])),
        mee_m=_mean(edges[np.isfinite(edges)]),
        reprojection_px=_rms(np.array([r.reprojection_px for r in residuals])),
    )


def error_to_reference(T_cam_lidar: Array, T_reference: Array) -> tuple[float, float]:
    """Compute the paper's EGT: angle in deg and distance in m between extrinsics and a reference (4, 4)."""
    angle = rotation_angle(T_cam_lidar[:3, :3], T_reference[:3, :3])
    return float(np.degrees(angle)), float(np.linalg.norm(T_cam_lidar[:3, 3] - T_reference[:3, 3]))


def _mean(values: Array) -> float:
    return float(np.mean(values)) if len(values) else float("nan")


def _rms(values: Array) -> float:
    return float(np.sqrt(_mean(values**2)))
