"""Bodies of the room: meshes of simple shapes, and materials for a camera and a LiDAR."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import yaml
from numpy.typing import NDArray

from lce_rig.core.geometry import Array, pose, transform

Pattern = Literal["plain", "tiles", "panels", "poster", "wood", "cloth", "window"]


@dataclass(frozen=True)
class Material:
    """How a surface reflects.

    Attributes:
        colour: linear (blue, green, red) albedo, 0..1.
        reflectivity: at the LiDAR's 905 nm, 0..1; 0 gives no return (glass).
        pattern: texture on the surface.
        emission: linear radiance of its own, in units of the albedo.
    """

    colour: Sequence[float]
    reflectivity: float
    pattern: Pattern = "plain"
    emission: float = 0.0


ROOM = yaml.safe_load(Path(__file__).with_name("room.yaml").read_text(encoding="utf-8"))
"""The room's size, lamps, furniture and materials."""
MATERIALS = {name: Material(**material) for name, material in ROOM["materials"].items()}

_LATTICE = np.random.default_rng(20240521).random((64, 64))


def value_noise(u: Array, v: Array) -> Array:
    """Interpolate a fixed random lattice of unit spacing: smooth stains, 0..1."""
    u0, v0 = np.floor(u).astype(np.int64), np.floor(v).astype(np.int64)
    fu, fv = u - u0, v - v0
    fu, fv = fu * fu * (3 - 2 * fu), fv * fv * (3 - 2 * fv)
    a, b = _LATTICE[u0 % 64, v0 % 64], _LATTICE[(u0 + 1) % 64, v0 % 64]
    c, d = _LATTICE[u0 % 64, (v0 + 1) % 64], _LATTICE[(u0 + 1) % 64, (v0 + 1) % 64]
    return np.asarray((a * (1 - fu) + b * fu) * (1 - fv) + (c * (1 - fu) + d * fu) * fv)


def albedo(material: Material, points: Array, normals: Array) -> Array:
    """Evaluate the printed texture at points of a surface.

    Args:
        material: the surface's material.
        points: (N, 3) m in the surface's own frame.
        normals: (N, 3) unit, same frame.

    Returns:
        (N, 3) linear (blue, green, red) albedo.
    """
    # Texture coordinates: the two axes the surface is not facing along.
    facing = np.argmax(np.abs(normals), axis=1)
    rows = np.arange(len(points))
    u = np.where(facing == 0, points[:, 1], points[:, 0])
    v = points[rows, np.where(facing == 2, 1, 2)]
    colour = np.asarray(material.colour)
    shade = _printed(material.pattern, u, v)
    tint = shade if shade.ndim == 2 else shade[:, None]
    return np.asarray(np.clip(colour * tint, 0.0, 1.0))


def _printed(pattern: Pattern, u: Array, v: Array) -> Array:
    """Evaluate the shade (N,), or (N, 3) with colours, of a pattern at texture coordinates (N,) m."""
    if pattern == "plain":
        return 0.90 + 0.07 * value_noise(1.3 * u, 1.3 * v) + 0.05 * value_noise(9 * u, 9 * v)
    if pattern == "cloth":
        return 0.75 + 0.35 * value_noise(14 * u, 6 * v) + 0.1 * value_noise(90 * u, 90 * v)
    if pattern == "wood":
        return 0.75 + 0.35 * value_noise(3 * u + 0.3 * value_noise(2 * u, 2 * v), 45 * v)
    if pattern == "panels":
        is_joint = (np.mod(u, 0.6) < 0.015) | (np.mod(v, 0.6) < 0.015)
        return np.where(is_joint, 0.6, 0.95 + 0.05 * value_noise(30 * u, 30 * v))
    if pattern == "window":
        # A façade across the street: floors and window bands under a bright sky.
        band = (np.mod(v, 0.62) < 0.34) & (np.mod(u, 0.9) < 0.68)
        front = np.where(band, 0.32 + 0.3 * value_noise(5 * u, 7 * v), 0.72)
        is_frame = (np.mod(u + 0.02, 1.1) < 0.05) | (np.mod(v + 0.02, 1.4) < 0.05)
        return np.where(is_frame, 0.12, np.where(v > 2.3, 1.0, front))
    if pattern == "poster":
        return _poster(u, v)
    size_m, joint_m = 0.8, 0.006
    row, column = (np.floor(axis / size_m).astype(np.int64) % 64 for axis in (u, v))
    tile = 0.94 + 0.08 * _LATTICE[row, column]
    stain = 0.82 + 0.2 * value_noise(0.9 * u + 7, 0.9 * v) + 0.06 * value_noise(25 * u, 25 * v)
    is_joint = (np.mod(u, size_m) < joint_m) | (np.mod(v, size_m) < joint_m)
    return np.where(is_joint, 0.45, tile * np.minimum(stain, 1.05))


