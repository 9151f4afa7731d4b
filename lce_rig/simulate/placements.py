"""Placements of the board: all over the image, near and far, tilted, and visible to the LiDAR."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from lce_rig.core.board import Board
from lce_rig.core.camera import Intrinsics
from lce_rig.core.errors import LceRigError
from lce_rig.core.geometry import EVEN_STEPS, Array, exp_so3, invert, log_so3, perturb, pose, transform
from lce_rig.simulate.backdrop import lens_reach
from lce_rig.simulate.lidar import LidarModel
from lce_rig.simulate.options import HandMotion, SimulationOptions
from lce_rig.simulate.room import Room
from lce_rig.simulate.scene import Raycaster, Scene

_ATTEMPTS = 400
# Largest tilt out of the direction to the camera.
_TILT_DEG = 40.0
_WANTED_RINGS = 7
_FEWEST_RINGS = 4
_RETURNS_PER_RING = 6
_WANTED_SHARE = 0.8


@dataclass(frozen=True, eq=False)
class CameraView:
    """A camera and a LiDAR; the board must be visible to both. A rig without cameras looks from a LiDAR."""

    camera: str
    intrinsics: Intrinsics
    T_world_cam: Array
    lidar: str
    model: LidarModel
    T_world_lidar: Array

    def is_in_image(self, board: Board, T_world_board: Array) -> bool:
        """Check whether the camera sees the whole pattern, or the whole plate of a plain one."""
        pattern = board.outline() if board.type == "plain" else board.corners()
        middle = pattern.mean(axis=0)
        # The outer squares reach one square beyond the inner corners.
        reach = np.array(board.pattern_size_m) / 2
        outer = middle + np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]]) * np.append(reach, 0.0)
        T_cam_board = invert(self.T_world_cam) @ T_world_board
        pixels, is_valid = self.intrinsics.project(transform(T_cam_board, np.concatenate([pattern, outer])))
        lens = self.intrinsics
        offset = (pixels - [lens.cx_px, lens.cy_px]) / [lens.fx_px, lens.fy_px]
        is_seen = is_valid & lens.is_inside(pixels, 0.01 * lens.width_px)
        return bool(np.all(is_seen & (np.linalg.norm(offset, axis=-1) < 0.97 * lens_reach(lens))))

    def can_be_held(self, board: Board, room: Room, T_world_board: Array) -> bool:
        """Check whether a person can hold the board there, completely visible to camera and LiDAR."""
        return self.is_in_image(board, T_world_board) and self.stands_free(board, room, T_world_board)

    def stands_free(self, board: Board, room: Room, T_world_board: Array) -> bool:
        """Check whether a person can hold the board there, with nothing in front of it."""
        centre, normal = T_world_board[:3, 3], T_world_board[:3, 2]
        if abs(normal[2]) > 0.7:
            return False  # people do not hold a board horizontally
        to_lidar = self.T_world_lidar[:3, 3] - centre
        if normal @ to_lidar < 0.45 * np.linalg.norm(to_lidar):
            return False
        outline = transform(T_world_board, board.outline())
        behind = centre - 0.8 * normal
        footing = np.array([[behind[0], behind[1], 0.6], [centre[0], centre[1], 0.6]])
        if not room.is_free(np.concatenate([outline, footing])).all():
            return False
        eyes = [self.T_world_cam[:3, 3], self.T_world_lidar[:3, 3]]
        return not any(room.raycaster.is_blocked(outline, eye).any() for eye in eyes)

    def seen_share(self, board: Board, T_world_board: Array) -> float:
        """Measure the fraction of the plate's height within the LiDAR's vertical field, 0..1."""
        outline = transform(invert(self.T_world_lidar) @ T_world_board, board.outline())
        elevation = np.arctan2(outline[:, 2], np.hypot(outline[:, 0], outline[:, 1]))
        lasers = self.model.elevations_rad
        margin_rad = np.ptp(lasers) / (len(lasers) - 1) / 2
        top, bottom = elevation.max(), elevation.min()
        seen = min(top, lasers.max() + margin_rad) - max(bottom, lasers.min() - margin_rad)
        return float(np.clip(seen / (top - bottom), 0.0, 1.0))

    def count_rings(self, board: Board, T_world_board: Array) -> int:
        """Count the LiDAR's rings with at least a few returns from the board.

        Without rings, a board within the field of view, with a margin, counts as having enough.
        """
        if self.model.pattern != "rings":
            return _WANTED_RINGS if self._is_in_view(board, T_world_board) else 0
        scene = Scene(Raycaster(()), (), board, T_world_board)
        outline = transform(invert(self.T_world_lidar) @ T_world_board, board.outline())
        azimuth = np.arctan2(outline[:, 1], outline[:, 0])
        spread = np.angle(np.exp(1j * (azimuth - azimuth[0])))
        n_steps = int(np.ceil(np.ptp(spread) / self.model.step_rad)) + 1
        across = azimuth[0] + spread.min() + self.model.step_rad * np.arange(n_steps)
        elevation, around = (
            grid.ravel() for grid in np.meshgrid(self.model.elevations_rad, across, indexing="ij")
        )
        level = np.cos(elevation)
        rays = np.stack([level * np.cos(around), level * np.sin(around), np.sin(elevation)], axis=1)
        hits = scene.cast_board(self.T_world_lidar[:3, 3], rays @ self.T_world_lidar[:3, :3].T)
        returns = (hits.surface >= 0).reshape(len(self.model.elevations_rad), -1).sum(axis=1)
        return int(np.sum(returns >= _RETURNS_PER_RING))

    def _is_in_view(self, board: Board, T_world_board: Array) -> bool:
        """Check whether the plate lies within the pattern of a LiDAR without rings."""
        outline = transform(invert(self.T_world_lidar) @ T_world_board, 1.1 * board.outline())
        azimuth, elevation = (
            np.arctan2(outline[:, 1], outline[:, 0]),
            np.arctan2(outline[:, 2], outline[:, 0]),
        )
        low, high = self.model.elevations_rad.min(), self.model.elevations_rad.max()
        if self.model.pattern == "rosette":
            half = np.ptp(self.model.azimuths_rad) / 2, (high - low) / 2
            return bool(np.all(np.hypot(azimuth / half[0], (elevation - (low + high) / 2) / half[1]) < 0.95))
        elevation = np.arctan2(outline[:, 2], np.hypot(outline[:, 0], outline[:, 1]))
        return bool(np.all((elevation > low) & (elevation < high)))


def place_board(
    view: CameraView,
    board: Board,
    room: Room,
    options: SimulationOptions,
    index: int,
    rng: np.random.Generator,
    start: Array,
) -> Array:
    """Choose T_world_board (4, 4) for one capture.

    Args:
        view: the sensors that must see the board.
        board: the board.
        room: room in which board and carrier must stand free.
        options: ranges of distance and roll.
        index: index of the capture; consecutive ones fill the image evenly.
        rng: source of the tilt and of the next candidates.
        start: (3,) start of the session's even filling, 0..1.

    Raises:
        LceRigError: no placement is visible to both the camera and the LiDAR.
    """
    fallback, most_rings = None, 0
    for attempt in range(_ATTEMPTS):
        # The first tries keep near the even filling, later ones go anywhere.
        even = np.mod(start + (index + 1) * EVEN_STEPS, 1.0)
        wander = min(1.0, attempt / 60)
        where = np.mod(even + wander * rng.uniform(-0.5, 0.5, 3), 1.0)
        T_world_board = _candidate(view, options, where, rng)
        if T_world_board is None or not view.is_in_image(board, T_world_board):
            continue
        if view.seen_share(board, T_world_board) < _WANTED_SHARE:
            continue
        if not view.stands_free(board, room, T_world_board):
            continue
        n_rings = view.count_rings(board, T_world_board)
        if n_rings >= _WANTED_RINGS:
            return T_world_board
        if n_rings > most_rings:
            fallback, most_rings = T_world_board, n_rings
    if fallback is None or most_rings < _FEWEST_RINGS:
        near, far = options.distance_m
        raise LceRigError(
            f"no place for the board {near:g}-{far:g} m before {view.camera} is seen by {view.lidar}",
            "Check the nominal extrinsics of the profile, or let the board come nearer or go farther.",
        )
    return fallback


def _candidate(
    view: CameraView, options: SimulationOptions, where: Array, rng: np.random.Generator
) -> Array | None:
    """Place the board's centre in the image and rotate it about facing the camera."""
    # Evenly over the disc of all tilts: strong tilts constrain the extrinsics most.
    tilt_rad = np.radians(_TILT_DEG) * np.sqrt(rng.uniform())
    direction_rad = rng.uniform(0.0, 2 * np.pi)
    roll_rad = np.radians(options.roll_deg[0] + options.roll_deg[1] * rng.uniform(-1.0, 1.0))
    lens = view.intrinsics
    pixel = (0.12 + 0.76 * where[:2]) * [lens.width_px - 1, lens.height_px - 1]
    ray = view.T_world_cam[:3, :3] @ lens.unproject(pixel)
    if not np.isfinite(ray).all() or np.hypot(ray[0], ray[1]) < 0.5:
        return None
    near, far = options.distance_m
    centre = view.T_world_cam[:3, 3] + (near + (far - near) * where[2]) * ray
    right = np.cross([0.0, 0.0, 1.0], -ray)
    right /= np.linalg.norm(right)
    facing = np.stack([right, np.cross(-ray, right), -ray], axis=1)
    axis = np.array([np.cos(direction_rad), np.sin(direction_rad), 0.0])
    turns = exp_so3(np.stack([tilt_rad * axis, [0.0, 0.0, roll_rad]]))
    return pose(facing @ turns[0] @ turns[1], centre)


