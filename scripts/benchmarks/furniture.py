"""Furniture drawn by seed: outlines of many kinds, near and far, upright and slanted, before the walls."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from lce_rig.core.geometry import Array, exp_so3, pose
from lce_rig.simulate.options import Part
from lce_rig.simulate.room import SHIRTS, build_body
from lce_rig.simulate.surfaces import Material, Mesh, Pattern, box, cone, ellipsoid, limb, merge

_N_PIECES = (9, 15)
_ATTEMPTS = 60
_RIG_REACH_M = 1.5  # nothing stands so near the rig
#: Where boards are held: pieces nearer than this stand at least so far beside the line of sight.
_CLEAR_M, _CLEAR_RAD = 4.2, np.radians(24.0)
_PAINT_M = 0.004

_Piece = list[tuple[str, Mesh, Material]]
"""What a piece of furniture consists of: about the origin of the floor, before it is turned and moved."""


@dataclass(frozen=True)
class Furniture:
    """Draws the size of a room and its furniture, as `SimulationOptions.furnish`."""

    def __call__(
        self, low: Array, high: Array, rng: np.random.Generator
    ) -> tuple[Array, Array, list[Part], list[tuple[Array, Array]]]:
        """Move the corners (3,), and furnish the room between them."""
        low = low + rng.uniform([-1, -1, 0], [1, 0.6, 0])
        high = high + rng.uniform([-1, -0.6, -0.5], [3, 1, 0.6])
        return low, high, *draw_furniture(low, high, rng)


def draw_furniture(
    low: Array, high: Array, rng: np.random.Generator
) -> tuple[list[Part], list[tuple[Array, Array]]]:
    """Furnish a room: pieces that stand apart from each other, most in front of the rig, and paint on walls.

    The paint has no depth: edges in images that no LiDAR sees.

    Args:
        low, high: (3,) corners of the room, m; the rig is at the origin and looks along x.
        rng: source of everything.

    Returns:
        Name, mesh, material and T_room_piece (4, 4) of each part; (low, high) of each piece, m, frame room.
    """
    parts: list[Part] = []
    obstacles: list[tuple[Array, Array]] = []
    kinds, weights = list(_KINDS), np.array(list(_KINDS.values()))
    for _ in range(int(rng.integers(*_N_PIECES))):
        kind = kinds[int(rng.choice(len(kinds), p=weights / weights.sum()))]
        piece = kind(rng, float(high[2]))
        placed = _find_place(piece, low, high, obstacles, rng)
        if placed is not None:
            T, bounds = placed
            obstacles.append(bounds)
            parts += [(name, mesh.moved(T), material, T) for name, mesh, material in piece]
    parts += [_paint(low, high, rng) for _ in range(int(rng.integers(4, 10)))]
    return parts, obstacles


def _find_place(
    piece: _Piece,
    low: Array,
    high: Array,
    obstacles: Sequence[tuple[Array, Array]],
    rng: np.random.Generator,
) -> tuple[Array, tuple[Array, Array]] | None:
    """Turn and move a piece to where it is free: T_room_piece (4, 4) and its bounds; None without a place."""
    vertices = np.concatenate([mesh.vertices for _, mesh, _ in piece])
    for _ in range(_ATTEMPTS):
        # Furniture mostly stands along the walls, but never exactly.
        turn_rad = float(rng.integers(4) * np.pi / 2 + rng.normal(0, np.radians(4.0)))
        if rng.random() < 0.3:
            turn_rad = rng.uniform(0, 2 * np.pi)
        x, y = rng.uniform([1.0, low[1]], high[:2])
        T = pose(exp_so3(np.array([0.0, 0.0, turn_rad])), np.array([x, y, 0.0]))
        moved = vertices @ T[:3, :3].T + T[:3, 3]
        corners = moved.min(axis=0), moved.max(axis=0)
        distance_m = float(np.hypot(moved[:, 0], moved[:, 1]).min())
        beside_rad = float(np.abs(np.arctan2(moved[:, 1], moved[:, 0])).min())
        is_in_room = np.all(corners[0][:2] > low[:2] + 0.05) and np.all(corners[1][:2] < high[:2] - 0.05)
        is_in_the_way = distance_m < _RIG_REACH_M or (distance_m < _CLEAR_M and beside_rad < _CLEAR_RAD)
        is_apart = all(
            np.any(corners[0][:2] > other[1][:2] + 0.1) or np.any(corners[1][:2] < other[0][:2] - 0.1)
            for other in obstacles
        )
        if is_in_room and not is_in_the_way and is_apart:
            return T, corners
    return None


def _material(rng: np.random.Generator, pattern: Pattern | None = None) -> Material:
    """Draw a material from nearly black to white: some pieces hardly differ from the wall behind."""
    grey = rng.uniform(0.03, 0.85)
    tint = np.clip(grey * rng.uniform(0.7, 1.3, 3), 0.02, 0.9)
    patterns: tuple[Pattern, ...] = ("plain", "plain", "wood", "cloth")
    pattern = pattern or patterns[int(rng.integers(len(patterns)))]
    return Material((tint[0], tint[1], tint[2]), float(rng.uniform(0.15, 0.9)), pattern)


def _shelf(rng: np.random.Generator, _: float) -> _Piece:
    """Open shelves with boxes and books: uprights, boards and gaps."""
    width_m, depth_m, height_m = rng.uniform([0.6, 0.3, 1.2], [1.4, 0.45, 2.2])
    frame = [box((depth_m, 0.03, height_m), (0, side * width_m / 2, height_m / 2)) for side in (-1.0, 1.0)]
    levels = np.linspace(0.05, height_m - 0.02, int(rng.integers(4, 7)))
    frame += [box((depth_m, width_m, 0.025), (0, 0, z)) for z in levels]
    things = []
    for z, room_m in zip(levels[:-1], np.diff(levels), strict=True):
        y = -width_m / 2 + rng.uniform(0.02, 0.2)
        while y < width_m / 2 - 0.1:
            size = rng.uniform([0.12, 0.05, 0.4 * room_m], [depth_m, 0.35, 0.9 * room_m])
            if y + size[1] > width_m / 2:
                break
            things.append(box(size, (0, y + size[1] / 2, z + 0.013 + size[2] / 2)))
            y += size[1] + rng.uniform(0.0, 0.3)
    piece: _Piece = [("shelf", merge(frame), _material(rng, "wood"))]
    return [*piece, ("things", merge(things), _material(rng))] if things else piece


def _table(rng: np.random.Generator, _: float) -> _Piece:
    width_m, depth_m, height_m = rng.uniform([0.8, 0.5, 0.65], [1.8, 0.9, 1.1])
    x, y = depth_m / 2 - 0.05, width_m / 2 - 0.05
    legs = [cone((i * x, k * y, 0), (i * x, k * y, height_m), 0.025) for i in (-1, 1) for k in (-1, 1)]
    things = []
    for side in (-1.0, 0.0, 1.0):
        size = rng.uniform([0.05, 0.1, 0.1], [0.35, 0.22 * width_m, 0.6])
        middle = (rng.uniform(-0.1, 0.1), side * 0.33 * width_m, height_m + 0.02 + size[2] / 2)
        things.append(box(size, middle))
    return [
        ("table", box((depth_m, width_m, 0.035), (0, 0, height_m)), _material(rng, "wood")),
        ("table legs", merge(legs), _material(rng, "plain")),
        ("things", merge(things), _material(rng)),
    ]


def _cabinet(rng: np.random.Generator, _: float) -> _Piece:
    size = rng.uniform([0.35, 0.4, 0.8], [0.6, 1.2, 2.1])
    return [("cabinet", box(size, (0, 0, size[2] / 2)), _material(rng))]


def _pillar(rng: np.random.Generator, ceiling_m: float) -> _Piece:
    width_m = rng.uniform(0.2, 0.6)
    if rng.random() < 0.4:
        return [("pillar", cone((0, 0, 0), (0, 0, ceiling_m), width_m / 2), _material(rng, "plain"))]
    return [("pillar", box((width_m, width_m, ceiling_m), (0, 0, ceiling_m / 2)), _material(rng, "plain"))]


def _person(rng: np.random.Generator, _: float) -> _Piece:
    """Someone who stands there, arms hanging or spread a little."""
    s = rng.uniform(0.9, 1.08)
    shirt = SHIRTS[int(rng.integers(len(SHIRTS)))]
    spread_m = rng.uniform(0.03, 0.3)
    arms = [
        limb((0, side * 0.2 * s, 1.4 * s), (-0.05, side * (0.2 + spread_m) * s, 0.85 * s), 0.055, 0.04)
        for side in (-1.0, 1.0)
    ]
    body = [("person", mesh, material or shirt) for mesh, material in build_body(s).values()]
    return [*body, ("person", merge(arms), shirt)]


def _door(rng: np.random.Generator, _: float) -> _Piece:
    """A door frame that stands free, with its leaf ajar."""
    width_m, height_m, thick_m = rng.uniform(0.8, 1.0), rng.uniform(2.0, 2.2), 0.08
    posts = [box((0.12, thick_m, height_m), (0, side * width_m / 2, height_m / 2)) for side in (-1.0, 1.0)]
    lintel = box((0.12, width_m + thick_m, thick_m), (0, 0, height_m))
    leaf = box((0.04, width_m, height_m - 0.05), (0, width_m / 2, height_m / 2))
    ajar = pose(exp_so3(np.array([0.0, 0.0, rng.uniform(0.5, 1.8)])), np.array([0.0, -width_m / 2, 0.0]))
    return [
        ("door frame", merge([*posts, lintel]), _material(rng, "plain")),
        ("door leaf", leaf.moved(ajar), _material(rng, "wood")),
    ]


def _ladder(rng: np.random.Generator, _: float) -> _Piece:
    """A step ladder, or one that leans: slanted rails and level rungs."""
    length_m, width_m = rng.uniform(1.6, 2.6), rng.uniform(0.35, 0.5)
    rails = [box((0.06, 0.03, length_m), (0, side * width_m / 2, length_m / 2)) for side in (-1.0, 1.0)]
    rungs = [box((0.05, width_m, 0.03), (0, 0, z)) for z in np.arange(0.25, length_m, 0.28)]
    return [("ladder", _lean(merge([*rails, *rungs]), rng, 35.0), _material(rng, "plain"))]


def _plank(rng: np.random.Generator, _: float) -> _Piece:
    """A board or beam that leans over."""
    size = rng.uniform([0.02, 0.08, 1.4], [0.08, 0.5, 2.4])
    return [("plank", _lean(box(size, (0, 0, size[2] / 2)), rng, 50.0), _material(rng))]


def _lean(mesh: Mesh, rng: np.random.Generator, most_deg: float) -> Mesh:
    """Tilt a mesh about a level axis, its lowest point back on the floor."""
    angle_rad = np.radians(rng.uniform(0.3, 1.0) * most_deg) * rng.choice([-1.0, 1.0])
    direction_rad = rng.uniform(-0.6, 0.6)  # mostly sideways, seen from one of the sides
    axis = np.array([np.cos(direction_rad), np.sin(direction_rad), 0.0])
    tilted = mesh.moved(pose(exp_so3(angle_rad * axis), np.zeros(3)))
    return replace(tilted, vertices=tilted.vertices - [0.0, 0.0, float(tilted.vertices[:, 2].min())])


def _tripod(rng: np.random.Generator, _: float) -> _Piece:
    height_m, reach_m = rng.uniform(0.9, 1.6), rng.uniform(0.25, 0.5)
    turns = rng.uniform(0, 2 * np.pi) + np.arange(3) * 2 * np.pi / 3
    legs = [cone((reach_m * np.cos(a), reach_m * np.sin(a), 0), (0, 0, height_m), 0.02) for a in turns]
    head = box(rng.uniform([0.1, 0.1, 0.1], [0.3, 0.4, 0.4]), (0, 0, height_m + 0.1))
    return [("tripod", merge(legs), _material(rng, "plain")), ("tripod head", head, _material(rng))]


def _hanging(rng: np.random.Generator, ceiling_m: float) -> _Piece:
    """A lamp shade or a sign below the ceiling."""
    bottom_m = rng.uniform(1.5, 2.1)
    cord = cone((0, 0, bottom_m + 0.2), (0, 0, ceiling_m), 0.008)
    if rng.random() < 0.5:
        shade = cone((0, 0, bottom_m), (0, 0, bottom_m + 0.25), rng.uniform(0.2, 0.35), 0.06)
    else:
        width_m, height_m = rng.uniform([0.4, 0.2], [0.9, 0.4])
        shade = box((0.02, width_m, height_m), (0, 0, bottom_m + height_m / 2))
    return [("cord", cord, _material(rng, "plain")), ("shade", shade, _material(rng, "plain"))]


def _plant(rng: np.random.Generator, _: float) -> _Piece:
    """A pot with leaves that stand out at all angles."""
    pot_m = rng.uniform(0.25, 0.45)
    leaves = []
    for _k in range(int(rng.integers(6, 14))):
        tip = rng.normal(0, 0.25, 3) + [0.0, 0.0, pot_m + 0.7]
        leaves.append(limb((0, 0, pot_m), tip, 0.012, 0.03))
        leaves.append(ellipsoid(tip, rng.uniform(0.03, 0.1, 3)))
    return [
        ("pot", cone((0, 0, 0), (0, 0, pot_m), 0.13, 0.18), _material(rng, "plain")),
        ("leaves", merge(leaves), Material((0.05, 0.25, 0.08), 0.6)),
    ]


def _paint(low: Array, high: Array, rng: np.random.Generator) -> Part:
    """A coloured rectangle on a wall or the floor, at any angle."""
    size = rng.uniform([0.1, 0.3], [0.8, 1.6])
    kind = int(rng.integers(4))
    x, y = rng.uniform([1.5, low[1] + 0.8], [high[0] - 0.8, high[1] - 0.8])
    z = rng.uniform(0.9, max(1.0, high[2] - 0.9))
    spots = (
        ((x, low[1], z), (0, 1, 0)),
        ((x, high[1], z), (0, -1, 0)),
        ((high[0], y, z), (-1, 0, 0)),
        ((x, y, 0.0), (0, 0, 1)),
    )
    at, facing = (np.array(value, dtype=np.float64) for value in spots[kind])
    up = np.array([1.0, 0.0, 0.0]) if kind == 3 else np.array([0.0, 0.0, 1.0])
    T = pose(np.stack([np.cross(up, facing), up, facing], axis=1), at + _PAINT_M * facing)
    T = T @ pose(exp_so3(np.array([0.0, 0.0, rng.choice([0.0, rng.uniform(-0.8, 0.8)])])), np.zeros(3))
    sheet = box((size[0], size[1], _PAINT_M)).moved(T)
    return "paint", sheet, _material(rng), T


_KINDS: dict[Callable[[np.random.Generator, float], _Piece], float] = {
    _shelf: 2.0,
    _table: 2.0,
    _cabinet: 1.5,
    _pillar: 1.0,
    _person: 1.5,
    _door: 0.7,
    _ladder: 1.2,
    _plank: 1.5,
    _tripod: 1.0,
    _hanging: 0.8,
    _plant: 0.8,
}
