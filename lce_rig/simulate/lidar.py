"""A LiDAR: beams or pattern, firing times, finite beams with mixed pixels, and realistic errors."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from lce_rig.core.data import NO_RING, Scan
from lce_rig.core.data_sheets import DataSheet
from lce_rig.core.geometry import Array, invert, transform
from lce_rig.simulate.options import LidarNoise
from lce_rig.simulate.scene import Hits, Scene, join_rows, put_rows


@dataclass(frozen=True, eq=False)
class Returns:
    """The returns of beams.

    Attributes:
        range_m: (N,), inf for no return.
        energy: (N,) received, 1 for a white surface across the whole beam.
        reflectivity: (N,) of the surface hit, 0..1.
        surface: (N,) int32 index of the scene's surface, -1 for no return.
    """

    range_m: Array
    energy: Array
    reflectivity: Array
    surface: NDArray[np.int32]


def receive(scene: Scene, origins: Array, directions: Array, noise: LidarNoise) -> Returns:
    """Find the return of each beam; only beams whose footprint may hit several surfaces are split.

    Args:
        scene: the surfaces.
        origins: (N, 3) m, world.
        directions: (N, 3) unit, world.
        noise: sizes of the beam.
    """
    hits = scene.cast(origins, directions)
    returns = _echoes(scene, hits, origins, directions)
    if max(*noise.divergence_rad, *noise.exit_size_m, noise.edge_growth_m) == 0.0:
        return returns
    split = np.flatnonzero(_touches_several(scene, hits, origins, directions, noise))
    return put_rows(returns, split, _mix(scene, origins[split], directions[split], noise))


def _echoes(scene: Scene, hits: Hits, origins: Array, directions: Array) -> Returns:
    is_hit = hits.surface >= 0
    points = origins + np.where(is_hit, hits.range_m, 0.0)[:, None] * directions
    reflectivity = scene.reflectivity(hits, points)
    cosine = np.abs(np.einsum("nc,nc->n", hits.normals, directions))
    return Returns(hits.range_m, reflectivity * cosine, reflectivity, hits.surface)


#: Points of a beam probed for a second surface, in half-widths.
_PROBES = np.array([[1, 0], [-1, 0], [0, 1], [0, -1]])
# Cells of equal energy over a beam: positions (K, 2) in half-widths, within an ellipse of radius 1.
_GRID = np.stack(np.meshgrid((np.arange(16) - 7.5) / 8, (np.arange(8) - 3.5) / 4, indexing="ij"), axis=-1)
_CELLS = _GRID[np.hypot(_GRID[..., 0], _GRID[..., 1]) <= 1.0]
#: Surfaces of one footprint nearer to each other than this blend into one return.
_PULSE_M = 0.5


def _sub_rays(origins: Array, directions: Array, cells: Array, noise: LidarNoise) -> tuple[Array, Array]:
    """Spread beams (N, 3) into origins and unit directions (N, K, 3) through the footprint's cells."""
    # A tilted LiDAR still turns about its own axis; world z serves as that axis to first order only,
    # which is exact for an upright LiDAR and rotates the footprint's ellipse a little for a tilted one.
    across = np.cross([0.0, 0.0, 1.0], directions)
    across /= np.maximum(np.linalg.norm(across, axis=1, keepdims=True), 1e-9)
    up = np.cross(directions, across)
    size, spread = np.asarray(noise.exit_size_m) / 2, np.asarray(noise.divergence_rad) / 2
    at = cells * (size + noise.edge_growth_m)
    turn = cells * spread
    sub_origins = origins[:, None] + at[:, 0, None] * across[:, None] + at[:, 1, None] * up[:, None]
    sub = directions[:, None] + turn[:, 0, None] * across[:, None] + turn[:, 1, None] * up[:, None]
    return sub_origins, sub / np.linalg.norm(sub, axis=-1, keepdims=True)


def _touches_several(
    scene: Scene, axis_hits: Hits, origins: Array, directions: Array, noise: LidarNoise
) -> NDArray[np.bool_]:
    """Find beams whose rim meets another surface than the axis, or the same one across a step in depth."""
    sub_origins, sub_directions = _sub_rays(origins, directions, _PROBES, noise)
    hits = scene.cast(sub_origins.reshape(-1, 3), sub_directions.reshape(-1, 3), with_normals=False)
    range_m, surface = hits.range_m.reshape(-1, 4), hits.surface.reshape(-1, 4)
    is_other = np.any(surface != axis_hits.surface[:, None], axis=1)
    with np.errstate(invalid="ignore"):
        bend = np.abs(range_m[:, ::2] + range_m[:, 1::2] - 2 * axis_hits.range_m[:, None])
    return np.asarray(is_other | np.any(bend > 0.03, axis=1))


