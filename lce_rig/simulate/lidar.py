"""A spinning LiDAR: beam table, firing times, finite beams with mixed pixels, and the errors of real ones."""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, fields, replace

import numpy as np
from numpy.typing import NDArray

from lce_rig.core.data import Scan
from lce_rig.core.geometry import Array, invert, transform
from lce_rig.simulate.beams import Returns, receive
from lce_rig.simulate.options import LidarNoise
from lce_rig.simulate.scene import Scene

#: Fraction of a full diffuse return (reflectivity 1, normal incidence) below which nothing is detected ...
_THRESHOLD = 0.04
#: ... up to this range; beyond it the threshold grows with the square of the range.
_FULL_RANGE_M = 30.0
_RANGE_STEP_M = 0.002
_AZIMUTH_STEP_RAD = np.radians(0.01)
# 16 sequences of a VLP-16 take 0.9 ms: a board at 0.3 m/s is seen within 0.14 mm of where it is.
_FIRINGS_PER_INSTANT = 256
# No beam is wider than this, half its width, at the nearest that a body may be.
_MARGIN_RAD, _NEAREST_M = 0.04, 0.5


@dataclass(frozen=True, eq=False)
class LidarModel:
    """The geometry and timing of a spinning LiDAR.

    Attributes:
        name: of the model.
        elevations_rad: (L,) of each laser, in firing order.
        vertical_offsets_m: (L,) height of each laser's optical centre, in firing order.
        firing_ns: time between two lasers of a sequence.
        sequence_ns: time between two sequences.
        period_ns: of one revolution.
        cut_azimuth_rad: where a scan begins; the rotor turns clockwise as seen from above.
    """

    name: str
    elevations_rad: Array
    vertical_offsets_m: Array
    firing_ns: int
    sequence_ns: int
    period_ns: int
    cut_azimuth_rad: float = np.pi

    @property
    def rings(self) -> NDArray[np.int16]:
        """The rank of each laser's elevation (L,), 0 = lowest."""
        return np.asarray(np.argsort(np.argsort(self.elevations_rad)), dtype=np.int16)

    @property
    def step_rad(self) -> float:
        """Turn of the rotor from one sequence to the next."""
        return 2 * np.pi * self.sequence_ns / self.period_ns


# VLP-16 User Manual 63-9243 Rev D, table 9-1: elevations and vertical corrections by laser id; 600 rpm.
VLP16 = LidarModel(
    name="vlp16",
    elevations_rad=np.radians([-15, 1, -13, 3, -11, 5, -9, 7, -7, 9, -5, 11, -3, 13, -1, 15]),
    vertical_offsets_m=1e-3
    * np.array([11.2, -0.7, 9.7, -2.2, 8.1, -3.7, 6.6, -5.1, 5.1, -6.6, 3.7, -8.1, 2.2, -9.7, 0.7, -11.2]),
    firing_ns=2_304,
    sequence_ns=55_296,
    period_ns=100_000_000,
)


def simulate_scan(
    scene: Scene,
    T_world_lidar: Array,
    model: LidarModel,
    noise: LidarNoise,
    rng: np.random.Generator,
    *,
    board_at: Callable[[NDArray[np.int64]], Array] | None = None,
    laser_bias_m: Array | None = None,
    sensor: str = "lidar",
    stamp_ns: int = 0,
    min_range_m: float = 0.4,
    max_range_m: float = 100.0,
) -> Scan:
    """Simulate one revolution.

    Args:
        scene: what the beams meet.
        T_world_lidar: (4, 4).
        model: the LiDAR's geometry and timing.
        noise: its errors.
        rng: source of the azimuth phase and of all noise.
        board_at: T_world_board (N, 4, 4) at times (N,) ns of the timestamp's clock; None for the scene's.
        laser_bias_m: (L,) constant range offset of each laser in firing order; zeros by default.
        sensor: name in the rig profile.
        stamp_ns: device time of the first firing.
        min_range_m: nearer returns are not reported.
        max_range_m: farther returns are not reported.
    """
    sweep = sweep_scene(scene, T_world_lidar, model, noise, rng, stamp_ns, board_at)
    return measure_sweep(
        sweep,
        model,
        noise,
        rng,
        laser_bias_m=laser_bias_m,
        sensor=sensor,
        stamp_ns=stamp_ns,
        min_range_m=min_range_m,
        max_range_m=max_range_m,
    )


@dataclass(frozen=True, eq=False)
class Sweep:
    """The surfaces hit by the beams of one revolution, without measurement errors.

    Attributes:
        laser: (N,) of each firing, in firing order.
        offset_ns: (N,) after the first firing.
        azimuth_rad: (N,).
        returns: of each firing.
        is_rim: (N,) whether the beam met the board's border.
    """

    laser: NDArray[np.intp]
    offset_ns: NDArray[np.int64]
    azimuth_rad: Array
    returns: Returns
    is_rim: NDArray[np.bool_]


