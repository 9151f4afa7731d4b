"""Sensor models for guidance: their accuracy for a board, and the reachable placements."""

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from lce_rig.calibrate.likelihood.levels import EXACT, Levels, Priors, what_is_known
from lce_rig.calibrate.options import CalibrateOptions, EstimateSettings, KnownLidar, Tolerances
from lce_rig.core.board import Board
from lce_rig.core.camera import Intrinsics
from lce_rig.core.data_sheets import DATA_SHEETS
from lce_rig.core.errors import ProfileError
from lce_rig.core.geometry import EVEN_STEPS, Array, exp_so3, invert, pose
from lce_rig.detect.image.quality import LEAST_MARKED_PX, LEAST_SQUARE_PX
from lce_rig.rig import QualitySettings, Rig


@dataclass(frozen=True, eq=False)
class SensorModel:
    """A camera and a LiDAR that see one board.

    Attributes:
        board: the board.
        lens: the camera.
        elevations_rad: (L,) of the LiDAR's rings, lowest first.
        azimuth_step_rad: angle between neighbouring firings of one ring.
        pattern, width_rad: how its beams sweep the field of view, and its width; as `DataSheet` has them.
        limits: the profile's limits for a capture.
        target_sigma_rad, target_sigma_m: target standard deviations of the extrinsics.
        priors, levels: the likelihood's constant errors and noise levels; levels are learned from captures.
        inflation: factor by which the calibration of these captures widens its covariance, as they scatter.
    """

    board: Board
    lens: Intrinsics
    elevations_rad: Array
    azimuth_step_rad: float
    limits: QualitySettings
    target_sigma_rad: float
    target_sigma_m: float
    priors: Priors = field(default_factory=Priors)
    levels: Levels = field(default_factory=Levels)
    inflation: float = 1.0
    pattern: str = "rings"
    width_rad: float = 2 * np.pi

    @classmethod
    def of(cls, rig: Rig, camera: str, lidar: str) -> "SensorModel":
        """Build the model of a pair of sensors from a profile.

        Raises:
            ProfileError: the beams of the LiDAR's model are not known.
        """
        settings = rig.lidars[lidar]
        sheet = settings.data_sheet()
        if sheet is None:
            names = ", ".join(sheet.name for sheet in DATA_SHEETS)
            raise ProfileError(
                f"lidars.{lidar}.model: no guidance for {settings.model}, its beams are not known",
                f"set elevations_deg, collect without guidance, or use one of {names}",
            )
        tolerances = Tolerances.of(rig.cameras[camera], rig.board)
        options = EstimateSettings.of(CalibrateOptions(), settings, tolerances)
        priors, levels = what_is_known(options)
        if options.known is not None:
            priors, levels = _as_measured(priors, levels, options.known)
        return cls(
            board=rig.board.to_board(),
            lens=rig.cameras[camera].to_intrinsics(),
            elevations_rad=sheet.rings_rad,
            azimuth_step_rad=sheet.step_rad(settings.rate_hz),
            limits=rig.quality,
            target_sigma_rad=float(np.radians(rig.calibration.target_sigma_deg)),
            target_sigma_m=rig.calibration.target_sigma_m,
            priors=priors,
            levels=replace(levels, range_m=sheet.range_sigma_m, laser_m=max(levels.laser_m, EXACT)),
            pattern=sheet.pattern,
            width_rad=float(np.radians(sheet.fov_deg[0])),
        )


def _as_measured(priors: Priors, levels: Levels, known: KnownLidar) -> tuple[Priors, Levels]:
    """Replace the priors of a LiDAR's errors by the rms of errors measured earlier."""
    range_m, azimuth_rad, elevation_rad = np.sqrt(np.mean(known.lasers_sigma**2, axis=1)).tolist()
    lateral_m, vertical_m = known.lens_sigma.tolist()
    measured = replace(
        priors,
        known=None,
        azimuth_rad=azimuth_rad,
        elevation_rad=elevation_rad,
        lateral_m=lateral_m,
        vertical_m=vertical_m,
    )
    return measured, replace(levels, laser_m=range_m)


