"""The room around the rig, with decoys for the board detection, and the board's carrier."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lce_rig.core.board import Board
from lce_rig.core.geometry import Array, invert, pose, transform
from lce_rig.simulate.options import Carrier, Furnish, Obstacles, Part
from lce_rig.simulate.scene import Raycaster, Surface
from lce_rig.simulate.surfaces import Material, Mesh, box, cone, ellipsoid, inside_box, limb, merge, rectangle

# Materials by eye; none was measured. Dark ones of low reflectivity return weakly, the window not at all.
_WALL = Material((0.66, 0.70, 0.72), 0.75)
_SKIRTING = Material((0.05, 0.06, 0.08), 0.15)
_WOOD = Material((0.16, 0.30, 0.48), 0.5, "wood")
_RED = Material((0.05, 0.05, 0.45), 0.5)
_DARK = Material((0.03, 0.03, 0.035), 0.1)
_POSTER = Material((0.9, 0.9, 0.9), 0.8, "poster")

LIDAR_HEIGHT_M = 1.0
"""Height of the LiDAR above the floor: about that at which people hold boards."""
# Room frame: x along the first camera's sight, y left, z up, origin on the floor below the LiDAR.
_LOW = np.array([-4.6, -3.1, 0.0])
_HIGH = np.array([9.0, 3.4, 3.1])
# (low, high) of objects in the room, to keep the board out of them, m, frame room.
_OBSTACLES: Obstacles = (
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
        raycaster: ray caster of all surfaces.
        lamps: (P, 3) m, world.
        low, high: (3,) corners, m, frame room.
        obstacles: (low, high) of objects in it, m, frame room.
    """

    T_world_room: Array
    raycaster: Raycaster
    lamps: Array
    low: Array
    high: Array
    obstacles: Obstacles

    def is_free(self, points_world: Array, margin_m: float = 0.1) -> NDArray[np.bool_]:
        """Find which points (N, 3) lie in the room, at least `margin_m` from everything in it."""
        points = transform(invert(self.T_world_room), points_world)
        free = np.all((points > self.low + margin_m) & (points < self.high - margin_m), axis=1)
        for low, high in self.obstacles:
            free &= ~np.all((points > low - margin_m) & (points < high + margin_m), axis=1)
        return np.asarray(free)


def build_room(heading_rad: float, rng: np.random.Generator, furnish: Furnish | None = None) -> Room:
    """Build the room around the rig.

    Args:
        heading_rad: azimuth that the first camera looks along, world.
        rng: source of the room's rotation relative to the rig, and of its furniture.
        furnish: draws corners (3,), parts and obstacles of a room from those of the usual one; None keeps it.
    """
    turn_rad = heading_rad + np.radians(rng.uniform(-6.0, 6.0))
    c, s = np.cos(turn_rad), np.sin(turn_rad)
    T_world_room = pose(np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]), np.zeros(3))
    low, high, obstacles, parts = _LOW, _HIGH, _OBSTACLES, _furniture()
    if furnish is not None:
        low, high, parts, obstacles = furnish(low, high, rng)
    parts = [*_shell(low, high), *parts]
    surfaces = [
        Surface(name, mesh.moved(T_world_room), material, T_world_room @ T_room_surface)
        for name, mesh, material, T_room_surface in parts
    ]
    lamps = transform(T_world_room, np.array([[x, y, high[2] - 0.05] for x, y in _LAMP_SPOTS]))
    return Room(T_world_room, Raycaster(surfaces), lamps, low, high, obstacles)


def _part(name: str, mesh: Mesh, material: Material) -> Part:
    return name, mesh, material, np.eye(4)


def _on_wall(name: str, size_m: tuple[float, float], at: Array, facing: Array, material: Material) -> Part:
    """Place a rectangle upright, its middle at `at`, facing along `facing` (horizontal)."""
    right = np.cross([0.0, 0.0, 1.0], facing)
    T = pose(np.stack([right, [0.0, 0.0, 1.0], facing], axis=1), at)
    return name, rectangle(*size_m).moved(T), material, T