def _mix(scene: Scene, origins: Array, directions: Array, noise: LidarNoise) -> Returns:
    """Blend a footprint's echoes closer together than the pulse; report the strongest remaining one."""
    n, k = len(origins), len(_CELLS)
    sub_origins, sub_directions = _sub_rays(origins, directions, _CELLS, noise)
    flat_origins, flat_directions = sub_origins.reshape(-1, 3), sub_directions.reshape(-1, 3)
    echo = _echoes(scene, scene.cast(flat_origins, flat_directions), flat_origins, flat_directions)
    order = np.argsort(echo.range_m.reshape(n, k), axis=1, kind="stable")
    range_m, energy, reflectivity = (
        np.take_along_axis(values.reshape(n, k), order, axis=1)
        for values in (echo.range_m, echo.energy, echo.reflectivity)
    )
    surface = np.take_along_axis(echo.surface.reshape(n, k), order, axis=1)
    is_hit = np.isfinite(range_m)
    safe_range = np.where(is_hit, range_m, 0.0)
    energy = np.where(is_hit, energy / k, 0.0)
    with np.errstate(invalid="ignore"):
        is_gap = np.diff(range_m, axis=1, prepend=range_m[:, :1]) > _PULSE_M
    group = np.cumsum(is_gap, axis=1) + k * np.arange(n)[:, None]

    def total(values: Array) -> Array:
        summed = np.bincount(group.ravel(), weights=values.ravel(), minlength=n * k)
        return np.asarray(summed, dtype=np.float64).reshape(n, k)

    # The received power falls with the square of the range; the reported intensity does not.
    power = total(energy / np.maximum(safe_range, 0.1) ** 2)
    best = np.argmax(power, axis=1)
    rows = np.arange(n)
    sums = [total(energy), total(energy * safe_range), total(energy * reflectivity)]
    best_energy, best_range, best_reflectivity = (values[rows, best] for values in sums)
    is_best = (group - k * rows[:, None]) == best[:, None]
    dominant = np.argmax(np.where(is_best, energy, -1.0), axis=1)
    has_echo = best_energy > 0
    scale = np.where(has_echo, best_energy, 1.0)
    return Returns(
        np.where(has_echo, best_range / scale, np.inf),
        best_energy,
        best_reflectivity / scale,
        np.where(has_echo, surface[rows, dominant], -1).astype(np.int32),
    )


#: Fraction of a full diffuse return (reflectivity 1, normal incidence) below which nothing is detected ...
_THRESHOLD = 0.04
#: ... up to this range; beyond it the threshold grows with the square of the range.
_FULL_RANGE_M = 30.0
_AZIMUTH_STEP_RAD = np.radians(0.01)
# Stretch of firings with one pose of a moving board: the duration of 16 sequences of a VLP-16, ns (a board at
# 0.3 m/s is seen within 0.14 mm of its place), and at least 256 firings, as shorter stretches gain nothing.
_INSTANT_NS, _FIRINGS_PER_INSTANT = 884_736, 256


# Rotation rates, Hz, not multiples: a rosette's two prisms, for all its lines; a Mid-360's rotor and mirror.
_PRISMS_HZ, _MID360_HZ = (1213.7, -771.3), (10.37, 2311.7)
_LINES = 4  # of a Mid-360: beams side by side in elevation
_LINE_RAD = np.radians(0.7)


def _pattern(sheet: DataSheet, starts_ns: NDArray[np.int64]) -> tuple[Array, Array]:
    """Aim the firings (N,) of a LiDAR without rings: azimuth and elevation, rad.

    Two prisms deflect the beam by half of the field's radius each: a rosette, densest in its middle. A
    Mid-360's lines sweep elevation while its rotor turns. Neither repeats within minutes.
    """
    t_s = 1e-9 * starts_ns
    width, low, high = np.radians(sheet.fov_deg)
    if sheet.pattern == "rosette":
        first, second = (2 * np.pi * hz * t_s for hz in _PRISMS_HZ)
        across, up = (np.cos(first) + np.cos(second)) / 2, (np.sin(first) + np.sin(second)) / 2
        return across * width / 2, (low + high) / 2 + up * (high - low) / 2
    rotor, mirror = (hz * t_s for hz in _MID360_HZ)
    up = np.abs(2 * np.mod(mirror, 1.0) - 1) * (high - low) + low
    line = (np.arange(len(t_s)) % _LINES - (_LINES - 1) / 2) * _LINE_RAD
    return np.pi - 2 * np.pi * np.mod(rotor, 1.0), np.clip(up + line, low, high)


