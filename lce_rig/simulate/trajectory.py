"""The motion of a hand-held board: smooth, seeded, through every placement."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from lce_rig.core.geometry import Array, exp_so3, log_so3, perturb, pose
from lce_rig.simulate.options import HandMotion

_N_SWAYS = 4
_SWAY_HZ = (0.4, 1.2)
_TREMOR_HZ = (5.0, 9.0)
#: Distance from the plate's middle at which a trembling hand holds it, m: turns its way into an angle.
_ARM_M = 0.4
#: The speed is that of the second before the anchor, whose events form the image.
_SPEED_WINDOW_S = np.linspace(-1.0, 0.2, 61)
_FASTEST_TURN_RAD_S = np.radians(60.0)
_PROBE_NS = 500_000


@dataclass(frozen=True, eq=False)
class Trajectory:
    """The board's pose at any time: still at placements, moving between them, swaying throughout.

    Attributes:
        arrival_ns: (K,) when the board reaches each placement, increasing.
        departure_ns: (K,) when it leaves each.
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
    """Keep the board at one pose for ever."""
    zero = np.zeros(1, dtype=np.int64)
    none = np.zeros((0, 6))
    return Trajectory(zero, zero, T_world_board[None], np.zeros(0), none, none, np.zeros(6))


def sway_board(
    T_world_board: Array, anchor_ns: int, hand: HandMotion, rng: np.random.Generator
) -> Trajectory:
    """Let a hand move the board about and through T_world_board (4, 4), where it is at anchor_ns exactly."""
    speed_mps = rng.uniform(*hand.speed_mps)
    frequency_hz, amplitude, phase_rad = _draw_sways(T_world_board, speed_mps, hand, rng)
    anchor = np.array([anchor_ns], dtype=np.int64)
    centre = np.sum(amplitude * np.sin(phase_rad), axis=0)
    return Trajectory(anchor, anchor, T_world_board[None], frequency_hz, amplitude, phase_rad, centre)


def carry_board(
    placements: Sequence[Array], start_ns: int, hand: HandMotion, rng: np.random.Generator
) -> Trajectory:
    """Let a hand carry the board from placement to placement (each (4, 4)), resting at each for a while.

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
    frequency_hz = rng.uniform(*_SWAY_HZ, _N_SWAYS)
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
    return np.append(frequency_hz, rng.uniform(*_TREMOR_HZ)), amplitude, phase_rad