def _shell(low: Array, high: Array) -> list[Part]:
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
        _part("floor", faces[4], Material((0.42, 0.47, 0.50), 0.45, "tiles")),
        _part("ceiling", faces[5], Material((0.75, 0.77, 0.78), 0.8, "panels")),
        _part("skirting", merge(skirting), _SKIRTING),
        _part("lamp", merge(lamps), Material((1.0, 1.0, 1.0), 0.7, emission=1.6)),
    ]


def _furniture() -> list[Part]:
    pillar = box((0.6, 0.6, 3.1), (5.2, 1.5, 1.55))
    legs = [cone((x, y, 0), (x, y, 0.72), 0.025) for x in (4.7, 6.2) for y in (-2.95, -2.1)]
    screen = box((0.05, 0.55, 0.34), (5.3, -2.55, 1.1))
    left, right, front, back = (
        np.array(v, dtype=np.float64) for v in ([0, -1, 0], [0, 1, 0], [-1, 0, 0], [1, 0, 0])
    )
    cardboard = Material((0.22, 0.38, 0.50), 0.6, "cloth")
    glass = Material((0.95, 0.90, 0.86), 0.0, "window", emission=1.0)
    return [
        _part("pillar", pillar, _WALL),
        _part("skirting", box((0.64, 0.64, 0.12), (5.2, 1.5, 0.06)), _SKIRTING),
        _part("table", box((1.6, 0.95, 0.035), (5.45, -2.52, 0.737)), _WOOD),
        _part("table legs", merge(legs), Material((0.28, 0.28, 0.28), 0.35)),
        _part("screen", merge([screen, cone((5.32, -2.55, 0.75), (5.32, -2.55, 1.0), 0.03)]), _DARK),
        _part("carton", box((0.45, 0.4, 0.32), (5.95, -2.5, 0.915)), cardboard),
        _part("bin", cone((4.35, 2.9, 0.0), (4.35, 2.9, 0.55), 0.17, 0.2), _RED),
        _part("cabinet", box((0.25, 0.7, 0.95), (6.6, 3.28, 1.25)), _RED),
        _part("shelf", box((0.6, 0.8, 1.9), (2.25, 2.98, 0.95)), _WOOD),
        _part("door", box((1.0, 0.06, 2.1), (2.6, -3.08, 1.05)), _WOOD),
        _part("window frame", box((0.08, 3.7, 2.0), (8.98, 0.6, 1.7)), _DARK),
        _on_wall("window", (3.6, 1.9), np.array([8.93, 0.6, 1.7]), front, glass),
        _on_wall("poster", (0.9, 1.2), np.array([4.9, 3.39, 1.55]), left, _POSTER),
        _on_wall("poster", (0.9, 1.2), np.array([7.4, -3.09, 1.6]), right, _POSTER),
        _on_wall("poster", (0.9, 1.2), np.array([8.98, -2.2, 1.6]), front, _POSTER),
        _on_wall("poster", (0.9, 1.2), np.array([-4.59, -0.8, 1.6]), back, _POSTER),
        _on_wall("poster", (0.9, 1.2), np.array([-1.8, 3.39, 1.6]), left, _POSTER),
    ]


# Materials of the carriers, by eye as the room's.
_RUBBER = Material((0.03, 0.03, 0.03), 0.08)
_SKIN = Material((0.30, 0.42, 0.62), 0.6)
SHIRTS = (
    Material((0.20, 0.10, 0.07), 0.55, "cloth"),
    Material((0.12, 0.12, 0.30), 0.45, "cloth"),
    Material((0.10, 0.20, 0.09), 0.5, "cloth"),
    Material((0.07, 0.07, 0.07), 0.3, "cloth"),
)


