"""Predicted information of a board placement on the extrinsics; placements add up.

A placement becomes the returns, the ring ends and the image's pose that both sensors would measure there. The
likelihood's own rows (`calibrate.likelihood.model`) give its information H_k on the extrinsics and on the
constant errors z that all captures share, the board's pose eliminated. With the priors P and J the derivative
of the extrinsics by z,

    cov = J (sum_k H_k + P)^-1 J^T + M M^T                                                               (1)

M is the effect on the extrinsics of the pattern's offset error on the plate, which a calibration keeps fixed.

Many lasers are grouped: neighbours share one error of range and of angles, smaller by the square root of
their number.
"""

from dataclasses import dataclass, fields, replace

import numpy as np
from numpy.typing import NDArray

from lce_rig.calibrate.likelihood.fit import extrinsics_by_unknowns
from lce_rig.calibrate.likelihood.images import stack_images
from lce_rig.calibrate.likelihood.layout import BOARD, LASER, State
from lce_rig.calibrate.likelihood.model import Terms, assemble, linearise
from lce_rig.calibrate.likelihood.rays import StackedScans, displacements
from lce_rig.calibrate.plane_and_ends import turn_about_z
from lce_rig.calibrate.quadratics import symmetric_inverse
from lce_rig.collect.guidance.sensor_model import SensorModel
from lce_rig.core.geometry import Array, invert, pose, skew
from lce_rig.core.results import BoardPose

# Minimum number of points of a ring: the detector does not fit lines to shorter ones.
FEWEST_POINTS = 6
_SAMPLES = 48
# Positions of the two returns that represent a ring, fractions of its chord: exact for second moments.
_NODES = 0.5 + np.array([-1.0, 1.0]) / np.sqrt(12)
# Noise of a corner per coordinate, px: typical of recordings.
_CORNER_PX = 0.05
# Prior of rough extrinsics, m and rad, which keeps every direction finite.
_PRIOR_SIGMAS = np.repeat([1.0, 0.5], 3)
# Unknowns of a leave-one-out covariance: the extrinsics and the edge shift.
_N_UNKNOWNS = 7
# Unknowns that captures determine or that affect the result, without fixed ones; the pattern is added last.
_UNKNOWNS = ("camera 0", *LASER, "lens", "bow", "shifts", "squares")
_N_PATTERN = BOARD["pattern"]
# Maximum number of groups of lasers.
_MOST_GROUPS = 16
# Placements evaluated at once, to limit memory.
_CHUNK = 200


@dataclass(frozen=True, eq=False)
class Rings:
    """The rings of L lasers on N boards.

    Attributes:
        n_points: (N, L) points of each ring on the board; 0 where the ring is too short to be used.
        ends: (N, L, 2, 2) its entry and exit points, x and y of frame board, m.
    """

    n_points: Array
    ends: Array

    @property
    def n_rings(self) -> NDArray[np.intp]:
        """Rings on each board (N,)."""
        return np.asarray(np.count_nonzero(self.n_points, axis=1))

    def of(self, chosen: NDArray[np.intp]) -> "Rings":
        """Select some of the boards."""
        return Rings(self.n_points[chosen], self.ends[chosen])


