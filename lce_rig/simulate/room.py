"""The room around the rig, with objects that a detector must not mistake for the board."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lce_rig.core.board import Board
from lce_rig.core.geometry import Array, invert, pose, transform
from lce_rig.simulate.furniture import draw_furniture
from lce_rig.simulate.materials import Material
from lce_rig.simulate.scene import PLATE, Raycaster, Surface
from lce_rig.simulate.shapes import Mesh, box, cone, inside_box, merge, rectangle

_WALL = Material((0.66, 0.70, 0.72), 0.75)
_FLOOR = Material((0.42, 0.47, 0.50), 0.45, "tiles", gloss=0.5)
_CEILING = Material((0.75, 0.77, 0.78), 0.8, "panels")
_SKIRTING = Material((0.05, 0.06, 0.08), 0.15)
_WOOD = Material((0.16, 0.30, 0.48), 0.5, "wood")
_STEEL = Material((0.28, 0.28, 0.28), 0.35)
_RED = Material((0.05, 0.05, 0.45), 0.5)
_DARK = Material((0.03, 0.03, 0.035), 0.1)
_CARDBOARD = Material((0.22, 0.38, 0.50), 0.6, "cloth")
_POSTER = Material((0.9, 0.9, 0.9), 0.8, "poster")
_LAMP = Material((1.0, 1.0, 1.0), 0.7, emission=1.6)
_WINDOW = Material((0.95, 0.90, 0.86), 0.0, "window", emission=1.0)

LIDAR_HEIGHT_M = 1.0
# Room frame: x along the first camera's sight, y left, z up, origin on the floor below the LiDAR.
_LOW = np.array([-4.6, -3.1, 0.0])
_HIGH = np.array([9.0, 3.4, 3.1])
# (low, high) of what stands in the room, to keep the board out of it
_OBSTACLES: tuple[tuple[Array, Array], ...] = (
    (np.array([4.9, 1.2, 0.0]), np.array([5.5, 1.8, 3.1])),
    (np.array([4.6, -3.1, 0.0]), np.array([6.3, -2.0, 1.3])),
    (np.array([1.9, 2.5, 0.0]), np.array([2.6, 3.4, 2.0])),
)
_LAMP_SPOTS = ((-2.6, 0.2), (0.6, 1.3), (0.6, -1.2), (3.6, 1.3), (3.6, -1.2), (6.8, 0.2))


@dataclass(frozen=True, eq=False)
class Room:
    """The static objects.

    Attributes:
        T_world_room: (4, 4); world has the LiDAR's heading, z up, origin on the floor below the LiDAR.
        raycaster: of all surfaces.
        lamps: (P, 3) m, world.
        low, high: (3,) corners, m, frame room.
        obstacles: (low, high) of what stands in it, m, frame room.
        T_world_decoy: (4, 4) pose of the blank decoy plate; None without.
    """

    T_world_room: Array
    raycaster: Raycaster
    lamps: Array
    low: Array
    high: Array
    obstacles: tuple[tuple[Array, Array], ...]
    T_world_decoy: Array | None = None

    def is_free(self, points_world: Array, margin_m: float = 0.1) -> NDArray[np.bool_]:
        """Find which points (N, 3) lie in the room, at least `margin_m` from everything in it."""
        points = transform(invert(self.T_world_room), points_world)
        free = np.all((points > self.low + margin_m) & (points < self.high - margin_m), axis=1)
        for low, high in self.obstacles:
            free &= ~np.all((points > low - margin_m) & (points < high + margin_m), axis=1)
        if self.T_world_decoy is not None:
            away = np.linalg.norm((points_world - self.T_world_decoy[:3, 3])[:, :2], axis=1)
            free &= away > 0.6 + margin_m
        return np.asarray(free)


def build_room(
    heading_rad: float,
    rng: np.random.Generator,
    decoy: Board | None = None,
    *,
    is_furnished: bool = False,
) -> Room:
    """Build the room around the rig.

    Args:
        heading_rad: azimuth that the first camera looks along, world.
        rng: source of the room's turn against the rig, of the decoy's place and of drawn furniture.
        decoy: a blank plate of this board's size stands at the side; None for none.
        is_furnished: whether the room's size and furniture are drawn, instead of one room for all.
    """
    turn_rad = heading_rad + np.radians(rng.uniform(-6.0, 6.0))
    T_world_room = pose(_turn_z(turn_rad), np.zeros(3))
    low, high, obstacles = _LOW, _HIGH, _OBSTACLES
    T_room_decoy = None if decoy is None else _decoy_pose(rng)
    if is_furnished:
        low, high = (
            low + rng.uniform([-1, -1, 0], [1, 0.6, 0]),
            high + rng.uniform([-1, -0.6, -0.5], [3, 1, 0.6]),
        )
        pieces, bounds = draw_furniture(low, high, rng)
        parts, obstacles = [*_shell(low, high), *pieces], tuple(bounds)
    else:
        parts = [*_shell(low, high), *_furniture()]
    if decoy is not None and T_room_decoy is not None:
        parts += _decoy(decoy, T_room_decoy)
    surfaces = [
        Surface(name, mesh.moved(T_world_room), material, T_world_room @ T_room_surface)
        for name, mesh, material, T_room_surface in parts
    ]
    lamps = transform(T_world_room, np.array([[x, y, high[2] - 0.05] for x, y in _LAMP_SPOTS]))
    T_world_decoy = None if T_room_decoy is None else T_world_room @ T_room_decoy
    return Room(T_world_room, Raycaster(surfaces), lamps, low, high, obstacles, T_world_decoy)


_Part = tuple[str, Mesh, Material, Array]


def _turn_z(angle_rad: float) -> Array:
    c, s = np.cos(angle_rad), np.sin(angle_rad)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def _part(name: str, mesh: Mesh, material: Material) -> _Part:
    return name, mesh, material, np.eye(4)


def _on_wall(name: str, size_m: tuple[float, float], at: Array, facing: Array, material: Material) -> _Part:
    """Place a rectangle upright, its middle at `at`, facing along `facing` (horizontal)."""
    right = np.cross([0.0, 0.0, 1.0], facing)
    T = pose(np.stack([right, [0.0, 0.0, 1.0], facing], axis=1), at)
    return name, rectangle(*size_m).moved(T), material, T


def _shell(low: Array, high: Array) -> list[_Part]:
    size, middle = high - low, (high + low) / 2
    walls = inside_box(size, middle)
    # Faces come in the order -x +x -y +y -z +z, two triangles and four vertices each.
    faces = [
        Mesh(walls.vertices[4 * k : 4 * k + 4], walls.normals[4 * k : 4 * k + 4], walls.triangles[:2])
        for k in range(6)
    ]
    thick = 0.02
    skirting = [
        box((size[0], thick, 0.12), (middle[0], y, 0.06)) for y in (low[1] + thick / 2, high[1] - thick / 2)
    ] + [box((thick, size[1], 0.12), (x, middle[1], 0.06)) for x in (low[0] + thick / 2, high[0] - thick / 2)]
    lamps = [box((1.2, 0.3, 0.04), (x, y, high[2] - 0.02)) for x, y in _LAMP_SPOTS]
    return [
        *(_part("wall", face, _WALL) for face in faces[:4]),
        _part("floor", faces[4], _FLOOR),
        _part("ceiling", faces[5], _CEILING),
        _part("skirting", merge(skirting), _SKIRTING),
        _part("lamp", merge(lamps), _LAMP),
    ]


def _furniture() -> list[_Part]:
    pillar = box((0.6, 0.6, 3.1), (5.2, 1.5, 1.55))
    legs = [cone((x, y, 0), (x, y, 0.72), 0.025) for x in (4.7, 6.2) for y in (-2.95, -2.1)]
    screen = box((0.05, 0.55, 0.34), (5.3, -2.55, 1.1))
    left, right, front, back = (
        np.array(v, dtype=np.float64) for v in ([0, -1, 0], [0, 1, 0], [-1, 0, 0], [1, 0, 0])
    )
    return [
        _part("pillar", pillar, _WALL),
        _part("skirting", box((0.64, 0.64, 0.12), (5.2, 1.5, 0.06)), _SKIRTING),
        _part("table", box((1.6, 0.95, 0.035), (5.45, -2.52, 0.737)), _WOOD),
        _part("table legs", merge(legs), _STEEL),
        _part("screen", merge([screen, cone((5.32, -2.55, 0.75), (5.32, -2.55, 1.0), 0.03)]), _DARK),
        _part("carton", box((0.45, 0.4, 0.32), (5.95, -2.5, 0.915)), _CARDBOARD),
        _part("bin", cone((4.35, 2.9, 0.0), (4.35, 2.9, 0.55), 0.17, 0.2), _RED),
        _part("cabinet", box((0.25, 0.7, 0.95), (6.6, 3.28, 1.25)), _RED),
        _part("shelf", box((0.6, 0.8, 1.9), (2.25, 2.98, 0.95)), _WOOD),
        _part("door", box((1.0, 0.06, 2.1), (2.6, -3.08, 1.05)), _WOOD),
        _part("window frame", box((0.08, 3.7, 2.0), (8.98, 0.6, 1.7)), _DARK),
        _on_wall("window", (3.6, 1.9), np.array([8.93, 0.6, 1.7]), front, _WINDOW),
        _on_wall("poster", (0.9, 1.2), np.array([4.9, 3.39, 1.55]), left, _POSTER),
        _on_wall("poster", (0.9, 1.2), np.array([7.4, -3.09, 1.6]), right, _POSTER),
        _on_wall("poster", (0.9, 1.2), np.array([8.98, -2.2, 1.6]), front, _POSTER),
        _on_wall("poster", (0.9, 1.2), np.array([-4.59, -0.8, 1.6]), back, _POSTER),
        _on_wall("poster", (0.9, 1.2), np.array([-1.8, 3.39, 1.6]), left, _POSTER),
    ]


def _decoy_pose(rng: np.random.Generator) -> Array:
    """Choose where the decoy hangs at the LiDAR's height, about facing the rig, in the room frame."""
    azimuth_rad = rng.choice([-1.0, 1.0]) * np.radians(rng.uniform(50.0, 75.0))
    distance_m = rng.uniform(1.9, 2.3)
    at = np.array([distance_m * np.cos(azimuth_rad), distance_m * np.sin(azimuth_rad), LIDAR_HEIGHT_M])
    facing = _turn_z(azimuth_rad + np.radians(rng.uniform(-15.0, 15.0))) @ np.array([-1.0, 0.0, 0.0])
    upright = np.stack([np.cross([0.0, 0.0, 1.0], facing), [0.0, 0.0, 1.0], facing], axis=1)
    return pose(upright @ _turn_z(np.radians(rng.uniform(35.0, 55.0))), at)


def _decoy(board: Board, T_room_decoy: Array) -> list[_Part]:
    plate = rectangle(board.width_m, board.height_m).moved(T_room_decoy)
    foot = T_room_decoy[:3, 3] - 0.06 * T_room_decoy[:3, 2]
    pole = cone((foot[0], foot[1], 0.02), foot, 0.015)
    base = box((0.4, 0.4, 0.03), (foot[0], foot[1], 0.015))
    return [
        ("decoy plate", plate, PLATE, T_room_decoy),
        _part("decoy stand", merge([pole, base]), _STEEL),
    ]
