"""Triangle meshes of simple bodies, with smooth normals for round ones."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lce_rig.core.geometry import Array, pose, transform


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
        """Take the mesh from frame b to frame a."""
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
