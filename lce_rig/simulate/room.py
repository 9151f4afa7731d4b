"""The room around the rig, with decoys for the board detection, and the board's carrier."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lce_rig.core.board import Board
from lce_rig.core.geometry import Array, invert, pose, transform
from lce_rig.simulate.options import Carrier, Part
from lce_rig.simulate.scene import Raycaster, Surface
from lce_rig.simulate.surfaces import (
    MATERIALS,
    ROOM,
    Material,
    Mesh,
    box,
    cone,
    ellipsoid,
    inside_box,
    limb,
    merge,
    rectangle,
)

LIDAR_HEIGHT_M = 1.0
"""Height of the LiDAR above the floor: about that at which people hold boards."""
_SHAPES: dict[str, Callable[..., Mesh]] = {"box": box, "cone": cone}


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
    obstacles: Sequence[tuple[Array, Array]]

    def is_free(self, points_world: Array, margin_m: float = 0.1) -> NDArray[np.bool_]:
        """Find which points (N, 3) lie in the room, at least `margin_m` from everything in it."""
        points = transform(invert(self.T_world_room), points_world)
        free = np.all((points > self.low + margin_m) & (points < self.high - margin_m), axis=1)
        for low, high in self.obstacles:
            free &= ~np.all((points > low - margin_m) & (points < high + margin_m), axis=1)
        return np.asarray(free)


def build_room(heading_rad: float, rng: np.random.Generator, decoys: Sequence[Part] | None = None) -> Room:
    """Build the room around the rig.

    Args:
        heading_rad: azimuth that the first camera looks along, world.
        rng: source of the room's rotation relative to the rig.
        decoys: bodies instead of the usual furniture, in the room's frame; None keeps the furniture.
    """
    turn_rad = heading_rad + np.radians(rng.uniform(-6.0, 6.0))
    c, s = np.cos(turn_rad), np.sin(turn_rad)
    T_world_room = pose(np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]), np.zeros(3))
    low, high = np.array(ROOM["low"]), np.array(ROOM["high"])
    obstacles = [(np.array(near), np.array(far)) for near, far in ROOM["obstacles"]]
    if decoys is not None:
        obstacles = [(mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)) for _, mesh, _, _ in decoys]
    surfaces = [
        Surface(name, mesh.moved(T_world_room), MATERIALS[material], T_world_room @ T_room_surface)
        for name, mesh, material, T_room_surface in [
            *_shell(low, high),
            *(_furniture() if decoys is None else decoys),
        ]
    ]
    lamps = transform(T_world_room, np.array([[x, y, high[2] - 0.05] for x, y in ROOM["lamps"]]))
    return Room(T_world_room, Raycaster(surfaces), lamps, low, high, obstacles)


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
    lamps = [box((1.2, 0.3, 0.04), (x, y, high[2] - 0.02)) for x, y in ROOM["lamps"]]
    names = ["wall"] * 4 + ["floor", "ceiling", "skirting", "lamp"]
    meshes = [*faces, merge(skirting), merge(lamps)]
    return [(name, mesh, name, np.eye(4)) for name, mesh in zip(names, meshes, strict=True)]


def _furniture() -> list[Part]:
    parts: list[Part] = []
    for name, material, bodies in ROOM["furniture"]:
        meshes = [_SHAPES[shape](*values) for body in bodies for shape, values in body.items()]
        parts.append((name, merge(meshes), material, np.eye(4)))
    for name, material, size_m, middle, facing in ROOM["hangings"]:
        right = np.cross([0.0, 0.0, 1.0], facing)
        T = pose(np.stack([right, [0.0, 0.0, 1.0], facing], axis=1), np.array(middle))
        parts.append((name, rectangle(*size_m).moved(T), material, T))
    return parts


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
        Surface("stand", merge([poles, arm, deck.moved(R)]), MATERIALS["stand"], R),
        Surface("stand wheels", merge(wheels).moved(R_floor), MATERIALS["rubber"], R),
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
    body = _body(size)
    vertices = np.concatenate([mesh.moved(T).vertices for mesh, _ in body.values()])
    T[:3, 3] += _clearance(vertices, board, T_world_board, rng.uniform(0.04, 0.15)) * back
    shirts = [material for name, material in MATERIALS.items() if name.endswith("shirt")]
    shirt = shirts[rng.integers(len(shirts))]
    shoulders = transform(T, np.array([[0.0, s * 0.19, 1.40] for s in (-1.0, 1.0)]) * size)
    arms, hands = _arms(board, T_world_board, shoulders, back)
    surfaces = [Surface(name, mesh.moved(T), material or shirt, T) for name, (mesh, material) in body.items()]
    return [*surfaces, Surface("sleeves", arms, shirt, T), Surface("hands", hands, MATERIALS["skin"], T)]


def _body(size: float) -> dict[str, tuple[Mesh, Material | None]]:
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
        "head": (merge(head), MATERIALS["skin"]),
        "hair": (merge(hair), MATERIALS["hair"]),
        "legs": (merge(legs), MATERIALS["trousers"]),
        "shoes": (merge(shoes), MATERIALS["rubber"]),
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
