"""Extrinsics from simulated scenes without a board: furnished rooms and streets with exact truth.

All LiDARs see the same scenes, beside the camera of the profile `rlfs` at half its resolution.
"""

import time
from collections.abc import Iterator
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from shared import half_size

from benchmarks.measured import DEG_MM, measure
from benchmarks.tables import compare, print_head, print_row
from lce_rig.core.camera import Intrinsics
from lce_rig.core.data import Image
from lce_rig.core.data_sheets import find_data_sheet
from lce_rig.core.geometry import Array, exp_so3, invert, perturb, pose
from lce_rig.detect.lidar.measurement import Beam
from lce_rig.rig import Rig, load_rig
from lce_rig.scene.estimate import REACH, SceneEstimate, estimate_scene
from lce_rig.scene.outline_score import OutlineView, build_outline_view
from lce_rig.simulate.image_rendering import expose
from lce_rig.simulate.lidar import LidarModel, measure_sweep, sweep_scene
from lce_rig.simulate.options import CameraNoise, LidarNoise
from lce_rig.simulate.scene import Raycaster, Scene, Surface, surface_colour
from lce_rig.simulate.surfaces import Material, Mesh, Pattern, box, cone, ellipsoid, inside_box, merge

_LIDARS = {"VLP-16": 10.0, "OS1-64": 10.0, "Mid-360": 1.0}  # Scans per second
_N_VIEWS = (5, 10)
_CHI2_95, _WRONG = 12.59, 30.0  # of six degrees of freedom; beyond the second a result is wrong and confident
_HEIGHT_M = 1.0  # of the LiDAR
_CLEAR_M = 0.8  # between the rig and any object
_SKY = 0.9  # Radiance
_AMBIENT, _DIRECT = 0.35, 0.6  # Light in the shade, and from the lamp or sun
_PATTERNS: tuple[Pattern, ...] = ("plain", "plain", "cloth", "wood", "panels")

Part = tuple[Mesh, Material]


class Place(NamedTuple):
    """A scene.

    Attributes:
        parts: meshes in the world's frame, z up, with their materials.
        lamp: (3,) m.
        low, high: (3,) corners of the region of the rig, m.
        turn_rad: largest turn of the rig from the x axis, to either side.
    """

    parts: list[Part]
    lamp: Array
    low: Array
    high: Array
    turn_rad: float


class Trial(NamedTuple):
    """The views of one scene with one LiDAR."""

    scene: str
    lidar: str
    lens: Intrinsics
    T_cam_lidar: Array
    views: list[OutlineView]


def bench_scene_sim(n_scenes: int, only: str = "") -> None:
    """Print errors and coverage for each kind of scene and LiDAR."""
    estimates: dict[tuple[str, str], list[tuple[SceneEstimate, Array]]] = {}
    start = time.process_time()
    for seed in range(n_scenes):
        for trial in simulate_trials(seed, only):
            tangent = np.random.default_rng(seed).uniform(-1, 1, 6) * REACH
            found = estimate_scene(trial.views, trial.lens, perturb(trial.T_cam_lidar, tangent))
            estimates.setdefault((trial.scene, trial.lidar), []).append((found, trial.T_cam_lidar))
    print(f"\n{n_scenes} scenes of each kind, {time.process_time() - start:.0f} s\n")
    print_head("scene", "LiDAR", "trials", "usable", "median error", "claim of 95 % covers",
               "wrong and confident")  # fmt: skip
    for (scene, lidar), results in estimates.items():
        usable = [(found, T) for found, T in results if found.state == "usable"]
        chi2 = np.array([found.chi2(T) for found, T in usable])
        errors = np.array([compare(found.T_cam_lidar, T) for found, T in usable]).reshape(-1, 2)
        n_covered, n_wrong = int(np.sum(chi2 < _CHI2_95)), int(np.sum(chi2 > _WRONG))
        median = np.median(errors, axis=0) if usable else np.full(2, np.nan)
        key = f"scene_sim.{scene}.{lidar}"
        measure(f"{key}.usable", "{} of {}", len(usable), len(results))
        measure(f"{key}.error", DEG_MM, *median)
        measure(f"{key}.covered", "{} of {}", n_covered, len(usable))
        measure(f"{key}.wrong", "{}", n_wrong)
        cells = len(usable), DEG_MM.format(*median), f"{n_covered} of {len(usable)}", n_wrong
        print_row(scene, lidar, len(results), *cells)


def simulate_trials(seed: int, only: str = "") -> Iterator[Trial]:
    """Simulate a room and a street, seen by each LiDAR; `only` is part of a scene's name."""
    rig = half_size(load_rig("rlfs"))
    for name, build in (("room", _build_room), ("street", _build_street)):
        if only not in name:
            continue
        rng = np.random.default_rng(seed)
        place = build(rng)
        surfaces = [Surface("", mesh, material, np.eye(4)) for mesh, material in place.parts]
        hidden = pose(np.eye(3), np.array([0.0, 0.0, -1000.0]))  # of the board that every scene has
        scene = Scene(Raycaster(surfaces), (), rig.board.to_board(), hidden)
        yield from _look(name, place, scene, rig, rng)


