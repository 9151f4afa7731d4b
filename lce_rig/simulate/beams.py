"""Beams of finite width: the surfaces that a beam hits, and the single range that it reports."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lce_rig.core.geometry import Array
from lce_rig.simulate.options import LidarNoise
from lce_rig.simulate.scene import Hits, Scene


@dataclass(frozen=True, eq=False)
class Returns:
    """The returns of beams.

    Attributes:
        range_m: (N,), inf where nothing.
        energy: (N,) received, 1 for a white surface across the whole beam.
        reflectivity: (N,) of the surface hit, 0..1.
        surface: (N,) int32 index of the scene's surface, -1 where nothing.
    """

    range_m: Array
    energy: Array
    reflectivity: Array
    surface: NDArray[np.int32]


def receive(scene: Scene, origins: Array, directions: Array, noise: LidarNoise) -> Returns:
    """Find the return of each beam: its axis alone decides where its whole footprint hits one surface.

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
    is_split = _touches_several(scene, hits, origins, directions, noise)
    split = np.flatnonzero(is_split)
    mixed = _mix(scene, origins[split], directions[split], noise)
    out = [getattr(returns, name).copy() for name in ("range_m", "energy", "reflectivity", "surface")]
    for whole, part in zip(
        out, (mixed.range_m, mixed.energy, mixed.reflectivity, mixed.surface), strict=True
    ):
        whole[split] = part
    return Returns(*out)


def _echoes(scene: Scene, hits: Hits, origins: Array, directions: Array) -> Returns:
    is_hit = hits.surface >= 0
    points = origins + np.where(is_hit, hits.range_m, 0.0)[:, None] * directions
    reflectivity = scene.reflectivity(hits, points)
    cosine = np.abs(np.einsum("nc,nc->n", hits.normals, directions))
    return Returns(hits.range_m, reflectivity * cosine, reflectivity, hits.surface)


def _footprint(n_across: int, n_up: int) -> Array:
    """Lay cells of equal energy over a beam: positions (K, 2) in half-widths, an ellipse of radius 1."""
    across = (np.arange(n_across) + 0.5) / n_across * 2 - 1
    up = (np.arange(n_up) + 0.5) / n_up * 2 - 1
    cells = np.stack(np.meshgrid(across, up, indexing="ij"), axis=-1).reshape(-1, 2)
    return np.asarray(cells[np.hypot(cells[:, 0], cells[:, 1]) <= 1.0])


#: Where a beam is probed for a second surface, in half-widths.
_PROBES = np.array([[1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0]])
_CELLS = _footprint(16, 8)


def _sub_rays(origins: Array, directions: Array, cells: Array, noise: LidarNoise) -> tuple[Array, Array]:
    """Spread beams (N, 3) into origins and unit directions (N, K, 3) through the footprint's cells."""
    # A tilted LiDAR still turns about its own axis; world z serves as that axis to first order only,
    # which is exact for an upright LiDAR and turns the footprint's ellipse a little for a tilted one.
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
    """Blend a footprint's echoes closer together than the pulse; of the groups left, report the strongest."""
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
        is_gap = np.diff(range_m, axis=1, prepend=range_m[:, :1]) > noise.pulse_m
    group = np.cumsum(is_gap, axis=1) + k * np.arange(n)[:, None]

    def total(values: Array) -> Array:
        summed = np.bincount(group.ravel(), weights=values.ravel(), minlength=n * k)
        return np.asarray(summed, dtype=np.float64).reshape(n, k)

    # What reaches the receiver falls with the square of the range; the reported intensity does not.
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