def build_carrier(
    carrier: Carrier, board: Board, T_world_board: Array, rng: np.random.Generator
) -> list[Surface]:
    """Build the board's carrier for T_world_board (4, 4), standing on the floor z = 0 behind the board."""
    if carrier == "stand":
        return _stand(board, T_world_board)
    if carrier == "person":
        return _person(board, T_world_board, rng)
    return []


def _backwards(T_world_board: Array) -> Array:
    """The horizontal direction (3,) away from the board's back."""
    normal = T_world_board[:3, 2] * [1.0, 1.0, 0.0]
    return np.asarray(-normal / max(float(np.linalg.norm(normal)), 1e-6))


def _clearance(bodies: Array, board: Board, T_world_board: Array, gap_m: float) -> float:
    """Compute how far bodies must move backwards so that their parts near the plate are `gap_m` behind it.

    Args:
        bodies: (N, 3) points on their surfaces, m, world.
        board: the board.
        T_world_board: (4, 4).
        gap_m: distance left.
    """
    along = float(T_world_board[:3, 2] @ _backwards(T_world_board))  # negative: backwards leaves the pattern
    outline = transform(T_world_board, board.outline())
    low, high = outline[:, 2].min() - 0.1, outline[:, 2].max() + 0.1
    near = bodies[(bodies[:, 2] > low) & (bodies[:, 2] < high)]
    ahead = (near - T_world_board[:3, 3]) @ T_world_board[:3, 2]
    return float(np.max((ahead + gap_m) / -along, initial=0.0))


def _stand(board: Board, T_world_board: Array) -> list[Surface]:
    centre, back = T_world_board[:3, 3], _backwards(T_world_board)
    side = np.cross([0.0, 0.0, 1.0], back)
    spots = [0.05 * side, -0.05 * side, 0.05 * side + 0.1 * back, -0.05 * side + 0.1 * back]
    top_m = float(centre[2])
    feet = np.stack([centre + spot for spot in spots]) * [1.0, 1.0, 0.0]
    heights = np.linspace(0.14, top_m, 41)[:, None, None] * np.array([0.0, 0.0, 1.0])
    away = back * (_clearance((feet + heights).reshape(-1, 3), board, T_world_board, 0.03) + 0.011)
    poles = merge([cone(foot + away + heights[0, 0], foot + away + heights[-1, 0], 0.011) for foot in feet])
    arm = cone(centre - 0.008 * T_world_board[:3, 2], centre + away + 0.1 * back, 0.014)
    hub = centre + away + 0.05 * back
    deck = box((0.34, 0.26, 0.03))
    R = np.eye(4)
    R[:3, :3] = np.stack([back, side, [0.0, 0.0, 1.0]], axis=1)
    R[:3, 3] = [hub[0], hub[1], 0.13]
    wheels = [ellipsoid((x, y, 0.06), (0.055, 0.018, 0.06)) for x in (-0.15, 0.15) for y in (-0.11, 0.11)]
    R_floor = R.copy()
    R_floor[2, 3] = 0.0
    return [
        Surface("stand", merge([poles, arm, deck.moved(R)]), Material((0.50, 0.50, 0.50), 0.5), R),
        Surface("stand wheels", merge(wheels).moved(R_floor), _RUBBER, R),
    ]