def _look(name: str, place: Place, scene: Scene, rig: Rig, rng: np.random.Generator) -> Iterator[Trial]:
    nominal = rig.nominal("cam", "lidar")
    assert nominal is not None
    T_cam_lidar, lens = nominal.to_matrix(), rig.cameras["cam"].to_intrinsics()
    sight_rad = np.arctan2(T_cam_lidar[2, 1], T_cam_lidar[2, 0])
    n_views = int(rng.integers(*_N_VIEWS, endpoint=True))
    places = [_stand(place, scene, sight_rad, rng) for _ in range(n_views)]
    images = [_render(place, scene, T @ invert(T_cam_lidar), lens, rng) for T in places]
    for lidar, rate_hz in _LIDARS.items():
        sheet = find_data_sheet(lidar)
        assert sheet is not None
        model, noise = LidarModel.of(sheet, rate_hz), LidarNoise.of(sheet)
        beam = Beam(sheet.aperture_m, sheet.divergence_rad[0])
        views = []
        for k, (T, image) in enumerate(zip(places, images, strict=True)):
            sweep = sweep_scene(scene, T, model, noise, rng)
            scan = measure_sweep(sweep, model, noise, rng, max_range_m=sheet.range_m[1])
            views.append(build_outline_view(str(k), image, scan, beam, lens, T_cam_lidar))
        yield Trial(name, lidar, lens, T_cam_lidar, views)


def _stand(place: Place, scene: Scene, sight_rad: float, rng: np.random.Generator) -> Array:
    """Draw T_world_lidar (4, 4) with nothing near, for a camera that looks along an azimuth."""
    angles = np.linspace(0, 2 * np.pi, 36, endpoint=False)
    around = np.stack([np.cos(angles), np.sin(angles), -0.3 * np.ones(36)], axis=1) / np.hypot(1, 0.3)
    for _ in range(200):
        at = rng.uniform(place.low, place.high)
        if scene.cast(np.tile(at, (36, 1)), around, with_normals=False).range_m.min() > _CLEAR_M:
            break
    turn_rad = np.pi * rng.integers(2) + rng.uniform(-1, 1) * place.turn_rad - sight_rad
    tilt = exp_so3(rng.normal(0, np.radians(1.0), 3))
    return pose(exp_so3(np.array([0.0, 0.0, turn_rad])) @ tilt, at)


@lru_cache(maxsize=1)
def _rays(lens: Intrinsics) -> Array:
    """List the rays (N, 3) through the centres of all pixels.

    Corners beyond the lens model's radius continue what is next to them, without an edge.
    """
    v, u = np.mgrid[0 : lens.height_px, 0 : lens.width_px]
    pixels, centre = np.stack([u, v], axis=-1).reshape(-1, 2).astype(np.float64), [lens.cx_px, lens.cy_px]
    rays = lens.unproject(pixels)
    while (is_beyond := np.isnan(rays[:, 0])).any():
        pixels[is_beyond] = centre + 0.99 * (pixels[is_beyond] - centre)
        rays[is_beyond] = lens.unproject(pixels[is_beyond])
    return rays


def _render(
    place: Place, scene: Scene, T_world_cam: Array, lens: Intrinsics, rng: np.random.Generator
) -> Image:
    """Look through every pixel's centre."""
    rays = _rays(lens) @ T_world_cam[:3, :3].T
    origins = np.broadcast_to(T_world_cam[:3, 3], rays.shape)
    hits = scene.static.cast(origins, rays)
    radiance: Array = np.full((len(rays), 3), _SKY)
    is_hit = hits.surface >= 0
    points = (origins + np.where(is_hit, hits.range_m, 0.0)[:, None] * rays)[is_hit]
    to_lamp = place.lamp - points
    to_lamp /= np.linalg.norm(to_lamp, axis=1, keepdims=True)
    facing = np.maximum(np.einsum("nc,nc->n", hits.normals[is_hit], to_lamp), 0.0)
    is_dark = scene.static.is_blocked(points + 1e-3 * hits.normals[is_hit], place.lamp)
    colour = np.zeros((len(points), 3))
    surface = hits.surface[is_hit]
    for index in np.unique(surface):
        rows = surface == index
        colour[rows] = surface_colour(scene.surfaces[index], points[rows], hits.normals[is_hit][rows])
    radiance[is_hit] = colour * (_AMBIENT + _DIRECT * facing * ~is_dark)[:, None]
    radiance = radiance.reshape(lens.height_px, lens.width_px, 3)
    return Image("cam", "frames", 0, expose(radiance, CameraNoise(), rng))


def _material(rng: np.random.Generator, pattern: Pattern | None = None) -> Material:
    """Draw a material from nearly black to white: some objects hardly differ from what is behind them."""
    tint = np.clip(rng.uniform(0.03, 0.85) * rng.uniform(0.7, 1.3, 3), 0.02, 0.9)
    chosen = _PATTERNS[int(rng.integers(len(_PATTERNS)))] if pattern is None else pattern
    return Material((tint[0], tint[1], tint[2]), float(rng.uniform(0.15, 0.9)), chosen)