def sweep_scene(
    scene: Scene,
    T_world_lidar: Array,
    model: LidarModel,
    noise: LidarNoise,
    rng: np.random.Generator,
    stamp_ns: int = 0,
    board_at: Callable[[NDArray[np.int64]], Array] | None = None,
) -> Sweep:
    """Send the beams of one revolution; for the arguments see `simulate_scan`."""
    laser, offset_ns, azimuth_rad = _firings(model, rng)
    origins_world, directions_world = _beams(model, T_world_lidar, laser, azimuth_rad)
    if board_at is None:
        returns = receive(scene, origins_world, directions_world, noise)
        is_rim = _near_border(scene, origins_world, directions_world, returns, noise)
    else:
        instants = _instants(scene, board_at, stamp_ns + offset_ns)
        returns, is_rim = _receive_moving(instants, origins_world, directions_world, noise)
    return Sweep(laser, offset_ns, azimuth_rad, returns, is_rim)


def sweep_again(
    empty: Sweep, scene: Scene, T_world_lidar: Array, model: LidarModel, noise: LidarNoise
) -> Sweep:
    """Send the beams of a scan of the standing room once more, with the board and its carrier in it.

    Only those that may hit them are traced; all others keep their returns.

    Args:
        empty: the returns without the board and its carrier.
        scene: the same room with them.
        T_world_lidar, model, noise: as for the scan.
    """
    near = np.flatnonzero(_may_meet(scene, T_world_lidar, empty.azimuth_rad))
    origins, directions = _beams(model, T_world_lidar, empty.laser[near], empty.azimuth_rad[near])
    part = receive(scene, origins, directions, noise)
    whole = [getattr(empty.returns, each.name).copy() for each in fields(Returns)]
    for values, each in zip(whole, fields(Returns), strict=True):
        values[near] = getattr(part, each.name)
    is_rim = empty.is_rim.copy()
    is_rim[near] = _near_border(scene, origins, directions, part, noise)
    return replace(empty, returns=Returns(*whole), is_rim=is_rim)


def _may_meet(scene: Scene, T_world_lidar: Array, azimuth_rad: Array) -> NDArray[np.bool_]:
    """Find which beams at azimuths (N,) may meet the board or its carrier."""
    bodies = [surface.mesh.vertices for surface in scene.moving.surfaces]
    bodies.append(transform(scene.T_world_board, scene.board.outline()))
    points = transform(invert(T_world_lidar), np.concatenate(bodies))
    if np.hypot(points[:, 0], points[:, 1]).min() < _NEAREST_M:
        return np.ones(len(azimuth_rad), dtype=np.bool_)
    x, y = points[:, :2].mean(axis=0)
    middle_rad = np.arctan2(y, x)
    spread = np.angle(np.exp(1j * (np.arctan2(points[:, 1], points[:, 0]) - middle_rad)))
    around = np.angle(np.exp(1j * (azimuth_rad - middle_rad)))
    return np.asarray((around > spread.min() - _MARGIN_RAD) & (around < spread.max() + _MARGIN_RAD))


def measure_sweep(
    sweep: Sweep,
    model: LidarModel,
    noise: LidarNoise,
    rng: np.random.Generator,
    *,
    laser_bias_m: Array | None = None,
    sensor: str = "lidar",
    stamp_ns: int = 0,
    min_range_m: float = 0.4,
    max_range_m: float = 100.0,
) -> Scan:
    """Measure the surfaces hit by the beams; for the arguments see `simulate_scan`."""
    laser, returns = sweep.laser, sweep.returns
    bias_m = np.zeros(len(model.elevations_rad)) if laser_bias_m is None else laser_bias_m
    range_m, intensity = _measure(returns, bias_m[laser], noise, rng)
    spread_rad = noise.rim_spread_rad * rng.uniform(-1.0, 1.0, len(range_m))
    azimuth_rad = sweep.azimuth_rad + np.where(sweep.is_rim, spread_rad, 0.0)
    if noise.is_quantised:
        azimuth_rad = np.rint(azimuth_rad / _AZIMUTH_STEP_RAD) * _AZIMUTH_STEP_RAD
    is_lost = rng.random(len(range_m)) < noise.dropout
    threshold = _THRESHOLD * np.maximum(returns.range_m / _FULL_RANGE_M, 1.0) ** 2
    keep = np.isfinite(range_m) & (returns.energy > threshold) & ~is_lost
    keep &= (range_m >= min_range_m) & (range_m <= max_range_m)
    origins = np.zeros((len(laser), 3))
    origins[:, 2] = model.vertical_offsets_m[laser]
    rays = _directions(model.elevations_rad[laser[keep]], azimuth_rad[keep])
    return Scan(
        sensor=sensor,
        stamp_ns=stamp_ns,
        points=(origins[keep] + range_m[keep, None] * rays).astype(np.float32),
        intensity=intensity[keep].astype(np.float32),
        ring=model.rings[laser[keep]],
        offset_ns=sweep.offset_ns[keep],
        host_ns=stamp_ns + model.period_ns,
    )