def _poster(u: Array, v: Array) -> Array:
    """A conference poster: a title bar, columns of text, coloured figures."""
    x, y = np.mod(u / 0.9 + 0.5, 1.0), np.mod(v / 1.2 + 0.5, 1.0)
    is_text = (np.mod(y, 0.018) < 0.009) & (value_noise(60 * x, np.floor(y / 0.018) * 3.7) > 0.35)
    is_text &= (np.mod(x, 0.33) > 0.03) & (np.mod(x, 0.33) < 0.31) & (y < 0.84)
    shade = np.where(is_text, 0.25, 0.95)[:, None] * np.ones(3)
    figure = (np.mod(x, 0.33) > 0.04) & (np.mod(x, 0.33) < 0.30) & (np.mod(y + 0.07, 0.28) < 0.12) & (y < 0.8)
    index = (np.floor(x / 0.33) + 3 * np.floor((y + 0.07) / 0.28)).astype(np.int64)
    tints = np.array([[0.75, 0.45, 0.2], [0.25, 0.5, 0.85], [0.35, 0.7, 0.4], [0.3, 0.3, 0.7]])
    graph = 0.5 + 0.6 * value_noise(40 * x, 40 * y)
    shade = np.where(figure[:, None], tints[index % 4] * graph[:, None], shade)
    return np.where((y > 0.86)[:, None], np.array([0.55, 0.28, 0.12]), shade)


@dataclass(frozen=True, eq=False)
class Mesh:
    """A triangle mesh.

    Attributes:
        vertices: (N, 3) m.
        normals: (N, 3) unit, interpolated over each triangle.
        triangles: (M, 3) uint32 indices of vertices.
    """

    vertices: Array
    normals: Array
    triangles: NDArray[np.uint32]

    def moved(self, T_a_b: Array) -> "Mesh":
        """Transform the mesh from frame b to frame a."""
        return Mesh(transform(T_a_b, self.vertices), self.normals @ T_a_b[:3, :3].T, self.triangles)


def merge(meshes: Sequence[Mesh]) -> Mesh:
    """Join meshes into one."""
    starts = np.cumsum([0] + [len(mesh.vertices) for mesh in meshes[:-1]])
    return Mesh(
        np.concatenate([mesh.vertices for mesh in meshes]),
        np.concatenate([mesh.normals for mesh in meshes]),
        np.concatenate([mesh.triangles + np.uint32(s) for mesh, s in zip(meshes, starts, strict=True)]),
    )


def rectangle(width_m: float, height_m: float) -> Mesh:
    """Build a rectangle in the plane z = 0 around the origin, facing +z."""
    w, h = width_m / 2, height_m / 2
    vertices = np.array([[-w, -h, 0], [w, -h, 0], [w, h, 0], [-w, h, 0]], dtype=np.float64)
    triangles = np.array([[0, 1, 2], [0, 2, 3]], dtype=np.uint32)
    return Mesh(vertices, np.tile([0.0, 0.0, 1.0], (4, 1)), triangles)