def _build_room(rng: np.random.Generator) -> Place:
    """Furnish a room of 6 x 5 x 2.8 m: cabinets, tables, poles, and posters, which only the camera sees."""
    size = np.array([6.0, 5.0, 2.8])
    parts = [(inside_box(size, (0, 0, size[2] / 2)), Material((0.66, 0.70, 0.72), 0.75))]
    for _ in range(int(rng.integers(10, 16))):
        width, depth, height = rng.uniform([0.3, 0.3, 0.5], [1.1, 0.6, 2.2])
        at, shape = rng.uniform(-size / 2, size / 2), rng.random()
        if shape < 0.5:
            mesh = box((width, depth, height), (0, 0, height / 2))
        elif shape < 0.75:  # a table with a thing on it
            top_m, thing_m = 0.4 + height / 4, rng.uniform(0.1, 0.5)
            corners = [(i * width / 2, k * depth / 2, top_m / 2) for i in (-1, 1) for k in (-1, 1)]
            legs = [box((0.05, 0.05, top_m), corner) for corner in corners]
            things = [box((width + 0.1, depth + 0.1, 0.04), (0, 0, top_m))]
            things.append(box((0.2, 0.25, thing_m), (0.1, 0, top_m + thing_m / 2)))
            mesh = merge([*legs, *things])
        else:
            mesh = cone((0, 0, 0), (0, 0, height), rng.uniform(0.03, 0.12))
        T = pose(exp_so3(np.array([0, 0, rng.uniform(0, np.pi)])), np.array([at[0], at[1], 0.0]))
        parts.append((mesh.moved(T), _material(rng)))
    for _ in range(8):
        x, y, z = rng.uniform([-2.4, -1.9, 0.9], [2.4, 1.9, 2.0])
        wide, high = rng.uniform(0.2, 0.8, 2)
        side = rng.choice([-1, 1])
        on_long = box((wide, 0.004, high), (x, side * size[1] / 2, z))
        on_short = box((0.004, wide, high), (side * size[0] / 2, y, z))
        parts.append((on_long if rng.random() < 0.5 else on_short, _material(rng, "poster")))
    low, high = np.array([-1.8, -1.4, _HEIGHT_M - 0.1]), np.array([1.8, 1.4, _HEIGHT_M + 0.2])
    return Place(parts, np.array([0.3, 0.2, 2.7]), low, high, np.pi)


def _build_street(rng: np.random.Generator) -> Place:
    """Build a street of 40 m: two rows of façades with windows and doors, poles, parked boxes, trees."""
    parts = [(box((80, 60, 0.1), (0, 0, -0.05)), Material((0.3, 0.3, 0.3), 0.3, "tiles"))]
    for side in (-1.0, 1.0):
        x = -20.0
        while x < 20:
            width, height, front = rng.uniform([5, 5, 6.0], [9, 12, 8.0])
            house = box((width, 6, height), (x + width / 2, side * (front + 3), height / 2))
            parts.append((house, _material(rng)))
            openings = []
            for left in np.arange(x + 0.8, x + width - 1.4, rng.uniform(1.8, 2.6)):
                levels = np.arange(1.8, height - 1, 3.0)
                openings += [box((1.1, 0.06, 1.5), (left + 0.55, side * front, z)) for z in levels]
            parts.append((merge(openings), Material((0.08, 0.08, 0.08), 0.05)))
            parts.append((box((1.0, 0.5, 2.2), (x + width - 0.9, side * front, 1.1)), _material(rng, "wood")))
            x += width + (rng.uniform(1, 3) if rng.random() < 0.3 else 0.0)
    for _ in range(int(rng.integers(12, 20))):
        at = np.array([rng.uniform(-20, 20), rng.choice([-1, 1]) * rng.uniform(4.0, 5.2), 0.0])
        shape, height = rng.random(), rng.uniform(3, 6)
        if shape < 0.4:
            parts.append((cone(at, at + [0, 0, height], rng.uniform(0.05, 0.15)), _material(rng, "plain")))
        elif shape < 0.75:
            size = rng.uniform([0.6, 0.5, 0.8], [4.3, 1.8, 1.9])
            parts.append((box(size, at + [0, 0, size[2] / 2]), _material(rng)))
        else:
            crown = ellipsoid(at + [0, 0, height], rng.uniform(0.8, 1.5, 3))
            parts.append((cone(at, at + [0, 0, height], 0.15), Material((0.1, 0.15, 0.2), 0.4)))
            parts.append((crown, Material((0.05, 0.25, 0.08), 0.6, "cloth")))
    low, high = np.array([-16.0, -2.0, _HEIGHT_M]), np.array([16.0, 2.0, _HEIGHT_M + 0.8])
    return Place(parts, np.array([20.0, -40.0, 60.0]), low, high, np.radians(40.0))