def _instants(
    scene: Scene, board_at: Callable[[NDArray[np.int64]], Array], t_ns: NDArray[np.int64]
) -> Iterator[tuple[slice, Scene]]:
    """Cut firings at times (N,) into stretches during which the board hardly moves, each with its scene."""
    edges = np.append(np.arange(0, len(t_ns), _FIRINGS_PER_INSTANT), len(t_ns))
    middles_ns = (t_ns[edges[:-1]] + t_ns[edges[1:] - 1]) // 2
    for first, last, T_world_board in zip(edges[:-1], edges[1:], board_at(middles_ns), strict=True):
        yield slice(int(first), int(last)), scene.with_board_at(T_world_board)


def _receive_moving(
    instants: Iterable[tuple[slice, Scene]], origins: Array, directions: Array, noise: LidarNoise
) -> tuple[Returns, NDArray[np.bool_]]:
    """Trace each stretch of beams (N, 3) in its own scene; also return which hit the board's border."""
    parts, rims = [], []
    for beams, scene in instants:
        parts.append(receive(scene, origins[beams], directions[beams], noise))
        rims.append(_near_border(scene, origins[beams], directions[beams], parts[-1], noise))
    fields = ("range_m", "energy", "reflectivity", "surface")
    return Returns(*(np.concatenate([getattr(p, name) for p in parts]) for name in fields)), np.concatenate(
        rims
    )


def _measure(
    returns: Returns, bias_m: Array, noise: LidarNoise, rng: np.random.Generator
) -> tuple[Array, Array]:
    """Turn returns into measured ranges (N,) and intensities (N,), 100 for a white diffuse surface."""
    intensity = np.clip(100.0 * returns.energy, 0.0, 255.0)
    range_m = returns.range_m + bias_m + noise.range_offset_m
    range_m += noise.dark_bias_m * (1.0 - returns.reflectivity)
    range_m += noise.weak_bias_m * np.clip(1.0 - intensity / 30.0, 0.0, 1.0)
    range_m += noise.range_sigma_m * rng.standard_normal(len(range_m))
    if noise.is_quantised:
        return np.rint(range_m / _RANGE_STEP_M) * _RANGE_STEP_M, np.rint(intensity)
    return range_m, intensity


def _beams(
    model: LidarModel, T_world_lidar: Array, laser: NDArray[np.intp], azimuth_rad: Array
) -> tuple[Array, Array]:
    """Find where beams (N,) begin and where they go, (N, 3) each, world."""
    origins = np.zeros((len(laser), 3))
    origins[:, 2] = model.vertical_offsets_m[laser]
    directions = _directions(model.elevations_rad[laser], azimuth_rad)
    return transform(T_world_lidar, origins), directions @ T_world_lidar[:3, :3].T


def _firings(
    model: LidarModel, rng: np.random.Generator
) -> tuple[NDArray[np.intp], NDArray[np.int64], Array]:
    """List laser, time after the first firing and azimuth of one revolution's firings."""
    n_lasers = len(model.elevations_rad)
    n_sequences = int(model.period_ns // model.sequence_ns)
    laser = np.tile(np.arange(n_lasers), n_sequences)
    sequence = np.repeat(np.arange(n_sequences), n_lasers)
    offset_ns = (sequence * model.sequence_ns + laser * model.firing_ns).astype(np.int64)
    # The rotor is not synchronised with the firings: each scan begins anywhere within one step.
    start_rad = model.cut_azimuth_rad - model.step_rad * rng.uniform()
    azimuth_rad = start_rad - 2 * np.pi * offset_ns / model.period_ns
    return laser, offset_ns, azimuth_rad


def _directions(elevation_rad: Array, azimuth_rad: Array) -> Array:
    return np.stack(
        [
            np.cos(elevation_rad) * np.cos(azimuth_rad),
            np.cos(elevation_rad) * np.sin(azimuth_rad),
            np.sin(elevation_rad),
        ],
        axis=-1,
    )


def _near_border(
    scene: Scene, origins: Array, directions: Array, returns: Returns, noise: LidarNoise
) -> NDArray[np.bool_]:
    """Find returns from the board within one footprint of its border."""
    on_board = returns.surface == scene.board_index
    reach = np.where(on_board, returns.range_m, 0.0)
    xy = transform(invert(scene.T_world_board), origins + reach[:, None] * directions)[:, :2]
    half = np.array([scene.board.width_m, scene.board.height_m]) / 2
    inside_m = np.min(half - np.abs(xy), axis=1)
    return np.asarray(on_board & (inside_m < noise.exit_size_m[0] + noise.divergence_rad[0] * reach))
