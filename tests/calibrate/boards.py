"""A small simulator of detected boards: a spinning LiDAR and a camera in front of one board per capture."""

from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import islice

import numpy as np

from lce_rig.core.board import Board
from lce_rig.core.camera import Intrinsics
from lce_rig.core.geometry import exp_so3, fit_plane, invert, perturb, pose, project_to_so3, transform
from lce_rig.core.planar_pose import solve_planar_pose
from lce_rig.core.results import LidarBoard, LidarQuality, Observation
from lce_rig.detect.image.search import board_from_pose
from lce_rig.judge.contributions import summed_covariance
from lce_rig.lens.difference import turn_of_lens
from lce_rig.lens.models import model_of

BOARD = Board(cols=8, rows=6, square_m=0.07, width_m=0.767, height_m=0.626)
CAMERA = Intrinsics(897.0, 897.0, 639.5, 359.5, 1280, 720, "radtan", (-0.44, 0.23, -0.001, 0.0002, -0.07))
# Camera looking along the LiDAR's x axis, rotated by some degrees about every axis.
T_FORWARD = pose(
    project_to_so3(np.array([[0.777, -0.629, 0.007], [0.006, -0.003, -1.0], [0.629, 0.777, 0.002]])),
    np.array([-0.008, -0.069, -0.084]),
)


@dataclass(frozen=True)
class Scenario:
    """Settings of the simulation: noise, beam, and the board's poses."""

    range_sigma_m: float = 0.01
    laser_bias_sigma_m: float = 0.0
    range_offset_m: float = 0.0
    corner_sigma_px: float = 0.1
    footprint_m: float = 0.0
    end_sigma_m: float = 0.0
    lost_share: float = 0.0
    step_deg: float = 0.2
    tilt_deg: tuple[float, float] = (10.0, 45.0)
    distance_m: tuple[float, float] = (1.2, 3.5)
    facing_deg: float | None = None
    template_sigma_rad: float = 0.03
    template_sigma_m: float = 0.01


def claim(estimate):
    """Covariance (6, 6) of an estimate with errors of the profile."""
    return estimate.cov + summed_covariance(estimate.sensitivities)


def simulate(n, seed, scenario=None, T_cam_lidar=T_FORWARD, board=BOARD):
    """Simulate n captures in which both sensors see the board."""
    made, source = _session(seed, scenario or Scenario(), T_cam_lidar.tobytes(), board)
    made += islice(source, max(0, n - len(made)))
    return made[:n]


@lru_cache(maxsize=100)
def _session(seed, scenario, T_cam_lidar, board):
    """Keep what was simulated of a session, and what goes on with it: many tests ask for the same one."""
    return [], _captures(seed, scenario, np.frombuffer(T_cam_lidar).reshape(4, 4), board)


def _captures(seed, scenario, T_cam_lidar, board):
    rng = np.random.default_rng(seed)
    # A generator of their own: the captures of a seed are otherwise the same with and without biases.
    laser_rng = np.random.default_rng([seed, 1])
    bias_m = scenario.laser_bias_sigma_m * laser_rng.standard_normal(16)
    bias_m += scenario.range_offset_m - bias_m.mean()
    n_seen = 0
    while True:
        T_cam_board = random_pose(rng, scenario, board)
        lidar = scan_board(invert(T_cam_lidar) @ T_cam_board, rng, scenario, board, bias_m)
        image = photograph(T_cam_board, rng, scenario, board)
        if lidar is not None and image is not None:
            yield Observation(f"{n_seen:06d}", image, lidar)
            n_seen += 1


def random_pose(rng, scenario, board):
    """Draw T_cam_board somewhere in the picture, facing the camera but for a tilt and a roll."""
    pixel = rng.uniform(0.15, 0.85, 2) * [CAMERA.width_px, CAMERA.height_px]
    centre = CAMERA.unproject(pixel) * rng.uniform(*scenario.distance_m)
    tilt = np.radians(rng.uniform(*scenario.tilt_deg))
    if scenario.facing_deg is not None:
        tilt = np.radians(scenario.facing_deg) * abs(rng.standard_normal())
    angle = rng.uniform(0, 2 * np.pi)
    roll = np.radians(45) + np.radians(rng.uniform(-25, 25))
    facing = np.diag([1.0, -1.0, -1.0])
    R = exp_so3(tilt * np.array([np.cos(angle), np.sin(angle), 0])) @ facing @ exp_so3(np.array([0, 0, roll]))
    return pose(R, centre)


def photograph(T_cam_board, rng, scenario, board):
    """Measure the corners with noise and solve for both poses; None if the board leaves the image."""
    pixels, is_valid = CAMERA.project(transform(T_cam_board, board.corners()))
    if not (is_valid.all() and CAMERA.is_inside(pixels, 3.0).all()):
        return None
    pixels = pixels + scenario.corner_sigma_px * rng.standard_normal(pixels.shape)
    solved = solve_planar_pose(pixels, board.corners(), CAMERA)
    return None if solved is None else board_from_pose(pixels, solved)