#: Minimum planned distance of the board from the camera, m: closer, it exceeds the image or the LiDAR's field
#: of view.
NEAREST_M = 1.2
#: Tilts of planned placements, deg: none, and two rings of directions; steeper ones shorten the squares.
TILTS_DEG = (0.0, 22.0, 42.0)
N_TILT_DIRECTIONS = 8
_N_TILTS = 8
#: Rotation as a diamond, deg: each ring then crosses two slanted edges.
DIAMOND_DEG = 45.0
ROLLS_DEG = (-12.0, 0.0, 12.0)
#: Fraction of the plate's height that must lie within the LiDAR's vertical field of view.
SEEN_SHARE = 0.8
# Scale of the plate that must lie within the field of view of a LiDAR without rings: a truncated plate is
# refused.
_FREE_SHARE = 1.2
#: Lowest and highest position of the board's centre relative to the LiDAR, m: the reach of a person's arms.
REACH_M = (-0.9, 0.8)
# Free border of the image, as a fraction of its width: people do not hold the board to the pixel.
_MARGIN = 0.03
_GRAZING_COSINE = 0.45


@dataclass(frozen=True, eq=False)
class SensorPlace:
    """Positions of the camera, the LiDAR and the ground.

    Attributes:
        model: the sensors.
        T_cam_lidar: (4, 4) rough extrinsic.
    """

    model: SensorModel
    T_cam_lidar: Array

    @property
    def up(self) -> Array:
        """Unit vector upwards (3,), frame camera: the z axis of the LiDAR, assumed upright."""
        return np.asarray(self.T_cam_lidar[:3, 2])

    @classmethod
    def nominal(cls, rig: Rig, camera: str, lidar: str) -> "SensorPlace":
        """Place the camera by the profile's nominal extrinsics.

        Raises:
            ProfileError: there are none, or the beams of the LiDAR's model are not known.
        """
        nominal = rig.nominal(camera, lidar)
        if nominal is None:
            raise ProfileError(
                f"rig {rig.name!r} has no nominal extrinsics of {camera} and {lidar}",
                "Add them under nominal_extrinsics.",
            )
        return cls(SensorModel.of(rig, camera, lidar), nominal.to_matrix())