_N_SWAYS = 4
#: Distance of a trembling hand from the plate's middle, m: converts its displacement into a rotation.
_ARM_M = 0.4
#: The speed is that of the second before the anchor, whose events form the image.
_SPEED_WINDOW_S = np.linspace(-1.0, 0.2, 61)
_FASTEST_TURN_RAD_S = np.radians(60.0)
_PROBE_NS = 500_000


@dataclass(frozen=True, eq=False)
class Trajectory:
    """The board's pose at any time: still at placements, moving between them, swaying throughout.

    Attributes:
        arrival_ns: (K,) time of arrival at each placement, increasing.
        departure_ns: (K,) time of departure from each.
        T_world_placement: (K, 4, 4).
        frequency_hz: (M,) of the sways.
        amplitude: (M, 6) of each sway's tangent (translation m, world; rotation rad).
        phase_rad: (M, 6), at the first arrival.
        centre: (6,) tangent that is subtracted, so that the board can pass a placement exactly.
    """

    arrival_ns: NDArray[np.int64]
    departure_ns: NDArray[np.int64]
    T_world_placement: Array
    frequency_hz: Array
    amplitude: Array
    phase_rad: Array
    centre: Array

    @property
    def is_still(self) -> bool:
        """Whether the board stays at one pose."""
        return len(self.arrival_ns) == 1 and not len(self.frequency_hz)

    def at(self, t_ns: int | NDArray[np.int64]) -> Array:
        """Compute T_world_board (..., 4, 4) at times (...) of the rig's clock.

        Between placements s = 10 u^3 - 15 u^4 + 6 u^5, minimum jerk from rest to rest.

        References:
            T. Flash and N. Hogan, The coordination of arm movements, J. Neuroscience 5(7), 1985.
        """
        t_ns = np.asarray(t_ns, dtype=np.int64)
        if len(self.arrival_ns) == 1:
            T_world_board = np.broadcast_to(self.T_world_placement[0], (*t_ns.shape, 4, 4))
        else:
            last = len(self.arrival_ns) - 2
            k = np.clip(np.searchsorted(self.arrival_ns, t_ns, side="right") - 1, 0, last)
            since_ns = t_ns - self.departure_ns[k]
            u = np.clip(since_ns / (self.arrival_ns[k + 1] - self.departure_ns[k]), 0.0, 1.0)
            s = u**3 * (10 + u * (6 * u - 15))
            T_world_board = between(self.T_world_placement[k], self.T_world_placement[k + 1], s)
        if not len(self.frequency_hz):
            return T_world_board
        t_s = 1e-9 * (t_ns - self.arrival_ns[0])
        angle = 2 * np.pi * self.frequency_hz[:, None] * t_s[..., None, None] + self.phase_rad
        return perturb(
            T_world_board, np.asarray(np.sum(self.amplitude * np.sin(angle), axis=-2)) - self.centre
        )

    def speed_mps(self, t_ns: int | NDArray[np.int64]) -> Array:
        """Compute the speed (...) of the board's middle."""
        t_ns = np.asarray(t_ns, dtype=np.int64)
        way = self.at(t_ns + _PROBE_NS)[..., :3, 3] - self.at(t_ns - _PROBE_NS)[..., :3, 3]
        return np.asarray(np.linalg.norm(way, axis=-1) / (2e-9 * _PROBE_NS))