@dataclass(frozen=True, eq=False)
class LidarModel:
    """The geometry and timing of a LiDAR at one rate.

    For a LiDAR without rings, each firing of a scan is a laser of its own.

    Attributes:
        name: name of the model.
        elevations_rad: (L,) of each laser, in firing order.
        azimuths_rad: (L,) of each laser from the rotor's.
        vertical_offsets_m: (L,) height of each laser's optical centre.
        origin_radius_m: distance of the optical centres from the axis, along the rotor's direction.
        starts_ns: (L,) firing time of each laser after the first of its sequence.
        sequence_ns: time between two sequences.
        period_ns: duration of one revolution, or of the scans that are accumulated.
        pattern: scan pattern, see `DataSheet`.
    """

    name: str
    elevations_rad: Array
    azimuths_rad: Array
    vertical_offsets_m: Array
    origin_radius_m: float
    starts_ns: NDArray[np.int64]
    sequence_ns: int
    period_ns: int
    pattern: str = "rings"

    @classmethod
    def of(cls, sheet: DataSheet, rate_hz: float) -> "LidarModel":
        """Build the model of a data sheet at a rate."""
        n, period_ns = sheet.n_rings, round(1e9 / rate_hz)
        if not sheet.has_rings:
            starts_ns = (np.arange(round(sheet.points_hz / rate_hz)) * 1e9 / sheet.points_hz).astype(np.int64)
            azimuth, elevation = _pattern(sheet, starts_ns)
            height = np.zeros(len(starts_ns))
            return cls(
                sheet.name, elevation, azimuth, height, 0.0, starts_ns, period_ns, period_ns, sheet.pattern
            )
        return cls(
            name=sheet.name,
            elevations_rad=np.radians(sheet.elevations_deg),
            azimuths_rad=np.radians(sheet.azimuths_deg or n * (0.0,)),
            vertical_offsets_m=1e-3 * np.array(sheet.heights_mm or n * (0.0,)),
            origin_radius_m=sheet.origin_radius_m,
            starts_ns=np.arange(n, dtype=np.int64) // sheet.n_at_once * sheet.firing_ns,
            sequence_ns=sheet.sequence_ns or period_ns // (sheet.columns or 1),
            period_ns=period_ns,
        )

    @property
    def rings(self) -> NDArray[np.int16]:
        """The rank of each laser's elevation (L,), 0 = lowest; `NO_RING` without rings."""
        if self.pattern != "rings":
            return np.full(len(self.elevations_rad), NO_RING, dtype=np.int16)
        return np.asarray(np.argsort(np.argsort(self.elevations_rad)), dtype=np.int16)

    @property
    def step_rad(self) -> float:
        """Turn of the rotor from one sequence to the next."""
        return 2 * np.pi * self.sequence_ns / self.period_ns