def box(size_m: Sequence[float] | Array, centre: Sequence[float] | Array = (0.0, 0.0, 0.0)) -> Mesh:
    """Build a box along the axes, flat-shaded, facing outwards."""
    half = np.asarray(size_m, dtype=np.float64) / 2
    faces = []
    for axis in range(3):
        for sign in (-1.0, 1.0):
            normal = np.zeros(3)
            normal[axis] = sign
            right = np.zeros(3)
            right[(axis + 1) % 3] = 1.0
            R = np.stack([right, np.cross(normal, right), normal], axis=1)
            size = 2 * np.abs(R.T @ half)
            faces.append(rectangle(size[0], size[1]).moved(pose(R, normal * half)))
    mesh = merge(faces)
    return Mesh(mesh.vertices + np.asarray(centre), mesh.normals, mesh.triangles)


def inside_box(size_m: Sequence[float] | Array, centre: Sequence[float] | Array) -> Mesh:
    """Build a box whose faces look inwards: the walls of a room."""
    mesh = box(size_m, centre)
    return Mesh(mesh.vertices, -mesh.normals, mesh.triangles[:, ::-1].copy())


def ellipsoid(centre: Sequence[float] | Array, radii_m: Sequence[float] | Array) -> Mesh:
    """Build an ellipsoid along the axes."""
    n_around, n_up = 24, 16
    polar, azimuth = np.meshgrid(
        np.linspace(0, np.pi, n_up + 1), np.linspace(0, 2 * np.pi, n_around + 1), indexing="ij"
    )
    unit = np.stack(
        [np.sin(polar) * np.cos(azimuth), np.sin(polar) * np.sin(azimuth), np.cos(polar)], axis=-1
    )
    unit = unit.reshape(-1, 3)
    normals = unit / np.asarray(radii_m)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return Mesh(unit * radii_m + np.asarray(centre), normals, _grid_triangles(n_up, n_around))


def cone(
    start: Sequence[float] | Array,
    end: Sequence[float] | Array,
    start_radius_m: float,
    end_radius_m: float | None = None,
) -> Mesh:
    """Build the side of a cylinder or truncated cone from one point to another, without its caps."""
    start, end = np.asarray(start, dtype=np.float64), np.asarray(end, dtype=np.float64)
    end_radius_m = start_radius_m if end_radius_m is None else end_radius_m
    n_around, n_along = 16, 8
    axis = (end - start) / np.linalg.norm(end - start)
    side = np.cross(axis, np.eye(3)[np.argmin(np.abs(axis))])
    side /= np.linalg.norm(side)
    azimuth = np.linspace(0, 2 * np.pi, n_around + 1)[:, None]
    around = np.cos(azimuth) * side - np.sin(azimuth) * np.cross(axis, side)
    along = np.linspace(0, 1, n_along + 1)[:, None, None]
    radius_m = start_radius_m + along * (end_radius_m - start_radius_m)
    vertices = start + along * (end - start) + radius_m * around
    normals = np.tile(around, (n_along + 1, 1))
    return Mesh(vertices.reshape(-1, 3), normals, _grid_triangles(n_along, n_around))


def limb(
    start: Sequence[float] | Array, end: Sequence[float] | Array, start_radius_m: float, end_radius_m: float
) -> Mesh:
    """Build a cone with a ball at either end."""
    ends = [ellipsoid(start, [start_radius_m] * 3), ellipsoid(end, [end_radius_m] * 3)]
    return merge([cone(start, end, start_radius_m, end_radius_m), *ends])


def _grid_triangles(n_down: int, n_across: int) -> NDArray[np.uint32]:
    index: NDArray[Any] = np.arange((n_down + 1) * (n_across + 1)).reshape(n_down + 1, n_across + 1)
    a, b, c, d = (
        corner.ravel() for corner in (index[:-1, :-1], index[1:, :-1], index[1:, 1:], index[:-1, 1:])
    )
    return np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)]).astype(np.uint32)
