"""Who or what carries the board: a trolley with poles, or a person."""

import numpy as np

from lce_rig.core.board import Board
from lce_rig.core.geometry import Array, transform
from lce_rig.simulate.materials import Material
from lce_rig.simulate.options import Carrier
from lce_rig.simulate.scene import Surface
from lce_rig.simulate.shapes import Mesh, box, cone, ellipsoid, limb, merge

_STEEL = Material((0.50, 0.50, 0.50), 0.5)
_RUBBER = Material((0.03, 0.03, 0.03), 0.08)
_SKIN = Material((0.30, 0.42, 0.62), 0.6)
_HAIR = Material((0.02, 0.02, 0.025), 0.12)
_TROUSERS = Material((0.16, 0.13, 0.11), 0.35, "cloth")
SHIRTS = (
    Material((0.20, 0.10, 0.07), 0.55, "cloth"),
    Material((0.12, 0.12, 0.30), 0.45, "cloth"),
    Material((0.10, 0.20, 0.09), 0.5, "cloth"),
    Material((0.07, 0.07, 0.07), 0.3, "cloth"),
)


def build_carrier(
    carrier: Carrier, board: Board, T_world_board: Array, rng: np.random.Generator
) -> list[Surface]:
    """Build what carries the board at T_world_board (4, 4), standing on the floor z = 0 behind it."""
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
    """Find how far bodies must move backwards so that all they have near the plate lies `gap_m` behind it.

    Args:
        bodies: (N, 3) points all over them, m, world.
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
        Surface("stand", merge([poles, arm, deck.moved(R)]), _STEEL, R),
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
        "hair": (merge(hair), _HAIR),
        "legs": (merge(legs), _TROUSERS),
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