def cross_board(model: SensorModel, T_lidar_board: Array) -> Rings:
    """Compute the chords of the rings on boards.

    A laser at elevation a sees at azimuth h the point s u of the plane n . p = n . c, with
    u = (cos a cos h, cos a sin h, sin a) and s = n . c / n . u. Samples over the board's azimuths give the
    part within the plate.

    Args:
        model: the sensors.
        T_lidar_board: (N, 4, 4).
    """
    board, axes, centre = model.board, T_lidar_board[:, :3, :3], T_lidar_board[:, :3, 3]
    azimuth, span = _azimuths(model, T_lidar_board)
    level, rise = np.cos(model.elevations_rad), np.sin(model.elevations_rad)
    # Dot products of each ray with each board's three axes, (N, 3, L, K).
    around = np.cos(azimuth)[:, None] * axes[:, 0, :, None] + np.sin(azimuth)[:, None] * axes[:, 1, :, None]
    along = level[:, None] * around[:, :, None, :] + (rise[:, None] * axes[:, 2, :, None, None])
    to_centre = np.einsum("nji,nj->ni", axes, centre)
    with np.errstate(divide="ignore", invalid="ignore"):
        range_m = to_centre[:, 2, None, None] / along[:, 2]
        xy = range_m[:, None] * along[:, :2] - to_centre[:, :2, None, None]
    half = np.array([board.width_m, board.height_m]) / 2
    is_hit = (range_m > 0) & np.all(np.abs(xy) <= half[:, None, None], axis=1)

    n_hit = is_hit.sum(axis=-1)
    first = is_hit.argmax(axis=-1)
    last = is_hit.shape[-1] - 1 - is_hit[..., ::-1].argmax(axis=-1)
    n_points = n_hit * (span / _SAMPLES)[:, None] / model.azimuth_step_rad
    n_points = np.where(n_points >= FEWEST_POINTS, n_points, 0.0)
    outer = np.stack([first, last], axis=-1)
    ends = np.take_along_axis(xy, outer[:, None], axis=-1).transpose(0, 2, 3, 1)
    # A sample covers half a sample spacing to either side.
    chord = ends[:, :, 1] - ends[:, :, 0]
    beyond = chord / np.maximum(n_hit - 1, 1)[..., None] / 2
    ends = np.stack([ends[:, :, 0] - beyond, ends[:, :, 1] + beyond], axis=2)
    ends = np.where((n_points > 0)[..., None, None], ends, 0.0)
    return Rings(n_points, ends)


def _azimuths(model: SensorModel, T_lidar_board: Array) -> tuple[Array, Array]:
    """Spread samples (N, K) over the azimuths of each plate; also their span (N,)."""
    outline = np.einsum("nij,kj->nki", T_lidar_board[:, :3, :3], model.board.outline())
    outline += T_lidar_board[:, None, :3, 3]
    middle = np.arctan2(T_lidar_board[:, 1, 3], T_lidar_board[:, 0, 3])
    turned = np.arctan2(outline[..., 1], outline[..., 0]) - middle[:, None]
    turned = np.angle(np.exp(1j * turned))
    low, span = turned.min(axis=1), np.ptp(turned, axis=1)
    share = (np.arange(_SAMPLES) + 0.5) / _SAMPLES
    return (middle + low)[:, None] + span[:, None] * share, span


@dataclass(frozen=True, eq=False)
class Evidence:
    """The information of each of N placements.

    Attributes:
        hessians: (N, G, G) H_k, the pattern's place last.
        n_rings: (N,) rings on the board.
        n_points: (N,) points on the board.
    """

    hessians: Array
    n_rings: NDArray[np.intp]
    n_points: Array

    def of(self, chosen: NDArray[np.intp] | NDArray[np.bool_]) -> "Evidence":
        """Select some of the placements."""
        return Evidence(*(getattr(self, field.name)[chosen] for field in fields(self)))


@dataclass(frozen=True, eq=False)
class Precision:
    """Predicted covariances of the extrinsics, tangent (translation m, rotation rad), camera axes.

    Attributes:
        cov: (..., 6, 6) that the calibration will state.
        without_pattern: (..., 6, 6) the same for a pattern whose place on the plate is exact.
    """

    cov: Array
    without_pattern: Array