def between(start: Array, end: Array, share: float | Array) -> Array:
    """Interpolate between two poses (..., 4, 4) at a fraction (...) of the way, turning evenly."""
    s = np.asarray(share)[..., None]
    turn = log_so3(np.swapaxes(start[..., :3, :3], -1, -2) @ end[..., :3, :3])
    return pose(start[..., :3, :3] @ exp_so3(s * turn), (1 - s) * start[..., :3, 3] + s * end[..., :3, 3])


def hold_board(T_world_board: Array) -> Trajectory:
    """Keep the board permanently at one pose."""
    zero = np.zeros(1, dtype=np.int64)
    none = np.zeros((0, 6))
    return Trajectory(zero, zero, T_world_board[None], np.zeros(0), none, none, np.zeros(6))


def sway_board(
    T_world_board: Array, anchor_ns: int, hand: HandMotion, rng: np.random.Generator
) -> Trajectory:
    """Simulate a hand that moves the board about and through T_world_board (4, 4), the pose at anchor_ns."""
    speed_mps = rng.uniform(*hand.speed_mps)
    frequency_hz, amplitude, phase_rad = _draw_sways(T_world_board, speed_mps, hand, rng)
    anchor = np.array([anchor_ns], dtype=np.int64)
    centre = np.sum(amplitude * np.sin(phase_rad), axis=0)
    return Trajectory(anchor, anchor, T_world_board[None], frequency_hz, amplitude, phase_rad, centre)