def spread_candidates(view: SensorPlace, n_places: int) -> Array:
    """Generate poses T_cam_board (N, 4, 4) visible to both sensors, evenly over the reachable space.

    Args:
        view: the sensors.
        n_places: places of the board's centre, over the image and the distances, that are tried.
    """
    lens = view.model.lens
    even = np.mod(0.5 + np.arange(1, n_places + 1)[:, None] * EVEN_STEPS, 1.0)
    pixels = (0.1 + 0.8 * even[:, :2]) * [lens.width_px - 1, lens.height_px - 1]
    rays = lens.unproject(pixels)
    far_m = view.model.limits.max_distance_m
    # Equal steps in 1/distance: nearby boards differ more from one another.
    distance_m = 1 / (1 / NEAREST_M + (1 / far_m - 1 / NEAREST_M) * even[:, 2])
    # List all tilts (T, 2) about the level axis and the upward one, rad.
    straight, *tilted = np.radians(TILTS_DEG)
    direction = 2 * np.pi * np.arange(N_TILT_DIRECTIONS) / N_TILT_DIRECTIONS
    circle = np.stack([np.cos(direction), np.sin(direction)], axis=1)
    tilts = np.concatenate([[[straight, straight]], *(tilt_rad * circle for tilt_rad in tilted)])
    # Use some of the tilts at each place and the following ones at the next place.
    which = np.arange(n_places * _N_TILTS)
    tilt = tilts[(which * 5) % len(tilts)]
    roll = np.radians(DIAMOND_DEG + np.array(ROLLS_DEG)[(which // len(tilts)) % len(ROLLS_DEG)])
    place = which // _N_TILTS
    is_known = np.isfinite(rays[place]).all(axis=1)
    place, tilt, roll = place[is_known], tilt[is_known], roll[is_known]
    poses = face_camera(view, rays[place], distance_m[place], tilt, roll)
    return poses[is_reachable(view, poses)]


def face_camera(view: SensorPlace, rays: Array, distance_m: Array, tilt_rad: Array, roll_rad: Array) -> Array:
    """Build T_cam_board (N, 4, 4) of boards that face the camera, tilted and rolled.

    Args:
        view: the sensors.
        rays: (N, 3) unit vectors from the camera to the board's centre.
        distance_m: (N,).
        tilt_rad: (N, 2) about the board's horizontal axis (to the right as the camera sees it) and about the
            axis square to it, upwards.
        roll_rad: (N,) about its normal, 0 with level width.
    """
    facing = facing_axes(view, rays)
    turns = np.concatenate([tilt_rad, np.zeros((len(tilt_rad), 1))], axis=1)
    rolls = np.concatenate([np.zeros((len(roll_rad), 2)), roll_rad[:, None]], axis=1)
    return pose(facing @ exp_so3(turns) @ exp_so3(rolls), distance_m[:, None] * rays)


def facing_axes(view: SensorPlace, rays: Array) -> Array:
    """Build the axes (N, 3, 3) of boards that face the camera: horizontally right, up, towards the camera."""
    right = np.cross(view.up, -rays)
    right /= np.maximum(np.linalg.norm(right, axis=1, keepdims=True), 1e-9)
    return np.stack([right, np.cross(-rays, right), -rays], axis=-1)


def is_reachable(view: SensorPlace, T_cam_board: Array) -> NDArray[np.bool_]:
    """Find which poses (N, 4, 4) a person can hold and both sensors see, (N,)."""
    model, limits = view.model, view.model.limits
    centre, normal = T_cam_board[:, :3, 3], T_cam_board[:, :3, 2]
    distance_m = np.linalg.norm(centre, axis=1)
    ok = (distance_m >= max(NEAREST_M, limits.min_distance_m) - 1e-6) & (distance_m <= limits.max_distance_m)

    cosine = np.sum(-normal * centre, axis=1) / distance_m
    focal_px = min(model.lens.fx_px, model.lens.fy_px)
    square_px = focal_px * model.board.square_m / distance_m * cosine
    ok &= cosine > np.cos(np.radians(limits.max_tilt_deg))
    least_px = LEAST_MARKED_PX if model.board.has_markers else LEAST_SQUARE_PX
    ok &= square_px > max(least_px, limits.min_square_px)

    outline = np.einsum("nij,kj->nki", T_cam_board[:, :3, :3], model.board.outline()) + centre[:, None]
    pixels, is_valid = model.lens.project(outline)
    ok &= np.all(is_valid & model.lens.is_inside(pixels, _MARGIN * model.lens.width_px), axis=1)

    ok &= _is_in_lidar_view(view, outline)

    to_lidar = view.T_cam_lidar[:3, 3] - centre
    range_m = np.linalg.norm(to_lidar, axis=1)
    ok &= np.sum(normal * to_lidar, axis=1) > _GRAZING_COSINE * range_m
    height_m = -to_lidar @ view.up
    ok &= (height_m > REACH_M[0]) & (height_m < REACH_M[1])
    # People do not hold a board horizontally.
    return np.asarray(ok & (np.abs(normal @ view.up) < 0.7))


def _is_in_lidar_view(view: SensorPlace, outline: Array) -> NDArray[np.bool_]:
    """Check which outlines (N, K, 3), frame camera, the LiDAR sees: whole; with rings, `SEEN_SHARE`."""
    model, T_lidar_cam = view.model, invert(view.T_cam_lidar)
    if model.pattern != "rings":
        middle = outline.mean(axis=1, keepdims=True)
        outline = middle + _FREE_SHARE * (outline - middle)
    seen = outline @ T_lidar_cam[:3, :3].T + T_lidar_cam[:3, 3]
    elevation = np.arctan2(seen[..., 2], np.hypot(seen[..., 0], seen[..., 1]))
    lasers = model.elevations_rad
    if model.pattern == "rings":
        half_gap = np.ptp(lasers) / (len(lasers) - 1) / 2
        top, bottom = elevation.max(axis=1), elevation.min(axis=1)
        covered = np.minimum(top, lasers.max() + half_gap) - np.maximum(bottom, lasers.min() - half_gap)
        return np.asarray(covered >= SEEN_SHARE * (top - bottom))
    across = 2 * np.arctan2(seen[..., 1], seen[..., 0]) / model.width_rad
    upwards = (2 * elevation - lasers.max() - lasers.min()) / np.ptp(lasers)
    off = np.hypot(across, upwards) if model.pattern == "rosette" else np.maximum(abs(across), abs(upwards))
    return np.asarray(np.all(off <= 1, axis=1))