class Predictor:
    """Weights placements by the likelihood's rows.

    Args:
        model: the sensors.
        T_cam_lidar: (4, 4) rough extrinsics: the profile's nominal ones, or an estimate.
    """

    def __init__(self, model: SensorModel, T_cam_lidar: Array) -> None:
        self._model, self._T_cam_lidar = model, T_cam_lidar
        n_lasers = len(model.elevations_rad)
        n_groups = min(n_lasers, _MOST_GROUPS) if model.pattern == "rings" else 1
        self._group = np.arange(n_lasers) * n_groups // n_lasers
        share = np.sqrt(n_groups / n_lasers) if model.pattern == "rings" else 1.0
        priors, levels = model.priors, model.levels
        self._priors = replace(
            priors.held, azimuth_rad=share * priors.azimuth_rad, elevation_rad=share * priors.elevation_rad
        )
        self._levels = replace(levels, ring_m=share * levels.ring_m, laser_m=share * levels.laser_m)
        # Priors and derivatives do not depend on the board's pose, so take any.
        ahead = _straight_ahead(model)[None]
        terms = self._linearise(T_cam_lidar @ ahead, cross_board(model, ahead))
        kept = terms.state.layout.z.of(_UNKNOWNS)
        self._prior = assemble(terms, self._levels, self._priors).cost.prior[kept[:, None], kept]
        self._prior[:6, :6] += np.diag(_PRIOR_SIGMAS**-2.0)
        self._to_extrinsics = extrinsics_by_unknowns(terms)[0][:, kept]

    def weigh(self, T_cam_board: Array) -> Evidence:
        """Compute the information of boards at T_cam_board (N, 4, 4)."""
        rings = cross_board(self._model, invert(self._T_cam_lidar) @ T_cam_board)
        size = len(self._prior) + _N_PATTERN
        hessians = np.zeros((len(T_cam_board), size, size))
        seen = np.flatnonzero(rings.n_rings)
        for chunk in np.array_split(seen, -(-len(seen) // _CHUNK) or 1):
            if len(chunk):
                terms = self._linearise(T_cam_board[chunk], rings.of(chunk))
                kept = terms.state.layout.z.of([*_UNKNOWNS, "pattern"])
                cost = assemble(terms, self._levels, self._priors).cost
                hessians[chunk] = cost.hessians[:, kept[:, None], kept]
        return Evidence(hessians, rings.n_rings, rings.n_points.sum(axis=1))

    def combine(self, held: Evidence, more: Evidence | None = None, weight: float = 1.0) -> Precision:
        """Predict the covariance of the extrinsics (6, 6) from all placements together, equation (1).

        Args:
            held: the placements captured so far.
            more: N candidate placements, each added alone to `held`; the result is (N, 6, 6).
            weight: number of captures per placement in `held`.
        """
        data = weight * held.hessians.sum(axis=0)
        if more is None:
            return Precision(*self._covariances(data))
        chunks = np.array_split(more.hessians, -(-len(more.hessians) // _CHUNK) or 1)
        parts = [self._covariances(data + chunk) for chunk in chunks]
        cov, without_pattern = (np.concatenate(covs) for covs in zip(*parts, strict=True))
        return Precision(cov, without_pattern)

    def _covariances(self, data: Array) -> tuple[Array, Array]:
        """Compute (1) for information (..., G, G): with the pattern's errors, and without."""
        J, size, factor = self._to_extrinsics, len(self._prior), self._model.inflation
        by_extrinsics = np.linalg.solve(data[..., :size, :size] + self._prior, J.T)
        by_pattern = np.swapaxes(by_extrinsics, -1, -2) @ data[..., :size, size:]
        moves = self._model.priors.pattern_m * by_pattern
        own = factor * (J @ by_extrinsics)
        return own + factor * moves @ np.swapaxes(moves, -1, -2), own

    def _linearise(self, T_cam_board: Array, rings: Rings) -> Terms:
        """Linearise the measurements of boards at T_cam_board (N, 4, 4), which the rings cross."""
        model, T_lidar_board = self._model, invert(self._T_cam_lidar) @ T_cam_board
        scans = self._scans(T_lidar_board, rings)
        images = [
            BoardPose(T, cov, None, np.inf)
            for T, cov in zip(T_cam_board, _pose_covariance(model, T_cam_board), strict=True)
        ]
        stacked = stack_images(np.arange(len(images)), images, model.board.pattern_offset_m)
        state = State.without_errors(self._T_cam_lidar[None], T_lidar_board, len(scans.rings), [0])
        return linearise(scans, [stacked], model.board, state)

    def _scans(self, T_lidar_board: Array, rings: Rings) -> StackedScans:
        """Build the returns and ring ends of boards at T_lidar_board (N, 4, 4).

        Two returns represent a ring, as they have the second moments of all.
        """
        model = self._model
        board, laser = np.nonzero(rings.n_points)
        ends = rings.ends[board, laser]
        nodes = ends[:, :1] + _NODES[:, None] * (ends[:, 1:] - ends[:, :1])
        capture, group = np.repeat(board, 2), np.repeat(self._group[laser], 2)
        T = T_lidar_board[capture]
        points, end_points = (
            np.einsum("nij,nj->ni", T[:, :3, :2], xy.reshape(-1, 2)) + T[:, :3, 3] for xy in (nodes, ends)
        )
        range_m = np.linalg.norm(points, axis=1)
        end_rays = end_points / np.linalg.norm(end_points, axis=1, keepdims=True)
        # The first end of a ring is towards smaller azimuths.
        step_rad = np.tile([-model.azimuth_step_rad, model.azimuth_step_rad], len(board))
        n_made = 2 * np.maximum(rings.n_rings, 1)
        return StackedScans(
            n_captures=len(T_lidar_board),
            rings=np.arange(self._group.max() + 1, dtype=np.int16),
            capture=capture,
            ring=group,
            rays=points / range_m[:, None],
            range_m=range_m,
            fields=displacements(points, T, model.board),
            weight=np.sqrt(rings.n_points.sum(axis=1) / n_made),
            end_capture=capture,
            end_ring=group,
            end_rays=end_rays,
            next_rays=turn_about_z(end_rays, step_rad),
            end_fields=displacements(end_points, T, model.board),
            end_background=np.zeros((len(end_rays), 3)),
            end_beam=np.zeros((len(end_rays), 2)),
            end_sigma=np.zeros(len(end_rays)),
        )


def _straight_ahead(model: SensorModel) -> Array:
    """Return T_lidar_board (4, 4) of a board that faces the LiDAR 2 m ahead, at its median elevation."""
    angle = float(np.median(model.elevations_rad))
    normal = np.array([-np.cos(angle), 0.0, -np.sin(angle)])
    right = np.array([0.0, -1.0, 0.0])
    return pose(np.column_stack([right, np.cross(normal, right), normal]), -2.0 * normal)


def _pose_covariance(model: SensorModel, T_cam_board: Array) -> Array:
    """Predict the covariance (N, 6, 6) of T_cam_board (N, 4, 4) due to corner noise."""
    corners, R = model.board.corners(), T_cam_board[:, :3, :3]
    levers = np.einsum("nij,kj->nki", R, corners)
    by_shift = model.lens.differentiate(levers + T_cam_board[:, None, :3, 3])
    J = np.concatenate([by_shift, -by_shift @ skew(levers)], axis=-1).reshape(len(R), 2 * len(corners), 6)
    return _CORNER_PX**2 * symmetric_inverse(np.swapaxes(J, 1, 2) @ J)


def few_captures_factor(n_captures: int) -> float:
    """Return the small-sample inflation factor of the covariance.

    The factor is that of a leave-one-out covariance (`Quadratics.jackknife_covariance`), which diverges at
    `_N_UNKNOWNS` + 2 captures. With fewer than `_N_UNKNOWNS` + 3 it is extrapolated as 1/n. Few captures
    reveal neither noise nor outliers: with 6 to 8 captures of rlfs02, results differed from that of all 27
    by 0.2 deg, 2 to 3 standard deviations; with 10 captures by 0.1 deg.
    """
    fewest = _N_UNKNOWNS + 3
    if n_captures < fewest:
        return (fewest - 1) * fewest / max(n_captures, 1)
    return (n_captures - 1) / (n_captures - _N_UNKNOWNS - 2)


def sigmas(cov: Array) -> tuple[Array, Array]:
    """Summarise covariances (..., 6, 6) as results do: root of the summed variances.

    Returns:
        Of the rotation in rad and of the translation in m, (...).
    """
    variances = np.diagonal(cov, axis1=-2, axis2=-1)
    return np.sqrt(variances[..., 3:].sum(axis=-1)), np.sqrt(variances[..., :3].sum(axis=-1))


def shortfall(model: SensorModel, cov: Array) -> Array:
    """Return the ratio of covariances (..., 6, 6) to the profile's target, (...).

    It is the root of the summed squares of the standard deviations of rotation and translation, each in units
    of its target. The larger one dominates; of two placements that reduce it equally, the one that also
    reduces the other is better.
    """
    rotation, translation = sigmas(cov)
    return np.asarray(np.hypot(rotation / model.target_sigma_rad, translation / model.target_sigma_m))