def _person(board: Board, T_world_board: Array, rng: np.random.Generator) -> list[Surface]:
    """Stand a person behind the board, facing it, holding it at two opposite corners."""
    size = rng.uniform(0.94, 1.05)
    centre, back = T_world_board[:3, 3], _backwards(T_world_board)
    side = np.cross([0.0, 0.0, 1.0], back)
    T = np.eye(4)
    T[:3, :3] = np.stack([back, side, [0.0, 0.0, 1.0]], axis=1)
    T[:3, 3] = [centre[0], centre[1], 0.0]
    T[:3, 3] += rng.uniform(-0.06, 0.06) * side
    body = build_body(size)
    vertices = np.concatenate([mesh.moved(T).vertices for mesh, _ in body.values()])
    T[:3, 3] += _clearance(vertices, board, T_world_board, rng.uniform(0.04, 0.15)) * back
    shirt = SHIRTS[rng.integers(len(SHIRTS))]
    shoulders = transform(T, np.array([[0.0, s * 0.19, 1.40] for s in (-1.0, 1.0)]) * size)
    arms, hands = _arms(board, T_world_board, shoulders, back)
    surfaces = [Surface(name, mesh.moved(T), material or shirt, T) for name, (mesh, material) in body.items()]
    return [*surfaces, Surface("sleeves", arms, shirt, T), Surface("hands", hands, _SKIN, T)]


def build_body(size: float) -> dict[str, tuple[Mesh, Material | None]]:
    """Build torso, head and legs, x backwards, standing on the origin; None takes the shirt's material."""
    s = size
    torso = [
        ellipsoid((0, 0, 1.22 * s), (0.115 * s, 0.19 * s, 0.30 * s)),
        ellipsoid((0, 0, 1.36 * s), (0.10 * s, 0.215 * s, 0.12 * s)),
        ellipsoid((0, 0, 0.96 * s), (0.12 * s, 0.175 * s, 0.16 * s)),
    ]
    head = [
        ellipsoid((0, 0, 1.63 * s), (0.10 * s, 0.078 * s, 0.12 * s)),
        cone((0, 0, 1.45 * s), (0, 0, 1.56 * s), 0.055),
    ]
    hair = [ellipsoid((0.018 * s, 0, 1.665 * s), (0.10 * s, 0.085 * s, 0.10 * s))]
    legs = [
        limb((0, y, 0.90 * s), (0.02, 1.25 * y, 0.09 * s), 0.085 * s, 0.05 * s) for y in (-0.09 * s, 0.09 * s)
    ]
    shoes = [ellipsoid((-0.05, 1.3 * y, 0.04), (0.14, 0.05, 0.05)) for y in (-0.09 * s, 0.09 * s)]
    return {
        "torso": (merge(torso), None),
        "head": (merge(head), _SKIN),
        "hair": (merge(hair), Material((0.02, 0.02, 0.025), 0.12)),
        "legs": (merge(legs), Material((0.16, 0.13, 0.11), 0.35, "cloth")),
        "shoes": (merge(shoes), _RUBBER),
    }


def _arms(board: Board, T_world_board: Array, shoulders: Array, back: Array) -> tuple[Mesh, Mesh]:
    """Build arms from the shoulders (2, 3) to hands that reach over the plate's outermost corners."""
    outline = transform(T_world_board, board.outline())
    side = shoulders[1] - shoulders[0]
    reach = (outline - T_world_board[:3, 3]) @ side
    arms, hands = [], []
    for shoulder, corner in zip(shoulders, (int(np.argmin(reach)), int(np.argmax(reach))), strict=True):
        # A hand holds an edge a little below the corner, its fingertips 2 cm over the plate.
        lower = min((corner + 1) % 4, (corner - 1) % 4, key=lambda k: outline[k, 2])
        grip = outline[corner] + 0.12 * (outline[lower] - outline[corner])
        outwards = grip - T_world_board[:3, 3]
        outwards /= np.linalg.norm(outwards)
        hand = grip + 0.03 * outwards
        wrist = hand + 0.07 * back + 0.02 * outwards
        elbow = (shoulder + wrist) / 2 + 0.10 * back + np.array([0.0, 0.0, -0.12])
        arms += [limb(shoulder, elbow, 0.055, 0.045), limb(elbow, wrist, 0.045, 0.035)]
        hands += [ellipsoid(hand, (0.048, 0.048, 0.055)), limb(wrist, hand, 0.032, 0.035)]
    return merge(arms), merge(hands)
