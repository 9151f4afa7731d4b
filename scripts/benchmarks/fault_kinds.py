"""Faults of sessions: each takes a sound simulated session and gives what detectors would have seen."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np

from benchmarks.fault_sessions import WRONG_PLATES_M, SimulatedScans, with_plate
from benchmarks.intrinsics import imperfect_corners
from lce_rig.core.board import Board
from lce_rig.core.camera import Intrinsics
from lce_rig.core.findings import Refusal
from lce_rig.core.geometry import Array, exp_so3, fit_plane, invert, perturb, pose, transform
from lce_rig.core.planar_pose import solve_planar_pose
from lce_rig.core.results import LidarBoard
from lce_rig.detect.detection import ImageDetection, LidarDetection
from lce_rig.detect.image.search import board_from_pose
from lce_rig.rig import Rig

# Noise of a corner per coordinate, as recordings of the rigs show it.
_CORNER_SIGMA_PX = {"rlfs": 0.03, "rles": 0.05}
_OTHER_CORNER_SIGMA_PX = 0.05
_BEND_M = 0.005
Rng = np.random.Generator


@dataclass(frozen=True, eq=False)
class Case:
    """What a calibration is given, profile and detections by capture, and the truth it is held against."""

    rig: Rig
    images: Mapping[str, ImageDetection]
    scans: Mapping[str, LidarDetection]
    T_cam_lidar: Array


@dataclass(frozen=True, eq=False)
class _Photographer:
    """Draws the corners of boards from their true poses, and solves for poses as the profile lets it.

    Attributes:
        rig: the profile.
        lens: the true lens.
        corners: (N, 3) where the true board's corners are, frame board.
        rng: of the noise.
    """

    rig: Rig
    lens: Intrinsics
    corners: Array
    rng: Rng

    @classmethod
    def of(cls, rig: Rig, rng: Rng, lens: Intrinsics | None = None) -> "_Photographer":
        board = rig.board.to_board()
        return cls(rig, lens or _lens(rig), imperfect_corners(board, rng), rng)

    def take(self, T_cam_board: Mapping[str, Array]) -> dict[str, ImageDetection]:
        return {name: self._see(T) for name, T in T_cam_board.items()}

    def _see(self, T_cam_board: Array) -> ImageDetection:
        pixels, is_valid = self.lens.project(transform(T_cam_board, self.corners))
        if not (is_valid.all() and self.lens.is_inside(pixels, 1.0).all()):
            return Refusal("image.near_border")
        sigma_px = _CORNER_SIGMA_PX.get(self.rig.name, _OTHER_CORNER_SIGMA_PX)
        pixels = pixels + sigma_px * self.rng.standard_normal(pixels.shape)
        solved = solve_planar_pose(pixels, self.rig.board.to_board().corners(), _lens(self.rig))
        if solved is None or solved.reprojection_px > self.rig.quality.max_reprojection_px:
            return Refusal("image.no_pose")
        return board_from_pose(pixels, solved)


def _lens(rig: Rig) -> Intrinsics:
    return next(iter(rig.cameras.values())).to_intrinsics()


def sound(scans: SimulatedScans, rig: Rig, rng: Rng) -> Case:
    """Nothing is wrong."""
    return Case(rig, _Photographer.of(rig, rng).take(scans.T_cam_board), scans.scans, scans.T_cam_lidar)


def wrong_squares(scans: SimulatedScans, rig: Rig, rng: Rng) -> Case:
    """The squares are 1.5 to 5 % larger or smaller than the profile says."""
    camera = _Photographer.of(rig, rng)
    factor = 1 + rng.choice([-1, 1]) * rng.uniform(0.015, 0.05)
    camera = replace(camera, corners=camera.corners * [factor, factor, 1])
    return Case(rig, camera.take(scans.T_cam_board), scans.scans, scans.T_cam_lidar)


def wrong_plate(scans: SimulatedScans, rig: Rig, rng: Rng) -> Case:
    """The plate is 10 or 25 mm smaller than the profile says, or 25 mm larger."""
    kind = str(rng.choice(list(WRONG_PLATES_M)))
    images = _Photographer.of(rig, rng).take(scans.T_cam_board)
    return Case(with_plate(rig, WRONG_PLATES_M[kind]), images, scans.resized[kind], scans.T_cam_lidar)


def stale_intrinsics(scans: SimulatedScans, rig: Rig, rng: Rng) -> Case:
    """The lens was exchanged: focal length 1 to 3 % other, centre 5 to 15 px, distortion up to 20 %."""
    images = _Photographer.of(rig, rng, exchanged_lens(rig, rng)).take(scans.T_cam_board)
    return Case(rig, images, scans.scans, scans.T_cam_lidar)


def exchanged_lens(rig: Rig, rng: Rng) -> Intrinsics:
    """Draw the lens that takes the pictures of `stale_intrinsics`."""
    lens = _lens(rig)
    factor = 1 + rng.choice([-1, 1]) * rng.uniform(0.01, 0.03)
    pixels_per_size = lens.width_px / 1280
    shift = rng.uniform(5, 15) * pixels_per_size * direction(rng, 2)
    bend = rng.uniform(0.8, 1.2)
    return replace(
        lens,
        fx_px=factor * lens.fx_px,
        fy_px=factor * lens.fy_px,
        cx_px=lens.cx_px + shift[0],
        cy_px=lens.cy_px + shift[1],
        distortion=tuple(bend * k for k in lens.distortion),
    )


def late_pictures(scans: SimulatedScans, rig: Rig, rng: Rng) -> Case:
    """A board is moved by hand and pictures are 20 to 100 ms late; every other time always the same way."""
    offset_s = rng.uniform(0.02, 0.1)
    is_one_way = rng.random() < 0.5
    way = direction(rng, 3)
    moved = {}
    for name, T in scans.T_cam_board.items():
        late_s = offset_s + rng.uniform(-0.025, 0.025)
        velocity = rng.uniform(0.05, 0.3) * (way if is_one_way else direction(rng, 3))
        turn = np.radians(rng.uniform(0, 12)) * direction(rng, 3)
        # The board turns about its own middle, whose place the translation gives.
        moved[name] = perturb(T, late_s * np.concatenate([velocity, turn]))
    return Case(rig, _Photographer.of(rig, rng).take(moved), scans.scans, scans.T_cam_lidar)


def nudged(scans: SimulatedScans, rig: Rig, rng: Rng) -> Case:
    """The camera is nudged by 0.5 to 3 deg and 5 to 40 mm in the middle third; its last place counts."""
    tangent = np.concatenate(
        [rng.uniform(0.005, 0.04) * direction(rng, 3), np.radians(rng.uniform(0.5, 3)) * direction(rng, 3)]
    )
    # Seen from the camera everything else moves.
    T_after_before = perturb(np.eye(4), tangent)
    names = list(scans.T_cam_board)
    since = round(len(names) * rng.uniform(1 / 3, 2 / 3))
    poses = {
        name: T_after_before @ T if k >= since else T for k, (name, T) in enumerate(scans.T_cam_board.items())
    }
    images = _Photographer.of(rig, rng).take(poses)
    return Case(rig, images, scans.scans, T_after_before @ scans.T_cam_lidar)


def decoys(scans: SimulatedScans, rig: Rig, rng: Rng) -> Case:
    """In a fifth of the captures something else passes for the board: always near behind it, or anywhere."""
    names = list(scans.scans)
    fooled = rng.choice(names, size=round(len(names) / 5), replace=False)
    is_behind = rng.random() < 0.5
    behind_m = rng.uniform(0.04, 0.3)
    changed = dict(scans.scans)
    for name in fooled:
        found = changed[name]
        if isinstance(found, Refusal):
            continue
        centre = found[0].T_lidar_board[:3, 3]
        ray = centre / np.linalg.norm(centre)
        shift = behind_m * ray if is_behind else rng.uniform(0.05, 1.0) * direction(rng, 3)
        turn = exp_so3(np.radians(rng.uniform(0, 10 if is_behind else 40)) * direction(rng, 3))
        changed[name] = [_moved(found[0], pose(turn, centre + shift - turn @ centre))]
    images = _Photographer.of(rig, rng).take(scans.T_cam_board)
    return Case(rig, images, changed, scans.T_cam_lidar)


def bent_board(scans: SimulatedScans, rig: Rig, rng: Rng) -> Case:
    """The plate is bent by 5 mm along one of its sides, this way or that."""
    board = rig.board.to_board()
    sign, side = rng.choice([-1, 1]), int(rng.integers(2))
    camera = _Photographer.of(rig, rng)
    bow = np.zeros_like(camera.corners)
    bow[:, 2] = _bow(camera.corners, board, side, sign)
    camera = replace(camera, corners=camera.corners + bow)
    bent: dict[str, LidarDetection] = {}
    for name, found in scans.scans.items():
        if isinstance(found, Refusal):
            bent[name] = found
            continue
        T_board_lidar = invert(scans.T_cam_board[name]) @ scans.T_cam_lidar
        bent[name] = [_bent(found[0], T_board_lidar, board, side, sign), *found[1:]]
    return Case(rig, camera.take(scans.T_cam_board), bent, scans.T_cam_lidar)


def near_parallel(scans: SimulatedScans, rig: Rig, rng: Rng) -> Case:
    """All boards face nearly the same way: normals within 1 to 5 deg (1 sigma) of each other."""
    images = _Photographer.of(rig, rng).take(scans.parallel_poses)
    return Case(rig, images, scans.parallel_scans, scans.T_cam_lidar)


def swapped_cameras(scans: SimulatedScans, rig: Rig, rng: Rng) -> Case:
    """The pictures are another camera's: 8 to 30 cm aside, turned by up to 60 deg, with a similar lens."""
    name = next(iter(rig.cameras))
    lens = _lens(rig)
    factor = 1 + 0.01 * rng.standard_normal()
    shift = 0.01 * lens.width_px * rng.standard_normal(2)
    own = replace(
        lens,
        fx_px=factor * lens.fx_px,
        fy_px=factor * lens.fy_px,
        cx_px=lens.cx_px + shift[0],
        cy_px=lens.cy_px + shift[1],
    )
    yaw = exp_so3(np.radians(rng.uniform(0, 60)) * np.array([0.0, 1.0, 0.0]))
    T_other_own = pose(yaw, rng.choice([-1, 1]) * np.array([rng.uniform(0.08, 0.3), 0.0, 0.0]))
    nominal = [entry for entry in rig.nominal_extrinsics if entry.camera == name]
    expected = T_other_own @ nominal[0].to_matrix()
    # The profile is right about the camera it names; the pictures come from the other one.
    entry = nominal[0].model_copy(
        update={
            "quaternion_wxyz": None,
            "rpy_deg": None,
            "matrix": tuple(tuple(map(float, row)) for row in expected[:3, :3]),
            "translation_m": tuple(map(float, expected[:3, 3])),
        }
    )
    swapped = rig.model_copy(update={"nominal_extrinsics": (entry,)})
    images = _Photographer.of(rig, rng, own).take(scans.T_cam_board)
    return Case(swapped, images, scans.scans, T_other_own @ scans.T_cam_lidar)