def carry_board(
    placements: Sequence[Array], start_ns: int, hand: HandMotion, rng: np.random.Generator
) -> Trajectory:
    """Simulate a hand that carries the board from placement to placement (each (4, 4)), resting at each.

    While it rests, it sways at a quarter of the greatest speed.
    """
    arrivals, departures = [start_ns], [start_ns + round(1e9 * hand.rest_s)]
    for start, end in pairwise(placements):
        way_m = float(np.linalg.norm(end[:3, 3] - start[:3, 3]))
        turn_rad = float(np.linalg.norm(log_so3(start[:3, :3].T @ end[:3, :3])))
        # Minimum-jerk motion is 15/8 as fast in its middle as on average.
        duration_s = 15 / 8 * max(way_m / hand.carry_mps, turn_rad / _FASTEST_TURN_RAD_S)
        arrivals.append(departures[-1] + round(1e9 * max(duration_s, 0.2)))
        departures.append(arrivals[-1] + round(1e9 * hand.rest_s))
    sways = _draw_sways(placements[0], 0.25 * hand.speed_mps[1], hand, rng)
    arrival_ns, departure_ns = np.array(arrivals, dtype=np.int64), np.array(departures, dtype=np.int64)
    return Trajectory(arrival_ns, departure_ns, np.stack(placements), *sways, np.zeros(6))


def _draw_sways(
    T_world_board: Array, speed_mps: float, hand: HandMotion, rng: np.random.Generator
) -> tuple[Array, Array, Array]:
    """Draw frequencies (M,), amplitudes (M, 6) and phases (M, 6) of the given rms speed, and the tremor."""
    frequency_hz = rng.uniform(0.4, 1.2, _N_SWAYS)
    phase_rad = rng.uniform(0, 2 * np.pi, (_N_SWAYS + 1, 6))
    rate = rng.standard_normal((_N_SWAYS, 6))
    # Hands move a board sideways more than towards the sensors.
    normal = T_world_board[:3, 2]
    rate[:, :3] -= 0.6 * (rate[:, :3] @ normal)[:, None] * normal
    angle = 2 * np.pi * frequency_hz[:, None] * _SPEED_WINDOW_S[:, None, None] + phase_rad[:-1]
    drawn = np.sum(rate * np.cos(angle), axis=1)
    fastest_mps = max(hand.speed_mps[1], 1e-9)
    turn_rad_s = np.radians(hand.turn_deg_s) * speed_mps / fastest_mps * rng.uniform(0.5, 1.0)
    for part, wanted in ((slice(0, 3), speed_mps), (slice(3, 6), turn_rad_s)):
        rate[:, part] *= wanted / np.sqrt(np.mean(np.sum(drawn[:, part] ** 2, axis=1)))
    tremor = (
        rng.standard_normal((1, 6)) * hand.tremor_m * np.array([1, 1, 1, 1 / _ARM_M, 1 / _ARM_M, 1 / _ARM_M])
    )
    amplitude = np.concatenate([rate / (2 * np.pi * frequency_hz[:, None]), tremor])
    return np.append(frequency_hz, rng.uniform(5.0, 9.0)), amplitude, phase_rad