def scan_board(T_lidar_board, rng, scenario, board, bias_m=0.0):
    """Fire 16 rings at a board; ring ends lie up to `footprint_m` outside it, some are lost.

    Each ring's ranges are off by its `bias_m`.
    """
    R, centre = T_lidar_board[:3, :3], T_lidar_board[:3, 3]
    step = np.radians(scenario.step_deg)
    middle, reach = np.arctan2(centre[1], centre[0]), 0.7 / np.hypot(centre[0], centre[1])
    phase = rng.uniform(0, step, 16)[:, None]
    azimuth = middle + phase + step * np.arange(-int(reach / step), int(reach / step) + 1)[None]
    elevation = np.radians(np.arange(-15, 16, 2))[:, None]
    rays = np.stack(
        [
            np.cos(elevation) * np.cos(azimuth),
            np.cos(elevation) * np.sin(azimuth),
            np.sin(elevation) + 0 * azimuth,
        ],
        axis=-1,
    )
    ranges = (R[:, 2] @ centre) / (rays @ R[:, 2])
    on_board = (rays * ranges[..., None] - centre) @ R
    # A beam of this width still hits the board this far beyond an edge, farther along a board seen obliquely.
    wide = scenario.footprint_m * np.hypot(1, (rays @ R)[..., :2] / (rays @ R)[..., 2:])
    half = np.array([board.width_m, board.height_m]) / 2 + wide
    if scenario.end_sigma_m > 0:
        jitter = scenario.end_sigma_m * rng.standard_normal((16, 2))
        half = half + jitter[:, (azimuth[0] > middle).astype(int), None]
    is_hit = (ranges > 0) & np.all(np.abs(on_board[..., :2]) <= half, axis=-1)
    first, last = is_hit.argmax(axis=1), is_hit.shape[1] - 1 - is_hit[:, ::-1].argmax(axis=1)
    lost = rng.random((16, 2)) < scenario.lost_share
    first, last = first + lost[:, 0], last - lost[:, 1]
    rings = np.flatnonzero(is_hit.sum(axis=1) >= 8)
    if len(rings) < 4:
        return None
    columns = np.arange(is_hit.shape[1])
    is_hit &= (columns >= first[:, None]) & (columns <= last[:, None])
    is_hit[np.setdiff1d(np.arange(16), rings)] = False
    measured = (
        ranges + np.reshape(bias_m, (-1, 1)) + scenario.range_sigma_m * rng.standard_normal(ranges.shape)
    )
    points = rays * measured[..., None]
    plane, rms = fit_plane(points[is_hit])
    in_plane = exp_so3(
        np.array([0, 0, scenario.template_sigma_rad * rng.standard_normal() + np.pi * rng.integers(2)])
    )
    z = np.cross(R[:, 0], R[:, 1])
    template = pose(
        project_to_so3(np.column_stack([R[:, 0], R[:, 1], z])) @ in_plane,
        centre + scenario.template_sigma_m * rng.standard_normal(3),
    )
    return LidarBoard(
        points=points[is_hit],
        ring=np.nonzero(is_hit)[0].astype(np.int16),
        edge_points=np.concatenate([points[rings, first[rings]], points[rings, last[rings]]]),
        edge_ring=np.concatenate([rings, rings]).astype(np.int16),
        edge_side=np.repeat(np.array([-1, 1], dtype=np.int8), len(rings)),
        edge_behind_m=np.full(2 * len(rings), np.inf),
        edge_echo=np.zeros(2 * len(rings)),
        azimuth_step_rad=step,
        plane=plane,
        sigma_m=rms,
        T_lidar_board=template,
        quality=measured_plate(BOARD.width_m, BOARD.height_m, points[is_hit]),
    )


def measured_plate(width_m, height_m, points, *, sigma_m=np.inf, n_rings=8):
    """A detector's figures of a plate; by default without its size."""
    return LidarQuality(
        width_m=width_m,
        height_m=height_m,
        width_sigma_m=sigma_m,
        height_sigma_m=sigma_m,
        n_rings=n_rings,
        n_points=len(points),
        n_ring_ends=2 * n_rings,
        n_ring_ends_dropped=0,
        plane_rms_m=0.01,
        edge_rms_m=0.01,
        template_m=0.01,
        beyond_share=0.0,
        distance_m=2.0,
    )


def with_decoy(item, decoy, *, is_first):
    """Add a decoy to the LiDAR's candidates."""
    places = (decoy, *item.places) if is_first else (*item.places, decoy)
    return replace(item, surface=places[0], others=places[1:])


def in_use(T_cam_lidar, lens):
    """Turn extrinsics (4, 4) back as the error of the estimated lens, with which they are used, does."""
    model = model_of(lens)
    turn = turn_of_lens(lens) @ (model.vector(lens) - model.vector(CAMERA))
    return perturb(T_cam_lidar, np.append(np.zeros(3), turn))