class Sweep(NamedTuple):
    """The surfaces hit by the beams of one revolution, without measurement errors.

    Attributes:
        laser: (N,) of each firing, in firing order.
        offset_ns: (N,) after the first firing.
        azimuth_rad: (N,).
        returns: returns of each firing.
        is_rim: (N,) whether the beam hit the board's border.
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
    lidar_at: Callable[[NDArray[np.int64]], Array] | None = None,
) -> Sweep:
    """Trace the beams of one revolution.

    Args:
        scene: surfaces that the beams hit.
        T_world_lidar: (4, 4).
        model: the LiDAR's geometry and timing.
        noise: the sensor's errors.
        rng: source of the azimuth phase.
        stamp_ns: device time of the first firing.
        board_at: T_world_board (N, 4, 4) at times (N,) ns of the timestamp's clock; None for the scene's.
        lidar_at: T_world_lidar (N, 4, 4) of a moving rig at such times; None for `T_world_lidar`.
    """
    laser, offset_ns, azimuth_rad = _firings(model, rng)
    if lidar_at is not None:
        T_world_lidar = lidar_at(stamp_ns + offset_ns)
    origins_world, directions_world = _beams(model, T_world_lidar, laser, azimuth_rad)
    if board_at is None:
        returns = receive(scene, origins_world, directions_world, noise)
        is_rim = _near_border(scene, origins_world, directions_world, returns, noise)
    else:
        # Stretches of firings during which the board hardly moves are traced in a scene of their own.
        n_firings = max(_FIRINGS_PER_INSTANT, int(np.searchsorted(offset_ns, _INSTANT_NS)))
        edges = np.append(np.arange(0, len(laser), n_firings), len(laser))
        middles_ns = stamp_ns + (offset_ns[edges[:-1]] + offset_ns[edges[1:] - 1]) // 2
        parts, rims = [], []
        for first, last, T_world_board in zip(edges[:-1], edges[1:], board_at(middles_ns), strict=True):
            moved = scene.with_board_at(T_world_board)
            origins, directions = origins_world[first:last], directions_world[first:last]
            parts.append(receive(moved, origins, directions, noise))
            rims.append(_near_border(moved, origins, directions, parts[-1], noise))
        returns, is_rim = join_rows(parts), np.concatenate(rims)
    return Sweep(laser, offset_ns, azimuth_rad, returns, is_rim)


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
    """Measure the surfaces hit by the beams.

    Args:
        sweep: the surfaces.
        model, noise: those that the sweep was computed with.
        rng: source of all noise.
        laser_bias_m: (L,) constant range offset of each laser in firing order; zeros by default.
        sensor: name in the rig profile.
        stamp_ns: device time of the first firing.
        min_range_m, max_range_m: nearer and farther returns are not reported.
    """
    laser, returns = sweep.laser, sweep.returns
    bias_m = np.zeros(len(model.elevations_rad)) if laser_bias_m is None else laser_bias_m
    # 100 is the intensity of a white diffuse surface.
    intensity = np.clip(100.0 * returns.energy, 0.0, 255.0)
    range_m = returns.range_m + bias_m[laser] + noise.range_offset_m
    range_m += noise.dark_bias_m * (1.0 - returns.reflectivity)
    range_m += noise.weak_bias_m * np.clip(1.0 - intensity / 30.0, 0.0, 1.0)
    range_m += noise.range_sigma_m * rng.standard_normal(len(range_m))
    if noise.is_quantised:
        range_m, intensity = np.rint(range_m / noise.range_step_m) * noise.range_step_m, np.rint(intensity)
    spread_rad = noise.rim_spread_rad * rng.uniform(-1.0, 1.0, len(range_m))
    azimuth_rad = sweep.azimuth_rad + np.where(sweep.is_rim, spread_rad, 0.0)
    if noise.is_quantised:
        azimuth_rad = np.rint(azimuth_rad / _AZIMUTH_STEP_RAD) * _AZIMUTH_STEP_RAD
    is_lost = rng.random(len(range_m)) < noise.dropout
    threshold = _THRESHOLD * np.maximum(returns.range_m / _FULL_RANGE_M, 1.0) ** 2
    keep = np.isfinite(range_m) & (returns.energy > threshold) & ~is_lost
    keep &= (range_m >= min_range_m) & (range_m <= max_range_m)
    origins, rays = _beams(model, np.eye(4), laser[keep], azimuth_rad[keep])
    return Scan(
        sensor=sensor,
        stamp_ns=stamp_ns,
        points=(origins + range_m[keep, None] * rays).astype(np.float32),
        intensity=intensity[keep].astype(np.float32),
        ring=model.rings[laser[keep]],
        offset_ns=sweep.offset_ns[keep],
        host_ns=stamp_ns + model.period_ns,
    )


def _beams(
    model: LidarModel, T_world_lidar: Array, laser: NDArray[np.intp], azimuth_rad: Array
) -> tuple[Array, Array]:
    """Compute the origins and directions of beams (N,), (N, 3) each, world; of one pose, or one each."""
    origins = np.zeros((len(laser), 3))
    origins[:, 2] = model.vertical_offsets_m[laser]
    if model.origin_radius_m:
        rotor_rad = azimuth_rad - model.azimuths_rad[laser]
        origins[:, 0] = model.origin_radius_m * np.cos(rotor_rad)
        origins[:, 1] = model.origin_radius_m * np.sin(rotor_rad)
    elevation_rad = model.elevations_rad[laser]
    level = np.cos(elevation_rad)
    directions = np.stack(
        [level * np.cos(azimuth_rad), level * np.sin(azimuth_rad), np.sin(elevation_rad)], axis=-1
    )
    R = T_world_lidar[..., :3, :3]
    return (R @ origins[..., None])[..., 0] + T_world_lidar[..., :3, 3], (R @ directions[..., None])[..., 0]


def _firings(
    model: LidarModel, rng: np.random.Generator
) -> tuple[NDArray[np.intp], NDArray[np.int64], Array]:
    """List laser, time after the first firing and azimuth of one revolution's firings."""
    if model.pattern != "rings":
        # A scan begins anywhere in the pattern; turning it a little makes another one of the same density.
        turned_rad = model.azimuths_rad + np.radians(0.2) * rng.uniform(-1.0, 1.0)
        return np.arange(len(model.starts_ns)), model.starts_ns, turned_rad
    n_lasers = len(model.elevations_rad)
    n_sequences = int(model.period_ns // model.sequence_ns)
    laser = np.tile(np.arange(n_lasers), n_sequences)
    sequence = np.repeat(np.arange(n_sequences), n_lasers)
    offset_ns = (sequence * model.sequence_ns + model.starts_ns[laser]).astype(np.int64)
    # The rotor is not synchronised with the firings: each scan begins anywhere within one step.
    # It turns clockwise as seen from above, from straight behind.
    start_rad = np.pi - model.step_rad * rng.uniform()
    azimuth_rad = start_rad - 2 * np.pi * offset_ns / model.period_ns
    if model.azimuths_rad.any():
        azimuth_rad = azimuth_rad + model.azimuths_rad[laser]
    return laser, offset_ns, azimuth_rad


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