def direction(rng: Rng, n: int) -> Array:
    """Draw a unit vector of n dimensions."""
    v = rng.standard_normal(n)
    return np.asarray(v / np.linalg.norm(v))


def _moved(board: LidarBoard, T: Array) -> LidarBoard:
    """Put a board of the LiDAR elsewhere."""
    normal = T[:3, :3] @ board.plane[:3]
    d = board.plane[3] - float(normal @ T[:3, 3])
    return replace(
        board,
        points=transform(T, board.points),
        edge_points=transform(T, board.edge_points),
        plane=np.append(normal, d),
        T_lidar_board=T @ board.T_lidar_board,
    )


def _bow(points_board: Array, board: Board, side: int, sign: int) -> Array:
    """Height (N,) of a bent plate over its flat one at points (N, 3), frame board."""
    half_m = (board.width_m, board.height_m)[side] / 2
    return np.asarray(sign * _BEND_M * (1 - (points_board[:, side] / half_m) ** 2))


def _bent(found: LidarBoard, T_board_lidar: Array, board: Board, side: int, sign: int) -> LidarBoard:
    """Move the LiDAR's points along their rays onto the bent plate."""

    def onto(points: Array) -> Array:
        height_m = _bow(transform(T_board_lidar, points), board, side, sign)
        along = points @ found.plane[:3]
        return np.asarray(points * ((along + height_m) / along)[:, None])

    points = onto(found.points)
    plane, rms_m = fit_plane(points)
    lifted = found.T_lidar_board.copy()
    lifted[:3, 3] += sign * _BEND_M * 2 / 3 * found.plane[:3]
    return replace(
        found,
        points=points,
        edge_points=onto(found.edge_points),
        plane=plane,
        sigma_m=rms_m,
        T_lidar_board=lifted,
    )


KINDS: Mapping[str, Callable[[SimulatedScans, Rig, Rng], Case]] = {
    "none": sound,
    "squares 1.5 to 5 % wrong": wrong_squares,
    "plate 10 or 25 mm wrong": wrong_plate,
    "stale intrinsics": stale_intrinsics,
    "pictures 20 to 100 ms late, board moving": late_pictures,
    "camera nudged half-way": nudged,
    "decoy in a fifth of the captures": decoys,
    "plate bent by 5 mm": bent_board,
    "boards nearly parallel": near_parallel,
    "cameras swapped": swapped_cameras,
}
